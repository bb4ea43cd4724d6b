"""Find and read dark and white frames, and compare their exposures with those of a cube's lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.exposures import (
    MOST_DARK_ERROR,
    Taken,
    all_alike,
    check_binning,
    dark_error,
    exposure_at_gain,
    taken_with,
)
from spectralzoom.storage.readers.array_files import load_npy
from spectralzoom.storage.readers.cube_sources import reading
from spectralzoom.storage.readers.envi_files import open_envi_cube

KINDS = ("dark", "white", "bad")  # behind the name of a cube in those of its frames


@dataclass(frozen=True)
class Frame:
    """One reference frame, as the mean of its lines."""

    values: NDArray[np.float32]  # (sample, band)
    files: tuple[Path, ...]  # header and data, or one file
    taken: Taken
    fields: Mapping[str, str] = field(default_factory=dict)  # of an ENVI header


def find_reference(folder: Path, kind: str) -> Path | None:
    """Return the header of the ``dark`` or ``white`` frame in a folder by its name (SceneError: there are several)."""
    headers = (entry for entry in sorted(folder.iterdir()) if entry.suffix.lower() == ".hdr")
    found = [entry for entry in headers if entry.name.lower().startswith(kind)]
    if len(found) > 1:
        names = ", ".join(entry.name for entry in found)
        raise SceneError(f"{folder} has several {kind} frames ({names}); name one with --{kind}")
    return found[0] if found else None


def find_frames(stem: Path, stated: Mapping[str, Path | None]) -> dict[str, Frame]:
    """Return the frames of a cube by their kinds: ``stated``, else those beside the cube ``stem``, else of its folder.

    Raises SceneError: a file is missing, damaged or no frame, or a folder has several of a kind.
    """
    frames: dict[str, Frame] = {}
    for kind in KINDS:
        beside = (stem.with_name(f"{stem.name}.{kind}{ending}") for ending in (".hdr", ".npy"))
        if (file := stated.get(kind)) is not None and not file.exists():
            raise SceneError(f"there is no file {file}; check the name (seen from {Path.cwd()})")
        file = file or next((one for one in beside if one.is_file()), None)
        file = find_reference(stem.parent, kind) if file is None and kind != "bad" else file
        if file is not None:
            frames[kind] = load_frame(file, kind)
    return frames


def load_frame(path: Path, kind: str = "reference") -> Frame:
    """Read one ENVI or .npy frame (SceneError: it cannot be read or holds no real numbers)."""
    where = f"the {kind} frame {path.name}"
    if path.is_dir():
        raise SceneError(f"{path} is a folder, expected a reference frame (ENVI or .npy); name the file")
    files: tuple[Path, ...] = (path,)
    taken, fields = Taken(where), {}
    if path.suffix.lower() == ".npy":
        with reading(path, ".npy"):
            values = load_npy(path)
    else:
        cube = open_envi_cube(path)
        values, fields = cube.values, dict(cube.header.fields)
        files, taken = (cube.header_path, cube.path), taken_with(cube.header, where)
    values = values.astype(np.uint8) if values.dtype.kind == "b" else values  # of a bad frame
    if values.dtype.kind not in "uif":
        raise SceneError(f"{path} holds {values.dtype}, expected the real numbers of a reference frame")
    frame = values[None] if values.ndim == 2 else values
    return Frame(np.asarray(frame.mean(axis=0, dtype=np.float64), np.float32), files, taken, fields)


def match_exposures(
    frames: Mapping[str, Frame], cube: Taken, lines_ms: NDArray[np.float64], *, stated: bool
) -> tuple[float | None, list[str]]:
    """Return the exposure [ms] of the white frame at the gain of the cube, and notes; None if it is that of all lines.

    ``lines_ms`` (line,) are exposures of the lines; ``stated`` is whether a file has them. An exposure that is
    not stated is assumed to be that of the lines. A dark frame of another exposure is used as it is. Raises SceneError:
    a frame has another binning, another gain without a unit, or a dark frame may change values by more than 5 %.
    """
    usual = float(np.median(lines_ms))
    low, high = float(lines_ms.min()), float(lines_ms.max())
    lines = f"{low:g} ms" if all_alike(lines_ms) else f"{low:g} to {high:g} ms"
    gains = "".join(f", {key} = {gain:g} {unit}".rstrip() for key, (gain, unit) in cube.gains.items())
    lines = f"{lines}{gains}" if stated else cube.text
    notes: list[str] = []
    found: dict[str, float] = {}
    for kind, frame in frames.items():
        if kind not in ("dark", "white"):
            continue
        check_binning(frame.taken, cube)
        notes += frame.taken.notes
        ms = exposure_at_gain(frame.taken, cube, usual, stated=stated)
        both = f"{frame.taken.where} was taken with {frame.taken.text}, the lines with {lines}"
        if ms is None:
            notes.append(f"{both}: the same exposure is assumed")
        elif not all_alike([ms, *lines_ms]):
            found[kind] = ms
            notes += [f"{both}: values are scaled by the ratio"] if kind == "white" else []
        else:
            found[kind] = ms
    white_ms = found.get("white")
    if "dark" in found and not all_alike([found["dark"], *lines_ms, white_ms or usual]):
        notes.append(_dark_note(frames, found["dark"], white_ms or usual, lines_ms, lines))
    same = white_ms is None or all_alike([white_ms, *lines_ms])
    return None if same else white_ms, notes


def _dark_note(
    frames: Mapping[str, Frame], dark_ms: float, white_ms: float, lines_ms: NDArray[np.float64], lines: str
) -> str:
    """Return a note on a dark frame of another exposure (SceneError: it may change values by more than 5 %)."""
    dark, white = frames["dark"], frames.get("white")
    what = f"{dark.taken.where} was taken with {dark.taken.text}, the lines with {lines}"
    kept = "it is used as it is, since its bias does not depend on the exposure"
    if white is None or white.values.shape != dark.values.shape:
        return f"{what}: {kept}"
    span = white.values - dark.values
    lit = span[np.isfinite(span) & (span > 0)]
    level = float(np.nanmedian(dark.values))
    most = dark_error(level / float(np.median(lit)) if lit.size else 0.0, dark_ms, white_ms, np.unique(lines_ms))
    what = f"{what}, and {white.taken.where} with {white.taken.text}"
    effect = f"values may be off by up to {most:.2g} of white, if all of it is dark current"
    if most > MOST_DARK_ERROR:
        raise SceneError(f"{what}: {effect}; give one of the exposure of the lines, or correct the header")
    return f"{what}: {kept}; {effect}"

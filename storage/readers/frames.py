"""Find and read dark and white frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.exposures import Frames, Taken, taken_with
from spectralzoom.storage.readers.array_files import load_npy
from spectralzoom.storage.readers.band_facts import Bands, bands_of_lists, numbers_of_list
from spectralzoom.storage.readers.band_matches import match_bands
from spectralzoom.storage.readers.cube_sources import reading
from spectralzoom.storage.readers.envi_files import open_envi_cube
from spectralzoom.storage.readers.user_files import first_there, is_there

KINDS = ("dark", "white", "bad")  # behind the name of a cube in those of its frames


@dataclass(frozen=True)
class Frame:
    """One reference frame, as the mean of its lines."""

    values: NDArray[np.float32]  # (sample, band)
    files: tuple[Path, ...]  # header and data, or one file
    taken: Taken
    fields: Mapping[str, str] = field(default_factory=dict)  # of an ENVI header
    white_reference: NDArray[np.float64] | None = None  # (band,) that the header lists


def find_reference(folder: Path, kind: str) -> Path | None:
    """Return the header of the ``dark`` or ``white`` frame in a folder by its name (SceneError: there are several)."""
    headers = (entry for entry in sorted(folder.iterdir()) if entry.suffix.lower() == ".hdr")
    found = [entry for entry in headers if entry.name.lower().startswith(kind)]
    if len(found) > 1:
        names = ", ".join(entry.name for entry in found)
        raise SceneError(f"{folder} has several {kind} frames ({names}); name one with --{kind}")
    return found[0] if found else None


def find_frames(
    stem: Path, stated: Mapping[str, Path | None], shape: tuple[int, int], bands: Bands
) -> dict[str, Frame]:
    """Return the frames of a cube by their kinds: ``stated``, else those beside the cube ``stem``, else of its folder.

    Raises SceneError: a file is missing, damaged or no frame of ``shape``, or a folder has several of a kind.
    """
    frames: dict[str, Frame] = {}
    for kind in KINDS:
        beside = (stem.with_name(f"{stem.name}.{kind}{ending}") for ending in (".hdr", ".npy"))
        if (file := stated.get(kind)) is not None and not file.exists():
            raise SceneError(f"there is no file {file}; check the name (seen from {Path.cwd()})")
        file = file or first_there(beside)
        file = find_reference(stem.parent, kind) if file is None and kind != "bad" else file
        if file is not None:
            frames[kind] = load_frame(file, kind, shape, bands)
    return frames


def load_frame(path: Path, kind: str, shape: tuple[int, int], bands: Bands) -> Frame:
    """Read one ENVI or .npy frame, its bands in the order of those of the cube where both state wavelengths.

    Raises SceneError: it has no real numbers of the (sample, band) ``shape``, or other bands.
    """
    where = f"the {kind} frame {path.name}"
    if is_there(path) and path.is_dir():
        raise SceneError(f"{path} is a folder, expected a reference frame (ENVI or .npy); name the file")
    files: tuple[Path, ...] = (path,)
    taken, fields = Taken(where), {}
    if path.suffix.lower() == ".npy":
        with reading(path, ".npy"):
            values = load_npy(path)[...]
    else:
        cube = open_envi_cube(path)
        values, fields = cube.values[...], dict(cube.header.fields)
        files, taken = (cube.header_path, cube.path), taken_with(where, fields, cube.header.settings)
    values = values.astype(np.uint8) if values.dtype.kind == "b" else values  # of a bad frame
    if values.dtype.kind not in "uif":
        raise SceneError(f"{path} holds {values.dtype}, expected the real numbers of a reference frame")
    frame = values[None] if values.ndim == 2 else values
    count = frame.shape[-1]
    reference = numbers_of_list(fields.get("white_reference", ""), count)
    order, notes = match_bands(bands_of_lists(fields, count, where)[1], bands, where, "the cube")
    if order is not None:
        frame, reference = frame[..., order], None if reference is None else reference[order]
        taken = replace(taken, notes=(*taken.notes, *notes), cut=len(order) < count)
    if frame.shape[1:] != shape:
        is_not = f"the {kind} frame {path} is {frame.shape[1:]} (sample, band), the cube {shape}"
        raise SceneError(f"{is_not}; give one taken with the cube's own samples and bands")
    mean = np.asarray(frame.mean(axis=0, dtype=np.float64), np.float32)
    return Frame(mean, files, taken, fields, reference)


def taken_of(frames: Mapping[str, Frame]) -> Frames:
    """Return the values of frames and how they were taken."""
    return {kind: (frame.values, frame.taken) for kind, frame in frames.items()}

"""Dark and white frames of a recorded cube: given, beside it, in its folder, in itself, or assumed with a note."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.capture.recorded import sum_references
from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera
from pipeline.rectify.detector import find_bad_elements
from pipeline.rig.camera.camera_texts import listed_numbers
from pipeline.source import References
from storage.readers.cube_sources import CubeSource
from storage.readers.envi_files import find_envi_pair, find_reference, load_envi_header
from storage.readers.open_cubes import load_frame, reader_of

FRAMES = ("dark", "white", "bad", "flat")  # what a cube's name is followed by in those of its frames


def find_references(
    source: CubeSource,
    stem: Path,
    camera: LineCamera,
    notes: list[str],
    *,
    stated: dict[str, Path | None],
    panel: NDArray[np.float32],
    at_rest: bool,
) -> References:
    """Return the reference frames of a cube whose companions are called ``stem.dark.hdr`` and the like.

    ``stated`` files come first, then those of the cube's name, then the folder's only dark and white frame. ``panel``
    is the value of the white reference, one or (band,), where nothing else says it; ``at_rest`` says that the white
    frame was taken with the mirror at rest. Raises SceneError: a frame has other samples or bands than the cube.
    """
    name, frame = stem.name, source.shape[1:]
    white_dn = camera.full_scale_dn * max(camera.samples // frame[0], 1)
    files: dict[str, Path | None] = {}
    for kind in FRAMES:
        beside = [stem.with_name(f"{name}.{kind}{ending}") for ending in (".hdr", ".npy")]
        file = stated.get(kind) or next((one for one in beside if one.is_file()), None)
        files[kind] = find_reference(stem.parent, kind) if file is None and kind in ("dark", "white") else file
    found = {kind: _load_fitting(file, frame, kind, notes) for kind, file in files.items() if file is not None}
    dark, white = found.get("dark", source.dark), found.get("white", source.white)
    measured = dark is not None and white is not None
    if dark is None:
        dark = np.zeros(frame, np.float32)
        notes.append(f"{name} has no dark frame: a dark level of 0 is assumed; give --dark")
    if white is None:
        white = np.full(frame, white_dn, np.float32)
        notes.append(
            f"{name} has no white frame: full scale ({white_dn} DN) is assumed to be white, and values are relative; "
            "give --white"
        )
    bad = found.get("bad", source.bad)
    if bad is None and measured and files["bad"] is None:
        bad = find_bad_elements(dark, white)
    bands = frame[1]
    panel = panel if source.panel is None else np.asarray(source.panel, np.float32)
    if panel.shape not in ((), (bands,)):
        raise SceneError(
            f"the white reference has {panel.shape} values, the cube {bands} bands; give one or one a band"
        )
    by_mirror, file = at_rest or source.position is not None, files["white"]
    if file is not None and reader_of(file) == "envi":
        fields = load_envi_header(find_envi_pair(file)[0]).fields
        listed = listed_numbers(fields, "panel", bands, [])
        panel = panel if listed is None else listed.astype(np.float32)
        by_mirror = by_mirror or fields.get("mirror at rest", "0").strip() == "1"
    bad = None if bad is None or not np.any(bad) else np.asarray(bad, np.bool_)
    panel = np.broadcast_to(panel, bands).copy()
    return References(dark, white, panel, bad, found.get("flat", source.flat), by_mirror)


def _load_fitting(file: Path, frame: tuple[int, ...], kind: str, notes: list[str]) -> NDArray[np.float32]:
    """A frame (sample, band), summed to a cube's binning where it has more samples (SceneError: it does not fit)."""
    values, _ = load_frame(file)
    notes.append(f"{kind} frame from {file.name}")
    parts = values.shape[0] // frame[0]
    if parts < 1 or values.shape != (parts * frame[0], frame[1]):
        raise SceneError(
            f"the {kind} frame {file} is {values.shape} (sample, band), the cube {frame}; give one taken with the "
            "cube's own samples and bands"
        )
    if parts == 1:
        return values
    whole = References(values, values, np.ones(frame[1], np.float32), values > 0, values)
    summed = sum_references(whole, parts)
    return {"bad": np.asarray(summed.bad, np.float32), "flat": np.asarray(summed.flat)}.get(kind, summed.dark)

"""What a folder of recorded sweeps shows of itself, looked at before anybody has written settings for a survey."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import PipelineError
from storage.readers.envi_files import find_reference
from storage.readers.label_files import image_folder, is_store, match_folder
from storage.readers.open_cubes import open_cube, reader_of
from storage.readers.pointing_tables import ENDINGS
from storage.readers.recorded_cubes import find_cubes
from storage.readers.recordings import Recording, open_recording

CAMERA_NUMBERS = ("uint8", "uint16", "int16")


@dataclass(frozen=True)
class SweepsDraft:
    """What was seen of the sweeps of a folder."""

    folder: Path
    cubes: tuple[Path, ...]
    pointing: tuple[Path, ...]  # tables and vectors that lie there, by any name
    recording: Recording | None  # None where something is missing without which it cannot be opened
    bands: int
    has_wavelengths: bool
    problem: str = ""  # why it could not be opened


def draft_sweeps(folder: Path) -> SweepsDraft | None:
    """Look at a folder; None where it holds no recorded sweeps: no cubes of a camera's numbers, or labelled ones.

    Cubes are taken for sweeps where a pointing table or reference frames lie with them, or where they are ENVI cubes of
    whole numbers that do not say where on earth they lie.
    """
    if not folder.is_dir() or is_store(folder):
        return None
    try:
        cubes = find_cubes(folder)
        if match_folder(image_folder(folder)).labels:
            return None
        sources = [open_cube(cube) for cube in cubes]
    except (PipelineError, OSError):
        return None
    if any(source.dtype.name not in CAMERA_NUMBERS for source in sources):
        return None
    pointing = tuple(sorted(one for one in folder.iterdir() if one.name.lower().endswith(_pointing_names())))
    frames = any(find_reference(folder, kind) is not None for kind in ("dark", "white"))
    beside = any(folder.glob("*.dark.hdr")) or any(folder.glob("*.white.hdr"))
    unplaced_envi = all(
        reader_of(cube) in ("envi", "headwall") and source.geobox is None
        for cube, source in zip(cubes, sources, strict=True)
    )
    if not (pointing or frames or beside or unplaced_envi):
        return None
    recording, problem = None, ""
    try:
        recording = open_recording(folder)
    except PipelineError as error:
        problem = str(error)
    first = sources[0]
    known = all(source.bands.wavelength_nm is not None for source in sources)
    return SweepsDraft(folder, tuple(cubes), pointing, recording, first.shape[2], known, problem)


def _pointing_names() -> tuple[str, ...]:
    return tuple(f"pointing{ending}" for ending in ENDINGS)

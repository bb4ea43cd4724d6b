"""Find and open the cubes of recordings, and their dark and white frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError, WavelengthError
from pipeline.geometry.camera import LineCamera
from pipeline.rig.camera.camera_texts import listed_numbers
from pipeline.signal.calibrate import find_bad_elements
from pipeline.source import References
from storage.readers.cube_sources import CubeSource
from storage.readers.envi_files import DATA_ENDINGS, find_envi_pair, find_reference, load_envi_header
from storage.readers.open_cubes import load_frame, open_cube, reader_of, with_wavelengths
from storage.readers.zarr_files import find_zarr_store

FRAMES = ("dark", "white", "bad", "flat")  # behind the name of a cube in those of its frames
SAMPLED_LINES = 16  # for bits


@dataclass(frozen=True)
class RecordedFile:
    """One cube of a recording."""

    name: str
    path: Path
    source: CubeSource

    @property
    def folder(self) -> Path:
        """Return the folder of its pointing and frames."""
        return self.path if self.path.is_dir() and find_zarr_store(self.path) is None else self.path.parent


def find_cubes(path: Path) -> list[Path]:
    """Return the cubes of an address: itself, or the ENVI cubes or Zarr stores of a folder (SceneError: none)."""
    if not path.is_dir() or find_zarr_store(path) is not None:
        return [path]
    headers = sorted(entry for entry in path.iterdir() if entry.suffix.lower() == ".hdr" and entry.is_file())
    if any(entry.name.lower().startswith("raw_") for entry in headers):
        return [path]  # parts of a Headwall camera's cube
    stems = [(entry, _stem(entry).lower()) for entry in headers]
    cubes = [
        entry
        for entry, stem in stems
        if not stem.startswith(("dark", "white")) and stem.rpartition(".")[2] not in FRAMES
    ]
    stores = sorted(entry for entry in path.iterdir() if entry.is_dir() and find_zarr_store(entry) == entry)
    if not cubes and not stores:
        raise SceneError(f"{path} holds no cube; expected ENVI headers (.hdr), raw_<frame> files or Zarr stores in it")
    return cubes or stores


def _stem(path: Path) -> str:
    """Return the name of a cube without the endings of its files."""
    stem = path.name.removesuffix(path.suffix) if path.suffix.lower() == ".hdr" else path.name
    ending = Path(stem).suffix
    return stem.removesuffix(ending) if ending.lower() in (*filter(None, DATA_ENDINGS), ".zarr") else stem


def open_recorded_cube(path: Path, wavelengths: Sequence[float] | None) -> RecordedFile:
    """Open one cube of whole numbers with wavelengths."""
    source = open_cube(path)
    if source.dtype not in (np.uint8, np.uint16, np.int16):
        raise SceneError(
            f"{path} holds {source.dtype}, expected a camera's own numbers (whole, 8 or 16 bits); a cube of "
            "reflectance or radiance is no recording: give it as --scene"
        )
    if wavelengths is not None:
        source = with_wavelengths(source, path, wavelengths)
    if source.bands.wavelength_nm is None:
        raise WavelengthError(
            f"{path} has {source.shape[2]} bands and nothing says their wavelengths; give --wavelengths in nm, or "
            "write a list 'wavelength' into its header"
        )
    return RecordedFile(_stem(path), path, source)


def with_bits(camera: LineCamera, cubes: Sequence[RecordedFile], notes: list[str]) -> LineCamera:
    """Return the camera with as many bits as some lines of each cube need."""
    bits = camera.bits
    for cube in cubes:
        valid = np.flatnonzero(cube.source.valid)
        chosen = valid[:: max(len(valid) // SAMPLED_LINES, 1)][:SAMPLED_LINES]
        most = max(int(cube.source.read(int(line), int(line) + 1).max()) for line in chosen)
        full = camera.full_scale_dn * max(camera.samples // cube.source.shape[1], 1)
        needed = (most * camera.full_scale_dn // full).bit_length()
        if most > full and needed > bits:
            bits = needed
            notes.append(
                f"{cube.name}: numbers reach {most}, so {bits} bits are taken for camera.bits; if the camera has"
                " fewer, correct the byte order in the header"
            )
    return replace(camera, bits=bits)


def find_references(
    source: CubeSource,
    stem: Path,
    camera: LineCamera,
    notes: list[str],
    *,
    stated: dict[str, Path | None],
    white_reference: NDArray[np.float32],
) -> References:
    """Return the reference frames of a cube: ``stated``, else ``stem.dark.hdr`` etc., else those of the folder.

    ``white_reference`` is the default value of the white reference, one or (band,). Raises SceneError: a frame has
    other samples or bands than the cube.
    """
    name, frame = stem.name, source.shape[1:]
    white_dn = camera.full_scale_dn * max(camera.samples // frame[0], 1)
    files: dict[str, Path | None] = {}
    for kind in FRAMES:
        beside = [stem.with_name(f"{name}.{kind}{ending}") for ending in (".hdr", ".npy")]
        file = stated.get(kind) or next((one for one in beside if one.is_file()), None)
        files[kind] = find_reference(stem.parent, kind) if file is None and kind in ("dark", "white") else file
    found: dict[str, NDArray[np.float32]] = {}
    for kind, file in files.items():
        if file is not None:
            found[kind] = load_frame(file)[0]
            notes.append(f"{kind} frame from {file.name}")
            if found[kind].shape != frame:
                raise SceneError(
                    f"the {kind} frame {file} is {found[kind].shape} (sample, band), the cube {frame}; give one taken "
                    "with the cube's own samples and bands"
                )
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
    bad: NDArray[Any] | None = found.get("bad")
    if bad is None and measured and files["bad"] is None:
        bad = find_bad_elements(dark, white)
    bands = frame[1]
    if white_reference.shape not in ((), (bands,)):
        raise SceneError(
            f"the white reference has {white_reference.shape} values, the cube {bands} bands; give one or one a band"
        )
    by_mirror, file = False, files["white"]
    if file is not None and reader_of(file) == "envi":
        fields = load_envi_header(find_envi_pair(file)[0]).fields
        listed = listed_numbers(fields, "white_reference", bands, [])
        white_reference = white_reference if listed is None else listed.astype(np.float32)
        by_mirror = fields.get("mirror at rest", "0").strip() == "1"
    bad = None if bad is None or not np.any(bad) else np.asarray(bad, np.bool_)
    white_reference = np.broadcast_to(white_reference, bands).copy()
    return References(dark, white, white_reference, bad, found.get("flat"), by_mirror)

"""Find and open the cubes of recordings, and make the references of each of its dark and white frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import SceneError, WavelengthError
from spectralzoom.pipeline.exposures import all_alike, match_exposures
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Axis, Floats
from spectralzoom.pipeline.signal.calibrate import check_frames, find_bad_elements
from spectralzoom.pipeline.source import References
from spectralzoom.storage.readers.array_files import find_zarr_store
from spectralzoom.storage.readers.band_facts import bands_text, why_unknown
from spectralzoom.storage.readers.cube_sources import CubeSource
from spectralzoom.storage.readers.envi_files import DATA_ENDINGS, find_envi_pair, load_envi_header
from spectralzoom.storage.readers.frames import KINDS, Frame, find_frames, taken_of
from spectralzoom.storage.readers.open_cubes import open_cube_source, reader_of, with_wavelengths
from spectralzoom.storage.readers.pointing_tables import LinePointing
from spectralzoom.storage.readers.user_files import is_there

SAMPLED_LINES = 64  # for bits


@dataclass(frozen=True)
class FileCube:
    """One cube of a recording, with its reference frames and the pointing of its lines."""

    name: str
    folder: Path  # of its frames and pointing
    source: CubeSource
    frames: Mapping[str, Frame]  # by kind
    along: Axis = "x"  # of the field, where the lines lie
    pointing: LinePointing | None = None
    notes: tuple[str, ...] = ()  # on the pointing
    pixel_m: float | None = None  # side of a pixel on the ground, by positions in metres

    @cached_property
    def bad_bands(self) -> NDArray[np.bool_]:
        """Return (band,) whether the file marks a band as bad; no band where it marks all."""
        count = self.source.shape[2]
        return np.isin(np.arange(count), self.source.bad_bands if len(self.source.bad_bands) < count else ())

    @property
    def exposure_ms(self) -> Floats | None:
        """Return (line,) exposures by the pointing table, else by the files; None if nothing states them."""
        pointed = None if self.pointing is None else self.pointing.exposure_ms
        return self.source.lines.exposure_ms if pointed is None else pointed


def find_cubes(path: Path) -> list[Path]:
    """Return the cubes of an address: itself, or the ENVI cubes or Zarr stores of a folder (SceneError: none)."""
    if not path.is_dir() or find_zarr_store(path) is not None:
        return [path]
    entries = sorted(entry for entry in path.iterdir() if entry.suffix.lower() in (".hdr", ".zarr") and is_there(entry))
    headers = [entry for entry in entries if entry.suffix.lower() == ".hdr" and entry.is_file()]
    if any(entry.name.lower().startswith("raw_") for entry in headers):
        return [path]  # parts of a Headwall camera's cube
    stems = [(entry, _stem(entry).lower()) for entry in headers]
    cubes = [
        entry
        for entry, stem in stems
        if not stem.startswith(("dark", "white")) and stem.rpartition(".")[2] not in KINDS
    ]
    stores = sorted(entry for entry in path.iterdir() if entry.is_dir() and find_zarr_store(entry) == entry)
    known = {stem for _, stem in stems}
    for table in sorted(path.glob("*.pointing.*")):
        stem = table.name.partition(".pointing.")[0]
        for data in (path / f"{stem}{ending}" for ending in DATA_ENDINGS):
            if stem.lower() not in known and data.is_file():
                raise SceneError(f"{data} has no header {stem}.hdr; copy the header, or move {data.name} elsewhere")
    if not cubes and not stores:
        raise SceneError(f"{path} holds no cube; expected ENVI headers (.hdr), raw_<frame> files or Zarr stores in it")
    if cubes and stores:
        raise SceneError(f"{path} holds ENVI cubes and the Zarr store {stores[0].name}; name one, or move either kind")
    return cubes or stores


def _stem(path: Path) -> str:
    """Return the name of a cube without the endings of its files."""
    stem = path.name.removesuffix(path.suffix) if path.suffix.lower() == ".hdr" else path.name
    ending = Path(stem).suffix
    return stem.removesuffix(ending) if ending.lower() in (*filter(None, DATA_ENDINGS), ".zarr") else stem


def open_file_cube(path: Path, wavelengths: Sequence[float] | None, stated: Mapping[str, Path | None]) -> FileCube:
    """Open one cube of whole numbers with wavelengths, and its frames: ``stated``, or found beside it."""
    source = open_cube_source(path)
    if source.dtype not in (np.uint8, np.uint16, np.int16):
        raise SceneError(
            f"{path} holds {source.dtype}{' by the scale or offset in its header' if source.scaling else ''}, expected "
            "a camera's own numbers (whole, 8 or 16 bits); a cube of reflectance or radiance is no recording: give it "
            "as --scene"
        )
    if wavelengths is not None:
        source = with_wavelengths(source, path, wavelengths)
    if source.bands.wavelength_nm is None:
        raise WavelengthError(
            f"{path} has {source.shape[2]} bands and {why_unknown(source.bands)}; give --wavelengths in nm"
            + (", or write a list 'wavelength' into its header" if reader_of(path) == "envi" else "")
        )
    if without := bands_text(source.bands.unknown):
        raise WavelengthError(f"{path} gives no wavelength of bands {without} (from 0); give --wavelengths in nm")
    folder = path if path.is_dir() and find_zarr_store(path) is None else path.parent
    name = _stem(path.absolute())  # of the folder ., too
    frames = find_frames(folder / name, stated, source.shape[1:], source.bands)
    fields = load_envi_header(find_envi_pair(path)[0]).fields if reader_of(path) == "envi" else {}
    if (axis := fields.get("line axis", "x").strip()) not in ("x", "y"):
        raise SceneError(f"{path} has line axis = {axis!r}, expected x or y; correct the header")
    return FileCube(name, folder, source, frames, "y" if axis == "y" else "x")


def with_bits(camera: LineCamera, cubes: Sequence[FileCube]) -> tuple[LineCamera, list[str]]:
    """Return the camera with as many bits as white frames and lines need, 8 for cubes of bytes; and notes."""
    notes: list[str] = []
    if camera.bits > 8 and all(cube.source.dtype == np.uint8 for cube in cubes):
        camera = replace(camera, bits=8, dark_dn=camera.dark_dn * 255 / camera.full_scale_dn)  # the same fraction
        notes.append("the files hold bytes, so 8 bits are taken for camera.bits")
    bits = camera.bits
    for cube in cubes:
        source = cube.source
        valid = np.flatnonzero(source.valid)
        chosen = np.unique(valid[np.linspace(0, len(valid) - 1, SAMPLED_LINES).astype(int)])
        lines = np.concatenate([source.read(int(line), int(line) + 1) for line in chosen])
        void = np.nan if source.nodata is None else source.nodata
        most = int(lines.max(initial=0, where=~cube.bad_bands & (lines != void)))
        if "white" in cube.frames:
            white = cube.frames["white"].values
            most = max(most, int(white[np.isfinite(white) & ~cube.bad_bands].max(initial=0)))
        full = camera.full_scale_dn * max(camera.samples // source.shape[1], 1)
        needed = (most * camera.full_scale_dn // full).bit_length()
        if most > full and needed > bits:
            bits = needed
            notes.append(
                f"{cube.name}: numbers reach {most}, so {bits} bits are taken for camera.bits; if the camera has"
                " fewer, correct the byte order in the header"
            )
    return replace(camera, bits=bits), notes


def references_of(
    cube: FileCube, camera: LineCamera, exposure_ms: Floats, white_reference: ArrayLike, *, stated: bool
) -> tuple[References, list[str]]:
    """Return the references of a cube by its frames, and notes.

    ``exposure_ms`` (line,) are those of its lines, by a file if ``stated``; ``white_reference`` is the default value of
    the white reference, one or (band,). Without a white frame, values are those of the exposure of the camera. Raises
    SceneError: frames do not fit each other or the cube, or white is not brighter than dark.
    """
    name, source, frames = cube.name, cube.source, cube.frames
    frame = source.shape[1:]
    white_dn = camera.full_scale_dn * max(camera.samples // frame[0], 1)
    notes = [f"{kind} frame from {one.files[0].name}" for kind, one in frames.items()]
    own_white = "white" in frames and frames["white"].files[0].name.startswith(f"{name}.")  # of no other cube
    usual_ms = None if own_white else camera.exposure_ms
    white_ms, more = match_exposures(taken_of(frames), source.taken, exposure_ms, stated=stated, usual_ms=usual_ms)
    notes += more
    found = {kind: one.values for kind, one in frames.items()}
    measured = {"dark", "white"} <= set(found)
    if "dark" not in found:
        notes.append(f"{name} has no dark frame: a dark level of 0 is assumed; give --dark")
    if "white" not in found:
        white_ms = None if all_alike([camera.exposure_ms, *exposure_ms]) else camera.exposure_ms
        scaled = "" if white_ms is None else f" at an exposure of {white_ms:g} ms"
        notes.append(
            f"{name} has no white frame: full scale ({white_dn} DN{scaled}) is assumed to be white, and values are "
            "relative; give --white"
        )
    dark = found.get("dark", np.zeros(frame, np.float32))
    white = found.get("white", np.full(frame, white_dn, np.float32))
    more = check_frames(f"{name}: ", dark, white, white_dn)
    notes += more if "white" in found else []
    bad: NDArray[Any] = found.get("bad", np.zeros(frame, np.float32))
    if measured and "bad" not in found:
        bad = find_bad_elements(dark, white)
    fields = frames["white"].fields if "white" in frames else {}
    listed = frames["white"].white_reference if "white" in frames else None
    value = np.asarray(white_reference if listed is None or np.isnan(listed).any() else listed, np.float32)
    if value.shape not in ((), frame[1:]):
        raise SceneError(
            f"the white reference has {value.shape} values, the cube {frame[1]} bands; give one or one a band"
        )
    if cube.bad_bands.any():
        left_out = bands_text(np.flatnonzero(cube.bad_bands).tolist())
        notes.append(f"{name}: bands {left_out} are left out: the file marks them as bad")
    notes += [] if source.nodata is None else [f"{name}: the number {source.nodata:g} is no data, as the file says"]
    out = cube.bad_bands | np.asarray(bad, np.bool_)
    return References(
        dark,
        white,
        np.broadcast_to(value, frame[1:]).copy(),
        out if out.any() else None,
        by_mirror=fields.get("mirror at rest", "0").strip() == "1",
        exposure_ms=white_ms,
    ), notes

"""Recordings: sweeps that were taken before, out of an archive or out of files with a pointing table.

::

    ARCHIVE, s3://bucket/prefix           raw cubes of the newest run, or of the run named: ARCHIVE/runs/NAME
    stages/capture/KEY, NAME.zarr         raw cubes of one capture, or a single one
    NAME.hdr, NAME.bil, .bip, .bsq        an ENVI cube, or a folder of them
    a folder with raw_<frame> files       a Headwall camera's capture
    NAME.zarr                             a cube of anyone's

Beside a cube ``NAME`` of files are found, where no flag names them: ``NAME.pointing.csv`` (.parquet, .toml),
``NAME.dark.hdr``, ``NAME.white.hdr``, ``NAME.bad.hdr``, ``NAME.flat.hdr``, or ``dark*.hdr`` and ``white*.hdr`` for all
cubes of the folder. The header of an ENVI cube may say ``line axis = y``: lines lie along y of the field, and the scan
goes along x. The header of a white frame may say ``panel = {...}``, the value of the white reference per band,
and ``mirror at rest = 1`` where it was taken so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.capture.recorded import RecordedSource, RecordedSweep, line_runs, sum_references
from pipeline.capture.straight_scans import covered_field, fit_sweep, flat_camera, flat_positions
from pipeline.errors import ArchiveError, IncompleteStoreError, SceneError, SettingsError, WavelengthError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import STRAIGHT, Mounting
from pipeline.geometry.scan import Axis, Sweep
from pipeline.rectify.detector import find_bad_elements
from pipeline.rig.camera.camera_texts import listed_numbers
from pipeline.source import References
from storage.archive.archive import Archive
from storage.archive.keys import array_digest
from storage.archive.manifests import manifest_sha256
from storage.archive.records import Run, read_run, read_store
from storage.archive.staging import MANIFEST_NAME
from storage.arrays.cubes import RawCube, open_raw_cube
from storage.arrays.layout import open_group
from storage.readers.cube_sources import CubeSource
from storage.readers.envi_files import DATA_ENDINGS, INTERLEAVES, find_envi_pair, find_reference, load_envi_header
from storage.readers.open_cubes import load_frame, open_cube, reader_of, with_wavelengths
from storage.readers.pointing_tables import (
    ENDINGS,
    WITHOUT_MIRROR,
    LinePointing,
    find_pointing,
    follow_vector,
    load_played_vector,
    load_pointing_table,
)
from storage.readers.zarr_files import find_zarr_store
from storage.remote.object_stores import is_remote
from storage.remote.opening import is_archive, open_archive

Floats = NDArray[np.float64]

RAW_PRODUCTS = ("raw_coarse", "raw_fine", "raw_again")  # of a run
BESIDE = ("dark", "white", "bad", "flat")  # what a cube's name is followed by in those of its frames
SAMPLED_LINES = 16  # looked at for byte order and bits
MOST_LINES_OVER = 0.5  # share of numbers above full scale that says the byte order is wrong, if swapped ones fit
SWAPPED_OVER = 0.01
SAME_PERIOD = 0.01


@dataclass(frozen=True)
class Recording:
    """A recording, opened; no line has been read.

    ``camera`` is the one given, with the samples, bits, exposure and period that the recording has; of a scan without a
    mirror its lens is so long that lines are parallel.
    """

    name: str
    sweeps: tuple[RecordedSweep, ...]
    wavelength_nm: Floats  # (band,)
    fwhm_nm: Floats | None  # (band,)
    camera: LineCamera
    has_mirror: bool
    notes: tuple[str, ...]
    light: tuple[str, ...]  # what the numbers are known by without reading them: a manifest's hash, or file stamps

    def key(self) -> dict[str, Any]:
        """Give what captures from the recording depend on: lines, references, bands and light, but no place or name."""
        arrays = [
            array
            for one in self.sweeps
            for array in (one.position, one.time_s, one.exposure_ms, one.valid_line, *_frames(one.references))
        ]
        return {
            "light": list(self.light),
            "sweeps": [asdict(one.sweep) for one in self.sweeps],
            "lines": [array_digest(array) for array in arrays],
            "by_mirror": [one.references.by_mirror for one in self.sweeps],
            "wavelength_nm": self.wavelength_nm.tolist(),
        }

    def source(self, field_shape: tuple[int, int] | None = None) -> RecordedSource:
        """Give it as a source of lines for a field of (y, x) px; None takes the field that the sweeps cover.

        Raises SceneError: the sweeps cover no common field.
        """
        if field_shape is None:
            sweeps, tangents = [one.sweep for one in self.sweeps], [one.tangents for one in self.sweeps]
            field_shape = covered_field(sweeps, tangents, self.camera).shape
        return RecordedSource(self.sweeps, self.camera, self.wavelength_nm, field_shape, notes=self.notes)


@dataclass(frozen=True)
class RecordedWith:
    """What a user says of the files of a recording; None is looked for beside them, or assumed with a note."""

    pointing: Path | None = None  # a table or vector, or a folder with one for each cube
    dark: Path | None = None
    white: Path | None = None
    wavelengths: Sequence[float] | None = None  # of all bands [nm]
    panel: ArrayLike = 1.0  # value of the white reference, one or (band,)
    white_at_rest: bool = False  # the white frame was taken with the mirror at rest
    mounting: Mounting = STRAIGHT  # of the device whose positions the pointing has
    pixel_m: float | None = None  # metres a pixel on the ground, for positions in metres
    samples: int | None = None  # of a line that is not binned; None takes those of the widest cube


def open_recording(
    address: str | Path, camera: LineCamera | None = None, given: RecordedWith | None = None
) -> Recording:
    """Open a recording; ``camera`` None takes the default camera.

    Raises SceneError: there is no recording, or files or pointing cannot be used; WavelengthError: nothing says the
    wavelengths; SettingsError: something is given for an archive, whose cubes bring it; ArchiveError,
    IncompleteStoreError: the archive cannot be read, or its raw cubes were cleared away; PoseError: a position of a
    raw cube is beyond the mirror.
    """
    camera, given = camera or LineCamera(), given or RecordedWith()
    stores = find_raw_cubes(address)
    if stores is None:
        return _open_files(Path(address), camera, given)
    for name in ("pointing", "dark", "white", "wavelengths"):
        if getattr(given, name) is not None:
            raise SettingsError(
                f"--{name} is for files, and {address} holds raw cubes, which bring their own; leave --{name} out"
            )
    cubes = [open_raw_cube(path) for path in stores]
    first = cubes[0]
    for path, cube in zip(stores, cubes, strict=True):
        if not np.array_equal(cube.wavelength_nm, first.wavelength_nm):
            raise SceneError(f"{path} has other bands than {stores[0]}; name the raw cubes of one survey")
    sweeps = tuple(_of_raw_cube(cube) for cube in cubes)
    if given.samples is not None:
        camera = replace(camera, samples=given.samples)
    light = tuple(_light_of_store(path) for path in stores)
    return Recording(str(address), sweeps, first.wavelength_nm, first.fwhm_nm, camera, True, (), light)


def _frames(references: References) -> list[NDArray[Any]]:
    frames = (references.dark, references.white, references.panel, references.bad, references.flat)
    return [np.zeros(0) if frame is None else frame for frame in frames]


def _light_of_store(path: Path) -> str:
    """The hash of the manifest of the capture that a raw cube lies in, with its name; stamps of its files without."""
    if (path.parent / MANIFEST_NAME).is_file():
        return f"{path.name} {manifest_sha256(path.parent)}"
    return " ".join(_stamps(sorted(file for file in path.rglob("*") if file.is_file())))


def _stamps(files: Iterable[Path]) -> list[str]:
    """Name, size and time of change of files."""
    return [f"{file.name}:{file.stat().st_size}:{file.stat().st_mtime_ns}" for file in files]


def _of_raw_cube(cube: RawCube) -> RecordedSweep:
    return RecordedSweep(
        cube.sweep, cube.references, cube.position, cube.time_s, cube.exposure_ms, cube.valid_line, cube.read_lines
    )


def find_raw_cubes(address: str | Path) -> list[Path] | None:
    """Find the raw cubes that an address stands for, in the order of their names; None where it is no such address.

    Raises ArchiveError: the archive has no run of that name, or no run with raw cubes; as `Archive.locate` where they
    are gone.
    """
    named = _named_run(address)
    if named is not None:
        return _run_with_cubes(*named)[2]
    path = Path(address)
    if not path.exists():
        raise SceneError(f"there is no recording {path}; check the name (seen from {Path.cwd()})")
    if not path.is_dir():
        return None
    if _is_raw_cube(path):
        return [path]
    return sorted(one for one in path.glob("*.zarr") if _is_raw_cube(one)) or None


def _is_raw_cube(path: Path) -> bool:
    """Whether a folder is a store that a survey wrote its lines into; other stores are judged by who reads them."""
    if not (path / "zarr.json").is_file():
        return False
    try:
        return "sweep" in open_group(path).attrs
    except IncompleteStoreError:
        return False


def find_recorded_run(address: str | Path) -> tuple[Run, tuple[int, int] | None] | None:
    """Find the run of an archive whose raw cubes an address stands for, with its field's (y, x) size where known.

    None of addresses that stand for no run. Raises SceneError, ArchiveError: as `find_raw_cubes`.
    """
    named = _named_run(address)
    if named is None:
        if not Path(address).exists():
            raise SceneError(f"there is no recording {address}; check the name (seen from {Path.cwd()})")
        return None
    archive, run, _ = _run_with_cubes(*named)
    for row in run.stages:
        if row.get("name") == "attend":
            grid = read_store(archive.ref("attend", str(row.get("key")))).params.get("grid", {})
            if {"height", "width"} <= set(grid):
                return run, (int(grid["height"]), int(grid["width"]))
    return run, None


def _named_run(address: str | Path) -> tuple[str, str | None] | None:
    """The archive and the run, where one is named, that an address stands for; None where it is no such address."""
    text = str(address).rstrip("/")
    place, _, run = text.rpartition("/runs/")
    if place and run and is_archive(place):
        return place, run
    return (text, None) if is_remote(text) or (Path(text) / "stages").is_dir() else None


def _run_with_cubes(address: str, name: str | None) -> tuple[Archive, Run, list[Path]]:
    """A run of an archive with its raw cubes, the newest that has some where none is named."""
    archive = open_archive(address, create=False, write=False)
    folders = archive.runs()
    if name is not None and name not in [folder.name for folder in folders]:
        known = ", ".join(folder.name for folder in folders[-5:]) or "none"
        raise ArchiveError(f"{archive.name} has no run {name!r}; its latest are {known}")
    for folder in reversed(folders):
        if name in (None, folder.name):
            run = read_run(folder, {})
            stores = [archive.locate(run.products[product]) for product in RAW_PRODUCTS if product in run.products]
            cubes = [path for store in stores for path in sorted(store.glob("*.zarr"))]
            if cubes:
                return archive, run, cubes
    which = "no run" if name is None else f"the run {name}"
    raise ArchiveError(f"{archive.name}: {which} has raw cubes; survey into the archive first, or name another run")


# --- files ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RecordedFile:
    """One cube of files and what belongs to it."""

    name: str
    path: Path
    source: CubeSource

    @property
    def folder(self) -> Path:
        """Where its companions lie."""
        return self.path if self.path.is_dir() and find_zarr_store(self.path) is None else self.path.parent


def _open_files(path: Path, camera: LineCamera, given: RecordedWith) -> Recording:
    """Open cubes of files with their pointing and reference frames."""
    cubes = [_open_file(one, given.wavelengths) for one in find_cubes(path)]
    _check_bands(cubes)
    notes = [note for cube in cubes for note in (*cube.source.notes, cube.source.bands.origin) if note]
    samples = given.samples or max(cube.source.shape[1] for cube in cubes)
    camera = _fitting_bits(replace(camera, samples=samples), cubes, notes)
    pointing = [_point(cube, camera, given, notes, alone=len(cubes) == 1) for cube in cubes]
    without = [one is None or one.kind in WITHOUT_MIRROR for one in pointing]
    if any(without) and len(cubes) > 1:
        cube = cubes[without.index(True)]
        what = "no pointing" if pointing[without.index(True)] is None else "places along a scan without a mirror"
        raise SceneError(
            f"{cube.path} has {what}, and how {len(cubes)} cubes lie beside each other is not known; give mirror "
            "positions or viewing angles for each cube, or name one cube"
        )
    if any(without):
        camera, pointing = _without_mirror(cubes[0], pointing[0], camera, given.pixel_m, notes)
    camera = _timed(camera, cubes, pointing, notes)
    sweeps = [
        sweep
        for cube, one in zip(cubes, pointing, strict=True)
        if one is not None
        for sweep in _sweeps_of(cube, one, camera, given, notes)
    ]
    bands = cubes[0].source.bands
    assert bands.wavelength_nm is not None
    unique = tuple(dict.fromkeys(notes))
    light = tuple(_stamps(file for cube in cubes for file in cube.source.files))
    return Recording(
        str(path), tuple(sweeps), bands.wavelength_nm, bands.fwhm_nm, camera, not any(without), unique, light
    )


def find_cubes(path: Path) -> list[Path]:
    """Find the cubes that an address of files stands for: itself, or the ENVI cubes or Zarr stores of a folder.

    Raises SceneError: the folder holds none.
    """
    if not path.is_dir() or find_zarr_store(path) is not None:
        return [path]
    headers = sorted(entry for entry in path.iterdir() if entry.suffix.lower() == ".hdr" and entry.is_file())
    if any(entry.name.lower().startswith("raw_") for entry in headers):
        return [path]  # parts of a Headwall camera's cube
    cubes = [entry for entry in headers if not _is_frame(entry)]
    stores = sorted(entry for entry in path.iterdir() if entry.is_dir() and find_zarr_store(entry) == entry)
    if not cubes and not stores:
        raise SceneError(f"{path} holds no cube; expected ENVI headers (.hdr), raw_<frame> files or Zarr stores in it")
    return cubes or stores


def _is_frame(header: Path) -> bool:
    stem = _stem(header).lower()
    return stem.startswith(("dark", "white")) or stem.rpartition(".")[2] in BESIDE


def _stem(path: Path) -> str:
    """Name of a cube without the endings of its files."""
    stem = path.name.removesuffix(path.suffix) if path.suffix.lower() == ".hdr" else path.name
    ending = Path(stem).suffix
    return stem.removesuffix(ending) if ending.lower() in (*filter(None, DATA_ENDINGS), ".zarr") else stem


def _open_file(path: Path, wavelengths: Sequence[float] | None) -> RecordedFile:
    """Open one cube of whole numbers with wavelengths."""
    source = open_cube(path)
    if reader_of(path) == "envi":
        header, data = find_envi_pair(path)
        said, ending = load_envi_header(header).interleave, data.suffix.lower().removeprefix(".")
        if ending in INTERLEAVES and ending != said and source.shape[2] > 1:
            raise SceneError(
                f"{header} says interleave = {said}, and the name of {data.name} says {ending}; correct the header, or "
                "rename the file"
            )
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


def _check_bands(cubes: Sequence[RecordedFile]) -> None:
    first = cubes[0].source.bands.wavelength_nm
    for cube in cubes[1:]:
        if not np.array_equal(cube.source.bands.wavelength_nm, first):  # type: ignore[arg-type]
            raise SceneError(f"{cube.path} has other wavelengths than {cubes[0].path}; record them by themselves")


def _fitting_bits(camera: LineCamera, cubes: Sequence[RecordedFile], notes: list[str]) -> LineCamera:
    """The camera with as many bits as the numbers have, by some lines of each cube.

    Raises SceneError: most numbers are above full scale, and would not be with their bytes swapped; or some are below
    0.
    """
    bits = camera.bits
    for cube in cubes:
        valid = np.flatnonzero(cube.source.valid)
        chosen = valid[:: max(len(valid) // SAMPLED_LINES, 1)][:SAMPLED_LINES]
        values = np.concatenate([cube.source.read(int(line), int(line) + 1) for line in chosen])
        full = camera.full_scale_dn * max(camera.samples // cube.source.shape[1], 1)
        over, swapped = (float((numbers.view(np.uint16) > full).mean()) for numbers in _both_orders(values))
        if over > MOST_LINES_OVER and swapped < SWAPPED_OVER:
            raise SceneError(
                f"{cube.source.files[0]} has the wrong byte order: {over:.0%} of its numbers are above the camera's "
                f"full scale of {full}, and {swapped:.0%} are with their bytes swapped. Write the other byte order (0 "
                "or 1) into the header"
            )
        if values.min() < 0:
            raise SceneError(
                f"{cube.path} holds the number {values.min()}, expected a camera's own numbers from 0; write data type "
                "12 (unsigned) into the header if they are unsigned"
            )
        if values.max() > full:
            needed = (int(values.max()) * camera.full_scale_dn // full).bit_length()
            if needed > bits:
                bits = needed
                notes.append(f"{cube.name}: numbers reach {values.max()}, so {bits} bits are taken for camera.bits")
    return replace(camera, bits=bits)


def _both_orders(values: NDArray[np.generic]) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """16-bit numbers as they are and with their bytes swapped; those of 8 bits have one order."""
    plain = np.ascontiguousarray(values).astype(np.uint16)
    return plain, plain if values.dtype.itemsize == 1 else plain.byteswap()


def _point(
    cube: RecordedFile, camera: LineCamera, given: RecordedWith, notes: list[str], *, alone: bool
) -> LinePointing | None:
    """The pointing of a cube by the file given, one named like the cube, or none."""
    file, lines = given.pointing, cube.source.shape[0]
    if file is not None and file.is_dir():
        folder, names = file, [f"{cube.name}{middle}{end}" for middle in ("", ".pointing") for end in ENDINGS]
        file = next((folder / name for name in names if (folder / name).is_file()), None)
        if file is None:
            raise SceneError(f"{folder} has no pointing for {cube.name}; add {names[0]}, or name one table for all")
    if file is None:
        file = find_pointing(cube.folder, cube.name)
    if file is None:
        return None
    if not file.is_file():
        raise SceneError(f"there is no pointing table {file}; check the name (seen from {Path.cwd()})")
    notes.append(f"{cube.name}: pointing from {file.name}")
    if file.suffix.lower() == ".toml":
        middle_s = _middle_s(cube.source, None, camera, [])
        found = follow_vector(load_played_vector(file, given.mounting), middle_s, str(file))
    else:
        found = load_pointing_table(file).of_cube(cube.name, lines, given.mounting, alone=alone)
    notes.extend(f"{cube.name}: {note}" for note in found.notes)
    return found


def _without_mirror(
    cube: RecordedFile, pointing: LinePointing | None, camera: LineCamera, pixel_m: float | None, notes: list[str]
) -> tuple[LineCamera, list[LinePointing | None]]:
    """Camera and pointing of a straight scan without a mirror: its middle is the field's centre."""
    lines = cube.source.shape[0]
    if pointing is None:
        notes.append(f"{cube.name} has no pointing: taken as an even straight scan along y with one pixel a line")
        pointing = LinePointing("px", np.arange(lines, dtype=np.float64)[:, None], np.ones(lines, np.bool_))
    scan_px = pointing.position[:, 0]
    if pointing.kind == "m":
        apart = np.diff(scan_px[pointing.valid]) / np.diff(np.flatnonzero(pointing.valid))
        line_m = abs(float(np.median(apart))) if len(apart) else 0.0
        if pixel_m is None and not line_m:
            raise SceneError(f"the lines of {cube.name} do not move; give the positions of a scan")
        if pixel_m is None:
            notes.append(f"{cube.name}: a pixel is taken to be as long as lines are apart, {line_m:g} m")
        scan_px = scan_px / (line_m if pixel_m is None else pixel_m)
    scan_px = scan_px - (scan_px.min() + scan_px.max()) / 2
    camera = flat_camera(camera, float(np.abs(scan_px).max()))
    return camera, [replace(pointing, position=flat_positions(scan_px, camera))]


def _timed(
    camera: LineCamera, cubes: Sequence[RecordedFile], pointing: Sequence[LinePointing | None], notes: list[str]
) -> LineCamera:
    """The camera with the exposure and period of the recording, where these are known and others."""
    exposures, periods = [], []
    for cube, one in zip(cubes, pointing, strict=True):
        known = cube.source.lines.exposure_ms if one is None or one.exposure_ms is None else one.exposure_ms
        if known is not None and np.isfinite(known).any():
            exposures.append(float(np.nanmedian(known)))
        times = cube.source.lines.time_s if one is None or one.time_s is None else one.time_s
        if times is not None and np.count_nonzero(np.isfinite(times)) > 1:
            at = np.flatnonzero(np.isfinite(times))
            periods.append(float(np.median(np.diff(times[at]) / np.diff(at))) * 1e3)
    if exposures and camera.exposure_ms not in exposures:
        camera = replace(camera, exposure_ms=exposures[0])
    if periods and abs(periods[0] - camera.frame_ms) > SAME_PERIOD * camera.frame_ms:
        period = max(periods[0], camera.exposure_ms)
        rate = max(camera.max_rate_hz, 1000 / period)
        camera = replace(camera, readout_ms=period - camera.exposure_ms, max_rate_hz=rate)
        notes.append(f"lines follow each other every {period:.6g} ms, by their times")
    return camera


def _sweeps_of(
    cube: RecordedFile, pointing: LinePointing, camera: LineCamera, given: RecordedWith, notes: list[str]
) -> list[RecordedSweep]:
    """The sweeps of one cube: one, or those that its pointing table cuts it into."""
    source = cube.source
    valid = source.valid & pointing.valid
    time_s = _middle_s(source, pointing.time_s, camera, notes)
    exposure_ms = _exposures(source, pointing.exposure_ms, camera, cube.name, notes)
    references = _references(cube, camera, given, notes)
    names = (cube.name,) if pointing.part is None else tuple(name for name in dict.fromkeys(pointing.part) if name)
    sweeps: list[RecordedSweep] = []
    for name in names:
        own = np.arange(source.shape[0])
        if pointing.part is not None:
            own = np.flatnonzero(np.array(pointing.part) == name)
        position, samples = pointing.position[own], source.shape[1]
        scan = fit_sweep(position, camera, name=name, samples=samples, along=_line_axis(cube), valid=valid[own])
        exposed = float(np.median(exposure_ms[own]))
        sweep: Sweep = replace(scan.sweep, exposure_ms=None if exposed == camera.exposure_ms else exposed)
        if abs(scan.distance_px - sweep.step) > 1e-3 * sweep.step:
            notes.append(f"{name}: lines lie {scan.distance_px:.6g} px apart")
        sweeps.append(
            RecordedSweep(
                sweep,
                references,
                pointing.position[own],
                time_s[own],
                exposure_ms[own],
                valid[own],
                _line_reader(source, own),
            )
        )
    return sweeps


def _line_axis(cube: RecordedFile) -> Axis:
    """The axis of the field that lines lie along: as an ENVI header says, else x."""
    if reader_of(cube.path) != "envi":
        return "x"
    said = load_envi_header(find_envi_pair(cube.path)[0]).fields.get("line axis", "x").strip()
    if said not in ("x", "y"):
        raise SceneError(f"{cube.path} says line axis = {said!r}, expected x or y; correct the header")
    return "y" if said == "y" else "x"


def _line_reader(source: CubeSource, own: NDArray[np.intp]) -> Callable[[NDArray[np.intp]], NDArray[np.uint16]]:
    """Reader of single lines of a sweep, whose lines are the lines ``own`` of the cube."""

    def read_lines(numbers: NDArray[np.intp]) -> NDArray[np.uint16]:
        lines = np.concatenate([source.read(first, stop) for first, stop in line_runs(own[numbers])])
        if lines.dtype.kind == "i" and lines.min() < 0:
            raise SceneError(
                f"{source.name} holds the number {lines.min()}, expected a camera's own numbers from 0; write data "
                "type 12 (unsigned) into the header if they are unsigned"
            )
        return lines.astype(np.uint16)

    return read_lines


def _middle_s(source: CubeSource, stated_s: Floats | None, camera: LineCamera, notes: list[str]) -> Floats:
    """(line,) times of mid exposure since the first exposure began: as stated, by the files' stamps, or even."""
    at = np.arange(source.shape[0])
    if stated_s is None and source.lines.time_s is not None:
        exposure_ms = camera.exposure_ms
        if source.lines.exposure_ms is not None:
            exposure_ms = float(np.nanmedian(source.lines.exposure_ms))
        stated_s = source.lines.time_s + exposure_ms * 5e-4
        notes.append("frames are taken to be stamped as their exposure begins")
    if stated_s is None or not np.isfinite(stated_s).any():
        notes.append(f"nothing says when lines were taken: one every {camera.frame_ms:g} ms is assumed")
        return np.asarray(camera.mid_exposure_s(at.astype(np.float64)))
    known = np.isfinite(stated_s)
    return stated_s if known.all() else np.interp(at, at[known], stated_s[known])


def _exposures(source: CubeSource, stated_ms: Floats | None, camera: LineCamera, name: str, notes: list[str]) -> Floats:
    """(line,) exposures [ms]: as stated, by the files, or the camera's."""
    known = source.lines.exposure_ms if stated_ms is None else stated_ms
    if known is None:
        notes.append(f"{name}: nothing says the exposure: {camera.exposure_ms:g} ms is assumed")
        return np.full(source.shape[0], camera.exposure_ms)
    return np.where(np.isfinite(known), known, np.nanmedian(known))


# --- reference frames -------------------------------------------------------------------------------------------------


def _references(cube: RecordedFile, camera: LineCamera, given: RecordedWith, notes: list[str]) -> References:
    """Dark and white frames of a cube: given, beside it, in its folder, in itself, or assumed with a note.

    Raises SceneError: a frame has other samples or bands than the cube.
    """
    source, frame = cube.source, cube.source.shape[1:]
    binning = max(camera.samples // frame[0], 1)
    files = {kind: _frame_file(cube, kind, given) for kind in BESIDE}
    found = {kind: _load_fitting(file, frame, kind, notes) for kind, file in files.items() if file is not None}
    dark, white = found.get("dark", source.dark), found.get("white", source.white)
    measured = dark is not None and white is not None
    if dark is None:
        dark = np.zeros(frame, np.float32)
        notes.append(f"{cube.name} has no dark frame: a dark level of 0 is assumed; give --dark")
    if white is None:
        white = np.full(frame, camera.full_scale_dn * binning, np.float32)
        notes.append(
            f"{cube.name} has no white frame: full scale ({camera.full_scale_dn * binning} DN) is assumed to be white, "
            "and values are relative; give --white"
        )
    bad = found.get("bad", source.bad)
    if bad is None and measured and files["bad"] is None:
        bad = find_bad_elements(dark, white)
    panel, by_mirror = _white_reference(files["white"], source, given)
    return References(
        dark,
        white,
        panel,
        None if bad is None or not np.any(bad) else np.asarray(bad, np.bool_),
        found.get("flat", source.flat),
        by_mirror,
    )


def _frame_file(cube: RecordedFile, kind: str, given: RecordedWith) -> Path | None:
    """The file of a frame by the flag, by the cube's name, or by the folder's only one of the kind."""
    if kind in ("dark", "white") and (stated := getattr(given, kind)) is not None:
        return Path(stated)
    beside = next(
        (file for ending in (".hdr", ".npy") if (file := cube.folder / f"{cube.name}.{kind}{ending}").is_file()), None
    )
    return find_reference(cube.folder, kind) if beside is None and kind in ("dark", "white") else beside


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


def _white_reference(file: Path | None, source: CubeSource, given: RecordedWith) -> tuple[NDArray[np.float32], bool]:
    """Value of the white reference per band, and whether it was taken at rest: by its header, else as given."""
    bands = source.shape[2]
    panel = np.asarray(given.panel if source.panel is None else source.panel, np.float32)
    if panel.shape not in ((), (bands,)):
        raise SceneError(
            f"the white reference has {panel.shape} values, the cube {bands} bands; give one or one a band"
        )
    by_mirror = given.white_at_rest or source.position is not None
    if file is not None and reader_of(file) == "envi":
        fields = load_envi_header(find_envi_pair(file)[0]).fields
        said = listed_numbers(fields, "panel", bands, [])
        panel = panel if said is None else said.astype(np.float32)
        by_mirror = by_mirror or fields.get("mirror at rest", "0").strip() == "1"
    return np.broadcast_to(panel, bands).copy(), by_mirror

"""Open recordings: sweeps of an archive, or of files with a pointing table (layouts: docs/reference/recordings.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.capture.recorded import RecordedSweep, Recording, line_runs
from spectralzoom.pipeline.capture.straight_scans import fit_sweep, flat_camera
from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, SceneError, SettingsError
from spectralzoom.pipeline.exposures import all_alike, span_text
from spectralzoom.pipeline.geometry.camera import LARGEST_SUM_DN, LineCamera
from spectralzoom.pipeline.geometry.mirror import STRAIGHT, Mounting
from spectralzoom.pipeline.geometry.scan import Floats, Sweep, scan_positions
from spectralzoom.pipeline.ground.georeference import geobox_of_record
from spectralzoom.pipeline.signal.line_faults import (
    BEYOND,
    CURE,
    NO_EXPOSURE,
    beyond_mirror,
    counted,
    leave_out,
    wild_exposures,
)
from spectralzoom.storage.arrays.cubes import RawCube
from spectralzoom.storage.arrays.layout import array_of, open_group
from spectralzoom.storage.arrays.signal_cubes import RestoredCube, open_lines
from spectralzoom.storage.readers.array_files import lost_chunks
from spectralzoom.storage.readers.cube_sources import CubeSource
from spectralzoom.storage.readers.pointing_tables import WITHOUT_MIRROR, LinePointing, find_pointing, load_pointing
from spectralzoom.storage.readers.recorded_files import FileCube, find_cubes, open_file_cube, references_of, with_bits
from spectralzoom.storage.readers.user_files import OpenedFiles, files_below, reading_files
from spectralzoom.storage.runs import LINE_PRODUCTS, Run, read_run
from spectralzoom.storage.store import MANIFEST, Archive, check_store, damage, is_archive, try_manifest
from spectralzoom.storage.whole_files import sha256

SAME_PERIOD = 0.01
RESTORED = "the raw lines were deleted: these are restored from the stored signal"


def stores_of_lines(products: Mapping[str, str], is_there: Callable[[str], bool]) -> list[str]:
    """Return the addresses of the stores with a run's lines: raw ones, or condensed ones if raw ones were cleared.

    Later passes are condensed together with the first.
    """
    raw = [products[name] for name in LINE_PRODUCTS if name in products]
    condensed = [products[name] for name in reversed(LINE_PRODUCTS.values()) if name in products]
    return raw if all(map(is_there, raw)) else condensed[:1] or raw


@reading_files()
def open_recording(
    address: str | Path,
    camera: LineCamera | None = None,
    *,
    pointing: Path | None = None,
    dark: Path | None = None,
    white: Path | None = None,
    wavelengths: Sequence[float] | None = None,
    white_reference: ArrayLike = 1.0,
    mounting: Mounting = STRAIGHT,
) -> Recording:
    """Open a recording, by default with the default camera.

    For files, ``pointing`` is a table or a folder with one for each cube; it and the frames ``dark`` and ``white`` are
    looked for beside the cubes, or assumed with a note. ``wavelengths`` [nm] are of all bands, ``white_reference`` is
    the value of the white reference, one or (band,), and ``mounting`` is of the device whose positions the pointing
    has. Raises SceneError, WavelengthError: files cannot be used; SettingsError: a flag is given for an archive;
    ArchiveError, IncompleteStoreError, PoseError: the archive or a raw cube cannot be used.
    """
    camera = camera or LineCamera()
    path = Path(address)
    if (of_archive := _run_with_cubes(address)) is not None:
        stores = of_archive[2]
    else:
        beside = [path] if _is_raw_cube(path) else sorted(path.glob("*.zarr"))
        stores = [one for one in beside if _is_raw_cube(one)]
    flags = {"pointing": pointing, "dark": dark, "white": white, "wavelengths": wavelengths}
    if not stores:
        paths = find_cubes(path)
        opened = [open_file_cube(one, wavelengths, {"dark": dark, "white": white}) for one in paths]
        cubes = [_point(one, pointing, mounting, len(paths) == 1) for one in opened]
        return _recording_of(dict(zip(paths, cubes, strict=True)), camera, white_reference)
    if (flag := next((name for name, value in flags.items() if value is not None), None)) is not None:
        raise SettingsError(
            f"--{flag} is for files, and {address} holds raw cubes, which have their own; leave --{flag} out"
        )
    return _stored_recording(stores, camera)


def _stored_recording(stores: Sequence[Path], camera: LineCamera) -> Recording:
    """Open raw cubes, or condensed sweeps, of an archive."""
    for folder in {path.parent for path in stores if (path.parent / MANIFEST).is_file()}:
        check_store(folder)
    with reading_files() as opened:
        light = tuple(_content_of(path, opened) for path in stores)
        cubes = [open_lines(path) for path in stores]
    first = cubes[0]
    for path, cube in zip(stores, cubes, strict=True):
        if not np.array_equal(cube.wavelength_nm, first.wavelength_nm):
            raise SceneError(f"{path} has other bands than {stores[0]}; name the raw cubes of one survey")
        if "dn" in cube.group and (lost := lost_chunks(array_of(cube.group, "dn"))[0]):
            raise IncompleteStoreError(f"{path}/dn lacks {lost} of its chunks, whose lines would be 0; copy it again")
    notes = [RESTORED] if any(isinstance(cube, RestoredCube) for cube in cubes) else []
    sweeps = tuple(
        replace(one, read_lines=opened.guarded(one.read_lines))
        for one in (_stored_sweep(path, cube, notes) for path, cube in zip(stores, cubes, strict=True))
    )
    camera = _exposing(camera, [float(np.nanmedian(one.exposure_ms)) for one in sweeps if one.valid_line.any()])
    return Recording(sweeps, camera, first.wavelength_nm, first.fwhm_nm, tuple(notes), light)


def _stored_sweep(path: Path, cube: RawCube, notes: list[str]) -> RecordedSweep:
    """Return the sweep of a raw cube; lines that cannot be are not valid, and have the usual exposure (SceneError)."""
    wild = wild_exposures(cube.exposure_ms, cube.valid_line)
    beyond = beyond_mirror(cube.position)
    faults = counted((what, cube.valid_line & one) for what, one in ((NO_EXPOSURE, wild), (BEYOND, beyond & ~wild)))
    valid, more = leave_out(path.name, cube.valid_line, faults, CURE)
    usual = float(np.median(cube.exposure_ms[~wild])) if not wild.all() else 1.0
    exposure_ms = np.where(wild, usual, cube.exposure_ms)
    references, varies = cube.references, not all_alike(exposure_ms)
    if varies and references.exposure_ms is None and not isinstance(cube, RestoredCube):
        references = replace(references, exposure_ms=usual)
        more.append(f"{path.name}: white is taken to have {usual:g} ms")
    if varies:
        more.append(f"{path.name}: lines of {span_text(exposure_ms)} are scaled to the exposure of white")
    notes += more
    position = np.where(beyond[:, None], np.nan, cube.position)
    return RecordedSweep(cube.sweep, references, position, cube.time_s, exposure_ms, valid, cube.read_lines)


def _content_of(path: Path, opened: OpenedFiles) -> str:
    """Return the hash of a raw cube: of its store's manifest in an archive, elsewhere of each file."""
    if (path.parent / MANIFEST).is_file():
        return f"{path.name} {sha256(path.parent / MANIFEST)}"
    return " ".join(f"{file.relative_to(path)}:{opened.digest(file)}" for file in files_below(path))


def _exposing(camera: LineCamera, exposures_ms: Sequence[float]) -> LineCamera:
    """Return the camera with the exposure of a recording, if known."""
    kept = not exposures_ms or camera.exposure_ms in exposures_ms
    return camera if kept else replace(camera, exposure_ms=exposures_ms[0])


def _recording_of(files: Mapping[Path, FileCube], camera: LineCamera, white_reference: ArrayLike) -> Recording:
    """Return cubes of files as a recording."""
    paths, cubes = list(files), list(files.values())
    bands = cubes[0].source.bands
    assert bands.wavelength_nm is not None
    for one, cube in files.items():
        if not np.array_equal(np.asarray(cube.source.bands.wavelength_nm), bands.wavelength_nm):
            raise SceneError(f"{one} has other wavelengths than {paths[0]}; survey them one by one")
    notes = [note for cube in cubes for note in (*cube.source.notes, cube.source.bands.origin, *cube.notes) if note]
    samples = max(cube.source.shape[1] for cube in cubes)  # the widest are not binned
    camera, more = with_bits(replace(camera, samples=samples), cubes)
    notes += more
    for path, cube in files.items():
        if cube.pointing is not None and cube.pointing.kind not in WITHOUT_MIRROR:
            continue
        if len(cubes) > 1:
            raise SceneError(
                f"{path} has no pointing of a mirror, and how {len(cubes)} cubes lie beside each other is not known; "
                "give mirror positions or viewing angles for each cube, or name one cube"
            )
        camera, cubes[0], more = _without_mirror(cube, camera)
        notes += more
    camera, more = _timed(camera, cubes)
    notes += more
    stated = any(cube.exposure_ms is not None for cube in cubes)
    sweeps: list[RecordedSweep] = []
    for cube in cubes:
        found, more = _sweeps_of(cube, camera, white_reference, stated=stated)
        sweeps += found
        notes += more
    light = tuple(cube.source.opened.digest(file) for cube in cubes for file in cube.source.files)
    unique = tuple(dict.fromkeys(notes))
    acquired = min((cube.source.acquired for cube in cubes if cube.source.acquired is not None), default=None)
    of_bands = bands.wavelength_nm, bands.fwhm_nm
    return Recording(tuple(sweeps), camera, *of_bands, unique, light, acquired, cubes[0].pixel_m)


def _point(cube: FileCube, file: Path | None, mounting: Mounting, alone: bool) -> FileCube:
    """Return a cube with its pointing by the file given, else by one with the cube's name, if there is one."""
    if file is not None and file.is_dir():
        folder = file
        file = find_pointing(folder, cube.name, ("", ".pointing"))
        if file is None:
            raise SceneError(f"{folder} has no pointing for {cube.name}; add {cube.name}.csv, or name one for all")
    file = find_pointing(cube.folder, cube.name) if file is None else file
    if file is None:
        return cube
    if not file.is_file():
        raise SceneError(f"there is no pointing table {file}; check the name (seen from {Path.cwd()})")
    pointing = load_pointing(file, cube.name, cube.source.shape[0], mounting, alone=alone)
    notes = [f"{cube.name}: pointing from {file.name}", *pointing.notes]
    stated, pointed = cube.exposure_ms, pointing.exposure_ms
    if stated is not None and pointed is not None and not all(map(all_alike, zip(stated, pointed, strict=True))):
        both = f"{span_text(pointed)}, count; the files state {span_text(stated)}"
        notes.append(f"{cube.name}: the exposures of {file.name}, {both}")
    return replace(cube, pointing=pointing, notes=tuple(notes))


def _without_mirror(cube: FileCube, camera: LineCamera) -> tuple[LineCamera, FileCube, list[str]]:
    """Return camera and cube of a straight scan without a mirror, centred on the field, and notes."""
    lines = cube.source.shape[0]
    pointing, notes = cube.pointing, []
    if pointing is None:
        notes.append(f"{cube.name} has no pointing: taken as an even straight scan along y with one pixel a line")
        pointing = LinePointing("px", np.arange(lines, dtype=np.float64)[:, None], np.ones(lines, np.bool_))
    scan_px = pointing.position[:, 0]
    if pointing.kind == "m":
        apart = np.diff(scan_px[pointing.valid]) / np.diff(np.flatnonzero(pointing.valid))
        line_m = abs(float(np.median(apart))) if len(apart) else 0.0
        if not line_m:
            raise SceneError(f"the lines of {cube.name} do not move; give the positions of a scan")
        notes.append(f"{cube.name}: a pixel is taken to be as long as lines are apart, {line_m:g} m")
        scan_px, cube = scan_px / line_m, replace(cube, pixel_m=line_m)
    scan_px = scan_px - (scan_px.min() + scan_px.max()) / 2
    camera = flat_camera(camera, float(np.abs(scan_px).max()))
    pointing = replace(pointing, position=scan_positions(0.0, scan_px, camera))
    return camera, replace(cube, pointing=pointing), notes


def _timed(camera: LineCamera, cubes: Sequence[FileCube]) -> tuple[LineCamera, list[str]]:
    """Return the camera with the exposure and period of the recording, if known, and notes."""
    exposures = [float(np.median(one.exposure_ms)) for one in cubes if one.exposure_ms is not None]
    periods: list[float] = []
    for cube in cubes:
        stated_s = None if cube.pointing is None else cube.pointing.time_s
        times = cube.source.lines.time_s if stated_s is None else stated_s
        if times is not None and np.count_nonzero(np.isfinite(times)) > 1:
            at = np.flatnonzero(np.isfinite(times))
            periods += [one for one in [float(np.median(np.diff(times[at]) / np.diff(at))) * 1e3] if one > 0]
    if not exposures and periods and periods[0] < camera.exposure_ms:  # an exposure ends before the next one begins
        exposures = [periods[0]]
    camera = _exposing(camera, exposures)
    if not periods or abs(periods[0] - camera.frame_ms) <= SAME_PERIOD * camera.frame_ms:
        return camera, []
    period = max(periods[0], camera.exposure_ms)
    rate_hz = max(camera.max_rate_hz, 1000 / period)
    camera = replace(camera, readout_ms=period - camera.exposure_ms, max_rate_hz=rate_hz)
    return camera, [f"lines follow each other every {period:.6g} ms, by their times"]


def _sweeps_of(
    cube: FileCube, camera: LineCamera, white_reference: ArrayLike, *, stated: bool
) -> tuple[list[RecordedSweep], list[str]]:
    """Return the sweep of one cube, or the sweeps that its pointing table cuts it into, and notes.

    ``stated`` is whether a file of any cube says the exposure of the camera.
    """
    source, pointing = cube.source, cube.pointing
    assert pointing is not None
    valid = source.valid & pointing.valid
    time_s, notes = _middle_s(source, pointing.time_s, camera)
    exposure_ms = cube.exposure_ms
    if exposure_ms is None:
        notes.append(f"{cube.name}: nothing says the exposure: {camera.exposure_ms:g} ms is assumed")
        exposure_ms = np.full(source.shape[0], camera.exposure_ms)
    references, more = references_of(cube, camera, exposure_ms, white_reference, stated=stated)
    notes += more
    names = (cube.name,) if pointing.part is None else tuple(name for name in dict.fromkeys(pointing.part) if name)
    sweeps: list[RecordedSweep] = []
    for name in names:
        own = np.flatnonzero(np.array(pointing.part or (name,) * source.shape[0]) == name)
        position = pointing.position[own]
        scan = fit_sweep(position, camera, name=name, samples=source.shape[1], along=cube.along, valid=valid[own])
        exposed = float(np.median(exposure_ms[own]))
        sweep: Sweep = replace(scan.sweep, exposure_ms=None if exposed == camera.exposure_ms else exposed)
        if abs(scan.distance_px - sweep.step) > 1e-3 * sweep.step:
            notes.append(f"{name}: lines lie {scan.distance_px:.6g} px apart")
        notes += [f"{name}: {scan.note}"] if scan.note else []
        lines = position, time_s[own], exposure_ms[own], valid[own]
        sweeps.append(RecordedSweep(sweep, references, *lines, _line_reader(source, own)))
    return sweeps, notes


def _line_reader(source: CubeSource, own: NDArray[np.intp]) -> Callable[[NDArray[np.intp]], NDArray[np.uint16]]:
    """Return a reader of single lines of a sweep, which are the lines ``own`` of the cube."""

    def read_lines(numbers: NDArray[np.intp]) -> NDArray[np.uint16]:
        """Return some lines (line, sample, band); numbers of no data are 65535."""
        lines = np.concatenate([source.read(first, stop) for first, stop in line_runs(own[numbers])])
        if source.nodata is not None:
            lines = np.where(lines == source.nodata, np.int32(LARGEST_SUM_DN), lines)  # out, as saturated ones
        if lines.dtype.kind == "i" and lines.min() < 0:
            raise SceneError(
                f"{source.name} holds {lines.min()}, expected a camera's own numbers from 0; write data type 12 "
                "(unsigned) into the header if they are unsigned"
            )
        return lines.astype(np.uint16)

    return read_lines


def _middle_s(source: CubeSource, stated_s: Floats | None, camera: LineCamera) -> tuple[Floats, list[str]]:
    """Return (line,) times of mid exposure since the first exposure began [s]: as stated, by stamps, or even."""
    at = np.arange(source.shape[0])
    notes: list[str] = []
    if stated_s is None and source.lines.time_s is not None:
        known_ms = camera.exposure_ms if source.lines.exposure_ms is None else source.lines.exposure_ms
        stated_s = source.lines.time_s + np.nanmedian(known_ms) * 5e-4
        notes.append("frames are taken to be stamped as their exposure begins")
    if stated_s is None or not np.isfinite(stated_s).any():
        notes.append(f"nothing says when lines were taken: one every {camera.frame_ms:g} ms is assumed")
        return np.asarray(camera.mid_exposure_s(at.astype(np.float64))), notes
    known = np.flatnonzero(np.isfinite(stated_s))
    filled = np.interp(at, known, stated_s[known])
    first, last = known[0], known[-1]
    period_s = np.median(np.diff(stated_s[known]) / np.diff(known)) if len(known) > 1 else camera.frame_ms * 1e-3
    filled[:first] += (at[:first] - first) * period_s  # beyond the known ones a line a period
    filled[last:] += (at[last:] - last) * period_s
    return filled, notes


def _is_raw_cube(path: Path) -> bool:
    """Return whether a folder is a store of a survey's lines."""
    with suppress(IncompleteStoreError):
        return (path / "zarr.json").is_file() and "sweep" in open_group(path).attrs
    return False


def find_recorded_run(address: str | Path) -> tuple[Run, tuple[int, int] | None, GeoBox | None] | None:
    """Return the run of an address, and size (y, x) and place of its field, if known; None if it is no archive's.

    Raises SceneError: there is no such file; ArchiveError: the archive has no such run, or none with raw cubes.
    """
    if (found := _run_with_cubes(address)) is None:
        return None
    archive, run, _ = found
    parts = run.products.get("mosaic", "").split("/")  # stages/STAGE/KEY/mosaic.zarr
    params = try_manifest(archive.ref(*parts[1:3]).path)[0]["params"] if len(parts) > 3 else {}
    frame = params.get("frame", {})
    grid = frame.get("grid", {})
    if not {"height", "width"} <= set(grid):
        return run, None, None
    shape = int(grid["height"]), int(grid["width"])
    return run, shape, geobox_of_record(frame, shape)


def _run_with_cubes(address: str | Path) -> tuple[Archive, Run, list[Path]] | None:
    """Return the run of an address with its raw cubes: the named one, or the newest with any; None if no archive's."""
    text = str(address).rstrip("/")
    place, _, name = text.rpartition("/runs/")
    if not (place and name and is_archive(place)):
        place, name = text, ""
        if not Path(text).exists():
            raise SceneError(f"there is no recording {address}; check the name (seen from {Path.cwd()})")
        if not (Path(text) / "stages").is_dir():
            return None
    archive = Archive.open(place, create=False, write=False)
    for folder in [archive.run_folder(name)] if name else archive.past_runs():
        run = read_run(folder)
        if run.problem is not None and (name or run.products):
            raise damage(folder, run.problem)
        stores = [archive.locate(uri) for uri in stores_of_lines(run.products, archive.is_there)]
        if cubes := [path for store in stores for path in sorted(store.glob("*.zarr"))]:
            return archive, run, cubes
    which = f"the run {name} has no" if name else "no run has"
    raise ArchiveError(f"{archive.name}: {which} raw cubes; survey into the archive first, or name another run")

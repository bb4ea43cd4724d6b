"""The stages that place lines: registration (where the mirror may err), geolocation grid, mosaic, patches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tasks.capture_plan import CapturePlan
from flows.tasks.mosaic_work import MosaicRecipe, open_sweeps, write_mosaic
from flows.tasks.stage import FieldFrame, Product, Report, Wanted, stage
from flows.tasks.stages.attention import load_plan
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import patch_pixels
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.placed import PixelGrid, Placed, TieTable
from pipeline.rectify.region import read_every_patch, read_patches
from pipeline.rectify.registration.alignment import SweepShift
from pipeline.rectify.registration.illumination import overlap_light, solve_lights
from pipeline.rectify.registration.overlaps import BroadSweep
from pipeline.rectify.registration.seams import Anchor, Registration, SeamWindow, anchor_sweep, register_sweeps
from pipeline.rectify.scan_paths import ScanPath
from pipeline.rectify.sweep_paths import SweepPath
from pipeline.signal.lines import LineCache, broad_bands
from storage.archive.keys import StageRef
from storage.archive.manifests import read_table, write_table
from storage.arrays.cubes import open_raw_cubes
from storage.arrays.geolocation import path_digest, write_geolocation
from storage.arrays.layout import NO_VALUE, blank_coarse, blank_pixels, read_array
from storage.arrays.mosaics import MosaicWriter, PatchWriter, load_mosaic, open_patches
from storage.arrays.quicklooks import Thumbnail, choose_bands, stretched
from storage.parallel.pool import WorkerPool

Values = NDArray[np.float32]
Valid = NDArray[np.bool_]
RECORD = "registration.json"
POINTING = Product("register", version=2, files=(RECORD,))


GEOLOCATION = Product("locate", version=3, files=("geolocation.zarr",))
MOSAIC = Product("rectify", version=4, files=("mosaic.zarr",))
PATCHES = Product("patches", version=5, files=("patches.zarr",), made_again=True)
QUICKLOOK_PX = 512
PATCHES_AT_ONCE = 64
CACHE_FRACTION = 8  # raw lines kept for the next patches may take this part of the memory


def record_of(registration: StageRef | None) -> Path | None:
    """Return where a registration wrote what it found."""
    return None if registration is None else registration.path / RECORD


@stage("register_coarse", "seams of the coarse sweeps", POINTING, inputs=1, named="coarse_pointing")
def register_coarse(
    raw: StageRef, *, camera: LineCamera, pointing_px: float, frame: FieldFrame, report: Report
) -> Wanted:
    """Find pointing and light of the coarse sweeps from what neighbours show twice."""

    def build(path: Path) -> None:
        """Register the sweeps by their seams, and write shifts and gains."""
        sweeps = open_sweeps(raw.path, None, camera)
        broad = [BroadSweep.read(one.lines, camera, usable=one.usable) for one in sweeps]
        report(0.4)
        found = register_sweeps(broad, camera, prior_px=pointing_px)
        report(0.8)
        placed = [replace(one, shift=found.of(one.lines.sweep.name)).placed(camera) for one in sweeps]
        gains, names = light_gains(found, placed, camera, frame.wavelength_nm), [shift.name for shift in found.shifts]
        record = {
            "method": "seams",
            "reference": found.reference,
            "sweeps": {shift.name: _shift_record(shift) | {"gain": gains.get(shift.name)} for shift in found.shifts},
            "untied": list(found.untied),
            "narrow": [asdict(narrow) for narrow in found.narrow],
            "windows": [_window_record(seen, names) for seen in found.windows],
        }
        write_table(path / RECORD, record)

    return Wanted(build, {"prior_px": pointing_px, "pass": "coarse"}, [raw])


def light_gains(
    found: Registration, placed: Sequence[Placed], camera: LineCamera, wavelength_nm: NDArray[np.float64]
) -> dict[str, list[float]]:
    """Return what each sweep's values are to be multiplied by, band by band, so that neighbours agree."""
    windows = [seen.window for seen in found.windows if seen.measured is not None]
    if not windows:
        return {}
    lights = solve_lights(overlap_light(placed, camera, windows), len(placed), wavelength_nm)
    tied = [number for number in range(len(placed)) if number not in lights.untied]
    return {placed[number].lines.sweep.name: lights.gain(number).tolist() for number in tied}


def _shift_record(shift: SweepShift) -> dict[str, Any]:
    return {"offset_px": shift.offset.tolist(), "drift_px_per_line": shift.drift.tolist()}


def _window_record(seen: SeamWindow, names: Sequence[str]) -> dict[str, Any]:
    left = seen.residual_px.tolist() if np.isfinite(seen.residual_px).all() else None
    status = "too narrow" if seen.found is None else seen.found.status
    window = seen.window
    return {
        "reference": names[window.reference],
        "moving": names[window.moving],
        "along_px": window.along_px,
        "scan_px": window.scan_px,
        "status": status,
        "residual_px": left,
    }


@stage("register_fine", "fine sweeps on the mosaic", POINTING, inputs=2, named="fine_pointing")
def register_fine(
    raw: StageRef, mosaic: StageRef, *, camera: LineCamera, pointing_px: float, frame: FieldFrame, report: Report
) -> Wanted:
    """Find where each fine sweep lies on the coarse mosaic, which itself may be off by as much."""

    def build(path: Path) -> None:
        """Lay each sweep onto the mean of the mosaic's bands, and write where it lies."""
        sweeps = open_sweeps(raw.path, None, camera)
        anchors: list[Anchor] = []
        values = load_mosaic(mosaic.path / "mosaic.zarr").values if sweeps else np.empty((0, 0, 0), np.float32)
        for number, one in enumerate(sweeps):
            under = np.asarray(values[..., broad_bands(one.lines.references)].mean(axis=-1), np.float32)
            broad = BroadSweep.read(one.lines, camera, usable=one.usable)
            anchors.append(anchor_sweep(broad, camera, frame.grid, under, prior_px=2 * pointing_px))
            report((number + 1) / len(sweeps))
        record = {
            "method": "mosaic",
            "reference": "the coarse mosaic",
            "sweeps": {one.shift.name: _shift_record(one.shift) | {"gain": None} for one in anchors},
            "untied": [one.shift.name for one in anchors if one.found.status != "found"],
            "narrow": [],
            "windows": [{"moving": one.shift.name, "status": one.found.status} for one in anchors],
        }
        write_table(path / RECORD, record)

    return Wanted(build, {"prior_px": pointing_px, "pass": "fine", "grid": asdict(frame.grid)}, [raw, mosaic])


def load_registration(registration: StageRef) -> dict[str, Any]:
    """Read what was found: by sweep the offset, drift and gain; the held sweep, those untied, and every window."""
    return read_table(registration.path / RECORD)


@stage("locate", "lookup", GEOLOCATION)
def locate(
    raw: StageRef,
    registration: StageRef | None = None,
    *,
    camera: LineCamera,
    frame: FieldFrame,
    plan: CapturePlan,
    report: Report,
) -> Wanted:
    """Look up where each coarse pixel was seen: a table that every survey along the same path shares."""
    grid = PixelGrid.of_scene(frame.grid, 1 if plan.plain else frame.grid.factor)
    sweeps = open_sweeps(raw.path, record_of(registration), camera)
    params = {
        "camera": {name: getattr(camera, name) for name in ("samples", "pitch_um", "focal_length_mm")},
        "grid": asdict(grid),
        "paths": {
            one.lines.sweep.name: {
                "path": path_digest(one.lines.position, one.usable, one.shift_px),
                **{name: getattr(one.lines.sweep, name) for name in ("along", "step", "binning")},
            }
            for one in sweeps
        },
    }

    def build(path: Path) -> None:
        """Write the tie tables of each sweep; of one that ties cannot follow, none."""
        tables: dict[str, list[tuple[ScanPath, TieTable]]] = {}
        for number, one in enumerate(sweeps):
            made = one.placed(camera, grid).scan_paths
            whole = [(scan_path, table) for scan_path, table in made if table is not None]
            # Where lines lie too unevenly for ties there is nothing to keep: such a sweep is looked up directly.
            tables[one.lines.sweep.name] = whole if len(whole) == len(made) else []
            report((number + 1) / len(sweeps))
        write_geolocation(path / "geolocation.zarr", tables, params)

    return Wanted(build, params)  # keyed by the paths, not by what was seen along them


@stage("rectify", "mosaic", MOSAIC)
def rectify(
    raw: StageRef,
    geolocation: StageRef,
    registration: StageRef | None = None,
    *,
    camera: LineCamera,
    frame: FieldFrame,
    plan: CapturePlan,
    resampling: Kernel,
    memory: int,
    pool: WorkerPool,
    report: Report,
) -> Wanted:
    """Bring the coarse sweeps onto the scene grid and blend them into one mosaic, tile by tile."""

    def build(path: Path) -> None:
        """Write mosaic and quicklook tile by tile, and what became of each sweep's lines."""
        recipe = MosaicRecipe(
            raw.path,
            camera,
            PixelGrid.of_scene(frame.grid, frame.grid.factor),
            resampling,
            geolocation=geolocation.path / "geolocation.zarr",
            registration=record_of(registration),
            finer=PixelGrid.of_scene(frame.grid, 1) if plan.plain else None,
        )
        writer = MosaicWriter(
            path / "mosaic.zarr",
            frame.grid.coarse_shape,
            frame.wavelength_nm,
            fwhm_nm=frame.fwhm_nm,
            grid=frame.angular_grid(frame.grid.factor),
            simulation=open_raw_cubes(raw.path)[0].simulation,
        )
        picture = thumbnail_of(frame)
        write_mosaic(recipe, writer, memory=memory, pool=pool, seen=picture, report=report)
        finish_mosaic(writer, picture, frame)
        write_table(path / "lines.json", {one.lines.sweep.name: one.facts() for one in recipe.sweeps()})

    params = {"grid": asdict(frame.grid), "resampling": resampling, **frame.key}
    return Wanted(build, params, [raw, geolocation, *_there(registration)])


def thumbnail_of(frame: FieldFrame) -> Thumbnail:
    """Return an empty picture of a mosaic on the coarse pixels."""
    return Thumbnail(frame.grid.coarse_shape, choose_bands(frame.wavelength_nm)[0], QUICKLOOK_PX)


def finish_mosaic(writer: MosaicWriter, picture: Thumbnail, frame: FieldFrame) -> None:
    """Take out what is no scene, and store the picture of the rest."""
    if frame.missing is not None:
        gaps = blank_coarse(frame.missing, frame.grid.factor)
        blank_pixels(writer.path, gaps, NO_VALUE)
        picture.blank(gaps)
    writer.write_quicklook(stretched(picture.image).image)


def patch_writer(path: Path, frame: FieldFrame, patch_index: NDArray[np.integer]) -> PatchWriter:
    """Begin the store of these patches, in their order."""
    return PatchWriter(
        path / "patches.zarr",
        patch_index,
        frame.grid.patch_origin(patch_index),
        frame.grid.patch,
        frame.wavelength_nm,
        fwhm_nm=frame.fwhm_nm,
        grid=frame.angular_grid(),
    )


@stage("extract_patches", "fine patches", PATCHES)
def extract_patches(
    attention: StageRef,
    raw: StageRef,
    registration: StageRef | None = None,
    *,
    camera: LineCamera,
    frame: FieldFrame,
    plan: CapturePlan,
    resampling: Kernel,
    memory: int,
    report: Report,
) -> Wanted:
    """Bring every chosen patch onto the scene grid as one array (p, p, band); NaN where nothing was seen.

    ``raw`` are the fine sweeps, or those of a uniform scan.
    """
    grid, most_bytes = frame.grid, memory // CACHE_FRACTION

    def in_order(patch_index: NDArray[np.integer]) -> NDArray[np.integer]:
        """Return patches as the sweeps pass them, so that a few of them need few lines at a time."""
        row, column = np.divmod(patch_index, grid.patch_shape[1])
        return patch_index[np.lexsort((column, row) if plan.along == "x" else (row, column))]

    def everything(sweeps: Sequence[SweepPath], wanted: NDArray[np.integer]) -> Iterator[tuple[Values, Valid]]:
        """Yield the wanted patches of a uniform scan by tables of its pixels: faster than locating each of them."""
        placed = [one.placed(camera, PixelGrid.of_scene(grid, 1)) for one in sweeps]
        among, first = np.isin(in_order(grid.valid_patches()), wanted), 0
        for values, seen in read_every_patch(placed, camera, grid, resampling, most_bytes=most_bytes):
            kept = among[first : (first := first + len(values))]
            yield (values, seen) if kept.all() else (values[kept], seen[kept])

    def some(sweeps: Sequence[SweepPath], wanted: NDArray[np.integer]) -> Iterator[tuple[Values, Valid]]:
        placed, cache = [one.placed(camera) for one in sweeps], LineCache(most_bytes)
        for first in range(0, len(wanted), PATCHES_AT_ONCE):
            yield read_patches(placed, camera, grid, wanted[first : first + PATCHES_AT_ONCE], resampling, cache=cache)

    def build(path: Path) -> None:
        """Write the patches in the order in which sweeps pass them, a batch of patches at a time."""
        patch_index, done = in_order(load_plan(attention).patch_index), 0
        writer, sweeps = patch_writer(path, frame, patch_index), open_sweeps(raw.path, record_of(registration), camera)
        for values, seen in (everything if plan.plain and len(patch_index) else some)(sweeps, patch_index):
            here = patch_index[done : (done := done + len(values))]
            if frame.missing is not None:  # no value, and no validity, where the scene has none
                gaps = patch_pixels(grid, frame.missing)[here]
                values, seen = np.where(gaps[..., None], np.float32(np.nan), values), seen & ~gaps
            writer.write(values, seen)
            report(done / len(patch_index))

    params = {"grid": asdict(grid), "resampling": resampling, **frame.key}
    return Wanted(build, params, [attention, raw, *_there(registration)])


def seen_fractions(frame: FieldFrame, patches: StageRef) -> NDArray[np.float64]:
    """How much of each patch was seen, (patch,) 0..1 of its pixels on the scene; 1 where it has none there."""
    store = open_patches(patches.path / "patches.zarr")
    seen: NDArray[np.float64] = read_array(store.group, "valid").mean(axis=(1, 2))
    there = frame.grid.valid_fraction().ravel()[store.patch_index]
    if frame.missing is not None:
        there = there - patch_pixels(frame.grid, frame.missing)[store.patch_index].mean(axis=(1, 2))
    return np.divide(seen, there, out=np.ones_like(seen), where=there > 0)


def _there(registration: StageRef | None) -> list[StageRef]:
    return [] if registration is None else [registration]

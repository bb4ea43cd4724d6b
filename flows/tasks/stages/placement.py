"""Where lines lie and what they show: registration (none where the mirror is believed), geolocation grid, mosaic, patches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tasks.run import SurveyRun
from flows.tasks.stage import Product, Wanted, stage
from flows.tasks.stages.attention import load_plan
from flows.tasks.stages.capture import captured
from pipeline.geometry.grid import patch_pixels
from pipeline.rectify.mosaic import LineCache
from pipeline.rectify.placed import PixelGrid, Placed, TieTable
from pipeline.rectify.region import read_every_patch, read_patches
from pipeline.rectify.registration.alignment import SweepShift
from pipeline.rectify.registration.illumination import overlap_light, solve_lights
from pipeline.rectify.registration.overlaps import BroadSweep, broad_bands
from pipeline.rectify.registration.seams import Anchor, Registration, SeamWindow, anchor_sweep, register_sweeps
from pipeline.rectify.scan_paths import ScanPath
from storage.archive.keys import StageRef
from storage.archive.manifests import read_table, write_table
from storage.arrays.geolocation import path_digest, write_geolocation
from storage.arrays.layout import NO_VALUE, blank_coarse, blank_pixels, read_array
from storage.arrays.mosaics import MosaicWriter, PatchWriter, load_mosaic, open_patches
from storage.arrays.quicklooks import choose_bands, stretched
from storage.arrays.tile_work import MosaicRecipe, Sighted, Thumbnail, sight_sweeps, write_mosaic

RECORD = "registration.json"
POINTING = Product("register", version=2, files=(RECORD,))


def sighted(run: SurveyRun, raw: StageRef, registration: StageRef | None) -> list[Sighted]:
    """Open the sweeps of a capture with what registration found of them."""
    return sight_sweeps(captured(raw), record_of(registration), run.camera)


def record_of(registration: StageRef | None) -> Path | None:
    """Where a registration wrote what it found."""
    return None if registration is None else registration.path / RECORD


@stage("register_coarse", "seams of the coarse sweeps", POINTING, inputs=1, named="coarse_pointing")
def register_coarse(run: SurveyRun, raw: StageRef) -> Wanted:
    """Find pointing and light of the coarse sweeps from what neighbours show twice."""
    prior = run.settings.pointing_px

    def build(path: Path) -> None:
        sweeps = sighted(run, raw, None)
        broad = [BroadSweep.read(one.cube, run.camera, usable=one.usable) for one in sweeps]
        run.report(0.4)
        found = register_sweeps(broad, run.camera, prior_px=prior)
        run.report(0.8)
        placed = [replace(one, shift=found.of(one.cube.sweep.name)).placed(run.camera) for one in sweeps]
        write_table(path / RECORD, _seams_record(found, _gains(run, found, placed)))

    return Wanted(build, {"prior_px": prior, "pass": "coarse"}, [raw])


def _gains(run: SurveyRun, found: Registration, placed: Sequence[Placed]) -> dict[str, list[float]]:
    """What each sweep's values are to be multiplied by, band by band, so that neighbours agree."""
    windows = [seen.window for seen in found.windows if seen.measured is not None]
    if not windows:
        return {}
    lights = solve_lights(overlap_light(placed, run.camera, windows), len(placed), run.scene.wavelength_nm)
    tied = [number for number in range(len(placed)) if number not in lights.untied]
    return {placed[number].lines.sweep.name: lights.gain(number).tolist() for number in tied}


def _seams_record(found: Registration, gains: dict[str, list[float]]) -> dict[str, Any]:
    names = [shift.name for shift in found.shifts]
    return {
        "method": "seams",
        "reference": found.reference,
        "sweeps": {shift.name: _shift_record(shift) | {"gain": gains.get(shift.name)} for shift in found.shifts},
        "untied": list(found.untied),
        "narrow": [asdict(narrow) for narrow in found.narrow],
        "windows": [_window_record(seen, names) for seen in found.windows],
    }


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
def register_fine(run: SurveyRun, raw: StageRef, mosaic: StageRef) -> Wanted:
    """Find where each fine sweep lies on the coarse mosaic, which itself may be off by as much."""
    prior = run.settings.pointing_px

    def build(path: Path) -> None:
        """Lay each sweep onto the mean of the mosaic's bands, and write where it lies."""
        sweeps = sighted(run, raw, None)
        anchors: list[Anchor] = []
        values = load_mosaic(mosaic.path / "mosaic.zarr").values if sweeps else np.empty((0, 0, 0), np.float32)
        for number, one in enumerate(sweeps):
            under = np.asarray(values[..., broad_bands(one.cube.references)].mean(axis=-1), np.float32)
            broad = BroadSweep.read(one.cube, run.camera, usable=one.usable)
            anchors.append(anchor_sweep(broad, run.camera, run.grid, under, prior_px=2 * prior))
            run.report((number + 1) / len(sweeps))
        record = {
            "method": "mosaic",
            "reference": "the coarse mosaic",
            "sweeps": {one.shift.name: _shift_record(one.shift) | {"gain": None} for one in anchors},
            "untied": [one.shift.name for one in anchors if one.found.status != "found"],
            "narrow": [],
            "windows": [{"moving": one.shift.name, "status": one.found.status} for one in anchors],
        }
        write_table(path / RECORD, record)

    return Wanted(build, {"prior_px": prior, "pass": "fine", "grid": asdict(run.grid)}, [raw, mosaic])


def load_registration(registration: StageRef) -> dict[str, Any]:
    """Read what was found: by sweep the offset, drift and gain; the held sweep, those untied, and every window."""
    return read_table(registration.path / RECORD)


GEOLOCATION = Product("locate", version=3, files=("geolocation.zarr",))
MOSAIC = Product("rectify", version=4, files=("mosaic.zarr",))
PATCHES = Product("patches", version=5, files=("patches.zarr",), made_again=True)
QUICKLOOK_PX = 512
PATCHES_AT_ONCE = 64
CACHE_FRACTION = 8  # raw lines kept for the next patches may take this part of the memory


@stage("locate", "lookup", GEOLOCATION)
def locate(run: SurveyRun, raw: StageRef, registration: StageRef | None = None) -> Wanted:
    """Look up where each coarse pixel was seen: a table that every survey along the same path shares."""
    grid = PixelGrid.of_scene(run.grid, 1 if run.plan.plain else run.grid.factor)
    sweeps = sighted(run, raw, registration)
    camera = {name: getattr(run.camera, name) for name in ("samples", "pitch_um", "focal_length_mm")}
    params = {
        "camera": camera,
        "grid": asdict(grid),
        "paths": {
            one.cube.sweep.name: {
                "path": path_digest(one.cube.position, one.usable, one.shift_px),
                **{name: getattr(one.cube.sweep, name) for name in ("along", "step", "binning")},
            }
            for one in sweeps
        },
    }

    def build(path: Path) -> None:
        """Write the tie tables of each sweep; of one that ties cannot follow, none."""
        tables: dict[str, list[tuple[ScanPath, TieTable]]] = {}
        for number, one in enumerate(sweeps):
            made = one.placed(run.camera, grid).scan_paths
            whole = [(scan_path, table) for scan_path, table in made if table is not None]
            # Where lines lie too unevenly for ties there is nothing to keep: such a sweep is looked up directly.
            tables[one.cube.sweep.name] = whole if len(whole) == len(made) else []
            run.report((number + 1) / len(sweeps))
        write_geolocation(path / "geolocation.zarr", tables, params)

    return Wanted(build, params)  # keyed by the paths, not by what was seen along them


@stage("rectify", "mosaic", MOSAIC)
def rectify(run: SurveyRun, raw: StageRef, geolocation: StageRef, registration: StageRef | None = None) -> Wanted:
    """Bring the coarse sweeps onto the scene grid and blend them into one mosaic, tile by tile."""

    def build(path: Path) -> None:
        """Write mosaic and quicklook tile by tile, and what became of each sweep's lines."""
        grid = PixelGrid.of_scene(run.grid, run.grid.factor)
        recipe = MosaicRecipe(
            raw.path,
            run.camera,
            grid,
            run.settings.resampling,
            geolocation=geolocation.path / "geolocation.zarr",
            registration=record_of(registration),
            finer=PixelGrid.of_scene(run.grid, 1) if run.plan.plain else None,
        )
        writer = MosaicWriter(
            path / "mosaic.zarr",
            grid.shape,
            run.scene.wavelength_nm,
            fwhm_nm=run.scene.fwhm_nm,
            grid=run.angular_grid(run.grid.factor),
            simulation=captured(raw)[0].simulation,
        )
        colours, _ = choose_bands(run.scene.wavelength_nm)
        settings, picture = run.settings, Thumbnail(grid.shape, colours, QUICKLOOK_PX)
        write_mosaic(recipe, writer, memory=settings.memory, pool=settings.pool, seen=picture, report=run.report)
        if run.scene.missing is not None:
            gaps = blank_coarse(run.scene.missing, run.grid.factor)
            blank_pixels(path / "mosaic.zarr", gaps, NO_VALUE)
            picture.blank(gaps)
        writer.write_quicklook(stretched(picture.image).image)
        write_table(path / "lines.json", {one.cube.sweep.name: one.facts() for one in recipe.sweeps()})

    params = {"grid": asdict(run.grid), "resampling": run.settings.resampling, **run.place_key}
    return Wanted(build, params, [raw, geolocation, *_there(registration)])


@stage("extract_patches", "fine patches", PATCHES)
def extract_patches(run: SurveyRun, attention: StageRef, raw: StageRef, registration: StageRef | None = None) -> Wanted:
    """Bring every chosen patch onto the scene grid, one patch a patch; NaN where nothing was seen, or is no scene.

    ``raw`` are the fine sweeps, or those of a uniform scan.
    """

    def build(path: Path) -> None:
        """Write the patches in the order in which sweeps pass them, a batch of patches at a time."""
        patch_index = load_plan(attention).patch_index
        row, column = np.divmod(patch_index, run.grid.patch_shape[1])
        # as the sweeps pass them, so that a few of them need few lines at a time
        ordered = patch_index[np.lexsort((column, row) if run.plan.along == "x" else (row, column))]
        writer = PatchWriter(
            path / "patches.zarr",
            ordered,
            run.grid.patch_origin(ordered),
            run.grid.patch,
            run.scene.wavelength_nm,
            fwhm_nm=run.scene.fwhm_nm,
            grid=run.angular_grid(),
        )
        if run.plan.plain and len(ordered):
            _cut_everything(run, sighted(run, raw, registration), writer, ordered)
            return
        cache = LineCache(run.settings.memory // CACHE_FRACTION)
        sweeps = [one.placed(run.camera) for one in sighted(run, raw, registration)]
        for first in range(0, len(ordered), PATCHES_AT_ONCE):
            patch_index = ordered[first : first + PATCHES_AT_ONCE]
            seen = read_patches(sweeps, run.camera, run.grid, patch_index, run.settings.resampling, cache=cache)
            writer.write(*_on_scene(run, patch_index, *seen))
            run.report((first + len(patch_index)) / len(ordered))

    params = {"grid": asdict(run.grid), "resampling": run.settings.resampling, **run.place_key}
    return Wanted(build, params, [attention, raw, *_there(registration)])


def _on_scene(
    run: SurveyRun, patch_index: NDArray[np.integer], values: NDArray[np.float32], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The same patches (patch, y, x, band) with NaN, and no validity, where the scene has no value."""
    if run.scene.missing is None:
        return values, valid
    gaps = patch_pixels(run.grid, run.scene.missing)[patch_index]
    return np.where(gaps[..., None], np.float32(np.nan), values), valid & ~gaps


def _cut_everything(
    run: SurveyRun, sweeps: Sequence[Sighted], writer: PatchWriter, patch_index: NDArray[np.integer]
) -> None:
    """Cut the wanted patches of a uniform scan, by tables of its pixels: many times as fast as looking each of them up."""
    placed = [one.placed(run.camera, PixelGrid.of_scene(run.grid, 1)) for one in sweeps]
    done, first, every = 0, 0, run.grid.valid_patches()
    row, column = np.divmod(every, run.grid.patch_shape[1])
    wanted = np.isin(every[np.lexsort((column, row) if run.plan.along == "x" else (row, column))], patch_index)
    most_bytes = run.settings.memory // CACHE_FRACTION
    for values, seen in read_every_patch(placed, run.camera, run.grid, run.settings.resampling, most_bytes=most_bytes):
        kept = wanted[first : first + len(values)]
        first += len(values)
        if not kept.all():
            values, seen = values[kept], seen[kept]
        writer.write(*_on_scene(run, patch_index[done : done + len(values)], values, seen))
        done += len(values)
        run.report(done / len(patch_index))


def seen_fractions(run: SurveyRun, patches: StageRef) -> NDArray[np.float64]:
    """How much of each patch was seen, (patch,) 0..1 of its pixels on the scene; 1 where it has none there."""
    store = open_patches(patches.path / "patches.zarr")
    seen: NDArray[np.float64] = read_array(store.group, "valid").mean(axis=(1, 2))
    there = run.grid.valid_fraction().ravel()[store.patch_index]
    if run.scene.missing is not None:
        there = there - patch_pixels(run.grid, run.scene.missing)[store.patch_index].mean(axis=(1, 2))
    return np.divide(seen, there, out=np.ones_like(seen), where=there > 0)


def _there(registration: StageRef | None) -> list[StageRef]:
    return [] if registration is None else [registration]


def line_facts(mosaic: StageRef) -> dict[str, dict[str, Any]]:
    """Read, by sweep, how many lines were lost, repeated, out of order, late or invalid."""
    return read_table(mosaic.path / "lines.json")

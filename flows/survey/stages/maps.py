"""The stages that draw maps: classes from coarse and fine patches, and a posed survey on the ground, with hectares."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.settings.values import LOOK_WHOLE
from flows.survey.drawing import Drawing, FieldMemory, UnknownRule, draw_field, memory_lies, whole_pixels
from flows.survey.field_work import FieldWork, look_at, region_params, seat_columns
from flows.survey.memory import MEMORY
from flows.survey.run import SurveyRun
from flows.survey.stage import Product, Wanted, stage
from models.reading.inference import CoarseLook, Glance, read_glance
from models.reading.regions import whole_field
from models.reading.remembered import MemoryAgreement
from pipeline.ground.map_grid import GroundGrid, classes_at, ground_grid, image_at, map_blocks
from pipeline.ground.view import GroundView
from pipeline.rectify.registration.field_shift import FieldShift
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS
from storage.archive.keys import StageRef
from storage.archive.manifests import read_table, write_table
from storage.arrays.beliefs import UNKNOWN, create_belief, write_changes
from storage.arrays.blank_pixels import NO_CLASS, blank_pixels
from storage.arrays.class_maps import ClassNames, create_class_map, load_class_map, with_unknown
from storage.arrays.ground_maps import BLOCK, GroundMapWriter
from storage.arrays.layout import SHARD_ROWS, open_group, read_array, read_bands
from storage.arrays.mosaics import open_patches
from storage.arrays.quicklooks import choose_bands, develop, stretch

CLASS_MAP = Product("segment", version=8, files=("class_map.zarr", "belief.zarr"), by_weights=True)
STRANGE = "strange.json"  # beside a map, where values were no readings
LEFT_OUT = "left_out.npy"  # beside a map while it is drawn: the pixels of which none is
MOST_TURN_PX = 12.0  # that a field's corners may lie off by, as it is turned, so that its memory is of use


@stage("draw_map", "class map", CLASS_MAP, of=("rectify", "cut_patches"), unit="operations of the map", size="pixels")
def draw_map(run: SurveyRun, mosaic: StageRef, patches: StageRef) -> Wanted:
    """Draw the class map from coarse and fine patches, region by region; no class where the scene has no value."""

    def build(path: Path) -> None:
        work, out = FieldWork.of(run), path / "class_map.zarr"
        lies = _memory_lies(run, mosaic)
        drawing = _drawing(run, work, mosaic, patches, path, lies)
        if run.zones.left_out is not None:
            np.save(path / LEFT_OUT, run.zones.left_out)
        drawn = draw_field(work, drawing, run.report)
        if run.prior is not None:
            told = _memory_told(run, lies, drawn.comparison)
            write_table(path / MEMORY, told)
            if told["put_aside"] is not None and drawn.comparison is not None:
                drawn = draw_field(work, replace(drawing, memory=None), run.report)
        if drawn.changed is not None:
            write_changes(path / "belief.zarr", drawn.changed, run.grid.patch)
        if any(drawn.strange):
            write_table(path / STRANGE, dict(zip(("coarse_px", "fine_px"), drawn.strange, strict=True)))
        if run.scene.missing is not None:
            blank_pixels(out, run.scene.missing, NO_CLASS)
            blank_pixels(path / "belief.zarr", run.scene.missing, UNKNOWN)
        if run.zones.left_out is not None:
            blank_pixels(out, run.zones.left_out, NO_CLASS)
        (path / LEFT_OUT).unlink(missing_ok=True)

    prior, unknown = run.prior, _unknown_rule(run)
    params = {
        "weights": run.weights_key,
        "grid": asdict(run.grid),
        **region_params(run.grid),
        **run.place_key,
        **run.zones.key,
    }
    if run.familiar is not None and unknown is not None:
        params["unknown"] = {"familiar": run.familiar.key, **asdict(unknown)}
    if run.settings.look != LOOK_WHOLE:
        params["part"] = True
    if prior is not None:
        reader = None if run.reader is None else run.reader.key
        params |= {"days": prior.days, "classes": list(prior.classes), "reader": reader, "light": _light(run)}
    return Wanted(build, params, [mosaic, patches, *(() if prior is None else (prior.belief, prior.mosaic))])


def _memory_lies(run: SurveyRun, mosaic: StageRef) -> FieldShift:
    """How the field of before lies beside the one of today, in fine px."""
    if run.prior is None:
        return FieldShift()
    return memory_lies(run.prior.mosaic.path / "mosaic.zarr", mosaic.path / "mosaic.zarr", run.grid.factor)


def _is_turned(run: SurveyRun, lies: FieldShift) -> bool:
    return lies.edge_px((run.grid.height, run.grid.width)) > MOST_TURN_PX


def _drawing(
    run: SurveyRun, work: FieldWork, mosaic: StageRef, patches: StageRef, path: Path, lies: FieldShift
) -> Drawing:
    """What workers need to draw the map, into stores that are begun here."""
    legend, shape = ClassNames(run.weights.class_names, run.weights.class_colours), (run.grid.height, run.grid.width)
    unknown = _unknown_rule(run)
    shown = legend if unknown is None else with_unknown(legend)
    create_class_map(path / "class_map.zarr", shape, shown, grid=run.angular_grid())
    create_belief(path / "belief.zarr", shape, legend, grid=run.angular_grid())
    prior = run.prior
    memory = None
    if prior is not None and not _is_turned(run, lies):
        belief, coarse = (prior.belief.path / "belief.zarr").resolve(), (prior.mosaic.path / "mosaic.zarr").resolve()
        memory = FieldMemory(belief, coarse, prior.days, prior.classes, whole_pixels(lies))
    seen = (mosaic.path / "mosaic.zarr").resolve(), (patches.path / "patches.zarr").resolve()
    made = (path / "class_map.zarr").resolve(), (path / "belief.zarr").resolve()
    light, step = _light(run)
    left_out = None if run.zones.left_out is None else (path / LEFT_OUT).resolve()
    part = run.settings.look != LOOK_WHOLE
    return Drawing(work.weights, *seen, *made, light, step, memory, left_out, unknown, part)


def _unknown_rule(run: SurveyRun) -> UnknownRule | None:
    """Which pixels are called unknown; None where the weights do not know what is familiar, or nobody asks."""
    rate, settings = run.settings.unknown_rate, run.settings
    if run.familiar is None or rate is None:
        return None
    light, step = _light(run)
    coarse_ms = settings.scan_exposure_ms if run.plan.plain else settings.coarse_exposure_ms
    coarse_light = (coarse_ms or run.camera.exposure_ms) / DEFAULT_EXPOSURE_MS
    return UnknownRule(run.described.config.classes, rate, light, coarse_light, step)


def _light(run: SurveyRun) -> tuple[float, int]:
    """Exposure of a line that is read in detail as a share of the reference, and pixels to the next."""
    settings = run.settings
    exposure_ms = settings.scan_exposure_ms if run.plan.plain else None
    return (exposure_ms or run.camera.exposure_ms) / DEFAULT_EXPOSURE_MS, settings.scan_step or 1


def _memory_told(run: SurveyRun, lies: FieldShift, comparison: MemoryAgreement | None) -> dict[str, Any]:
    """What became of a memory: agreement with today's look, and pixels that changed from class to class."""
    assert run.prior is not None
    names = run.weights.class_names
    changed = np.zeros((len(names),) * 2, np.int64) if comparison is None else comparison.changed
    agreement = None if comparison is None or np.isnan(comparison.agreement) else comparison.agreement
    put_aside = "turned" if comparison is None else "another field" if comparison.is_of_another_field else None
    pairs = [(int(changed[old, new]), names[old], names[new]) for old, new in np.argwhere(changed) if old != new]
    return {
        "run": run.prior.run,
        "days": run.prior.days,
        "reader": "none" if run.reader is None else run.reader.key,
        "agreement": agreement,
        "put_aside": put_aside,
        "shift_px": list(whole_pixels(lies)),
        "turned_deg": lies.turned_deg,
        "compared_px": int(changed.sum()),
        "changed_px": 0 if put_aside else sum(count for count, _, _ in pairs),
        "changes": [] if put_aside else [list(pair) for pair in sorted(pairs, key=lambda pair: -pair[0])],
    }


def strange_pixels(class_map: StageRef) -> dict[str, int]:
    """Coarse and fine pixels that were left out of a map, as no sensor gives their values; empty without any."""
    path = class_map.path / STRANGE
    return dict(read_table(path)) if path.is_file() else {}


def glance_at(run: SurveyRun, mosaic: StageRef) -> Glance:
    """What the model says of a stored coarse mosaic alone, the whole field at once: for those that hold it anyway."""
    return read_glance(run.weights, look_at(run.weights, mosaic.path / "mosaic.zarr", whole_field(run.grid)))


def patch_columns(run: SurveyRun, patches: StageRef, seen: CoarseLook) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Seats of the whole field and their normalised spectral columns, (seat, p, p, column); see ``seat_columns``."""
    store = open_patches(patches.path / "patches.zarr")
    return seat_columns(run.weights, store, run.scene.wavelength_nm, seen, whole_field(run.grid))


STORE = "ground_map.zarr"
GROUND = Product("ground", version=3, files=(STORE,))


@stage("ground", "map on the ground", GROUND, of=("draw_map", "rectify"), after=("compare_turned",), unit="pixels")
def ground(run: SurveyRun, class_map: StageRef, mosaic: StageRef) -> Wanted | None:
    """Draw the class map and the coarse picture on the ground; nothing where the settings have no pose."""
    grid = survey_grid(run)
    if grid is None:
        return None
    pose, choice = run.settings.pose, run.settings.map

    def build(path: Path) -> None:
        found = load_class_map(class_map.path / "class_map.zarr")
        unsure, colours = np.isnan(found.confidence).astype(np.uint8), coarse_colours(mosaic)
        about = {"rig_pose": asdict(grid.frame.view.pose), "scene_pixels": grid.counts()}
        writer = GroundMapWriter(path / STORE, grid.geobox, ClassNames(found.names, found.colours), about=about)
        for rows, columns in map_blocks(grid.shape, BLOCK):  # what is not seen is 255, NaN and 0
            pixels = grid.scene_pixels(rows, columns)
            classes, confidence = (
                classes_at(found.classes, pixels),
                image_at(found.confidence[..., None], pixels)[..., 0],
            )
            confidence[classes_at(unsure, pixels) == 1] = np.nan  # of the class unknown, whatever lies beside it
            picture = np.nan_to_num(np.rint(image_at(colours, pixels, factor=run.grid.factor))).astype(np.uint8)
            writer.write_block(rows, columns, classes, confidence, picture)
            run.report(rows.stop / grid.shape[0])
        writer.finish(grid.class_areas_m2(found.classes, len(found.names)))

    params = {
        "pose": None if pose is None else asdict(pose),
        "map": asdict(choice),
        "ifov_rad": run.camera.ifov_rad,
        "scene_shape": run.scene.shape,
        "factor": run.grid.factor,
    }
    return Wanted(build, params, [class_map, mosaic])


def survey_grid(run: SurveyRun) -> GroundGrid | None:
    """The map's grid that the settings ask for, None without a pose. Raises PoseError where there can be none."""
    pose, choice = run.settings.pose, run.settings.map
    if pose is None:
        return None
    view = GroundView(pose, run.camera.ifov_rad)
    return ground_grid(view, run.scene.shape, epsg=choice.epsg, resolution_m=choice.resolution_m)


def coarse_colours(mosaic: StageRef) -> NDArray[np.float32]:
    """Three bands of the coarse mosaic in a photograph's tones, (y, x, 3) in 1..255; NaN where nothing was captured."""
    group = open_group(mosaic.path / "mosaic.zarr")
    bands, words = choose_bands(read_bands(group)[0])
    height = len(read_array(group, "coverage"))
    rows = (slice(first, min(first + SHARD_ROWS, height)) for first in range(0, height, SHARD_ROWS))
    values = np.concatenate([read_array(group, "values", block)[..., list(bands)] for block in rows])
    tones = develop(values, values) if words.startswith("true colour") else stretch(values)
    picture: NDArray[np.float32] = np.where(np.isfinite(values), 1 + 254 * tones, np.nan).astype(np.float32)
    return picture

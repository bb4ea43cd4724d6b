"""The stage that draws the class map, from coarse and fine patches and from what is remembered of the field."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from flows.settings.values import EXTENT_WHOLE
from flows.tasks.drawing import Drawing, UnknownRule, draw_field
from flows.tasks.field_prior_map import FieldPriorMap, prior_map_lies, whole_pixels
from flows.tasks.field_work import FieldWork, coarse_region, region_params
from flows.tasks.prior_maps import MEMORY
from flows.tasks.run import SurveyRun
from flows.tasks.stage import Product, Wanted, stage
from models.reading.inference import CoarsePrediction, read_coarse_prediction
from models.reading.prior_map import TemporalAgreement, changed_fractions
from models.reading.regions import whole_field
from pipeline.geometry.grid import UNLABELLED
from pipeline.rectify.registration.alignment import FieldShift
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS
from storage.archive.keys import StageRef
from storage.archive.manifests import read_table, write_table
from storage.arrays.class_maps import (
    NOT_BELIEVED,
    OLD_CLASS,
    ClassNames,
    ProbabilityStore,
    create_class_map,
    create_probabilities,
    drop_changes,
    with_unknown,
    write_changes,
)
from storage.arrays.layout import NO_CLASS, blank_pixels

CLASS_MAP = Product("segment", version=10, files=("class_map.zarr", "class_probabilities.zarr"), by_weights=True)
OUT_OF_RANGE = "out_of_range.json"  # beside a map, where values were no readings
LEFT_OUT = "left_out.npy"  # beside a map while it is drawn: the pixels of which none is
MOST_TURN_PX = 12.0  # that a field's corners may lie off by, as it is turned, so that its memory is of use


@stage("segment", "class map", CLASS_MAP)
def segment(run: SurveyRun, mosaic: StageRef, patches: StageRef) -> Wanted:
    """Draw the class map from coarse and fine patches, region by region; no class where the scene has no value."""

    def build(path: Path) -> None:
        """Draw the map and what is believed; once more without the memory, where that is put aside."""
        work, out = FieldWork.of(run), path / "class_map.zarr"
        lies = _prior_map_lies(run, mosaic)
        drawing = _drawing(run, work, mosaic, patches, path, lies)
        if run.zones.left_out is not None:
            np.save(path / LEFT_OUT, run.zones.left_out)
        drawn = draw_field(work, drawing, run.report)
        if run.prior is not None:
            prior = _prior_map_figures(run, lies, drawn.comparison)
            write_table(path / MEMORY, prior)
            if prior["put_aside"] is not None and drawn.comparison is not None:
                drop_changes(path / "class_probabilities.zarr")
                drawn = draw_field(work, replace(drawing, memory=None), run.report)
        if any(drawn.out_of_range):
            write_table(path / OUT_OF_RANGE, dict(zip(("coarse_px", "fine_px"), drawn.out_of_range, strict=True)))
        if run.scene.missing is not None:
            blank_pixels(out, run.scene.missing, NO_CLASS)
            changes = {} if drawn.comparison is None else {OLD_CLASS: UNLABELLED}
            blank_pixels(path / "class_probabilities.zarr", run.scene.missing, NOT_BELIEVED | changes)
        if run.zones.left_out is not None:
            blank_pixels(out, run.zones.left_out, NO_CLASS)
        if (old_class := ProbabilityStore(path / "class_probabilities.zarr").old_class()) is not None:
            write_changes(
                path / "class_probabilities.zarr", changed_fractions(old_class, run.grid.patch), run.grid.patch
            )
        (path / LEFT_OUT).unlink(missing_ok=True)

    prior, unknown = run.prior, _unknown_rule(run)
    params = {**run.model_key, "grid": asdict(run.grid), **region_params(run.grid), **run.place_key, **run.zones.key}
    if run.ood_detector is not None and unknown is not None:
        params["unknown"] = {"familiar": run.ood_detector.key, **asdict(unknown)}
    if run.settings.extent != EXTENT_WHOLE:
        params["part"] = True
    if prior is not None:
        reader = None if run.reader is None else run.reader.key
        params |= {"days": prior.days, "classes": list(prior.classes), "reader": reader, "light": _light(run)}
        if len(prior.scan_passes) > 1:
            params["shifts"] = [list(scan_pass.shift_px) for scan_pass in prior.scan_passes]
    before = () if prior is None else (prior.probabilities, *(scan_pass.mosaic for scan_pass in prior.scan_passes))
    return Wanted(build, params, [mosaic, patches, *before])


def _prior_map_lies(run: SurveyRun, mosaic: StageRef) -> FieldShift:
    """How the field of before lies beside the one of today, in fine px."""
    if run.prior is None:
        return FieldShift()
    return prior_map_lies(run.prior.scan_passes, mosaic.path / "mosaic.zarr", run.grid.factor)


def _drawing(
    run: SurveyRun, work: FieldWork, mosaic: StageRef, patches: StageRef, path: Path, lies: FieldShift
) -> Drawing:
    """What workers need to draw the map, into stores that are begun here."""
    legend, shape = ClassNames(run.weights.class_names, run.weights.class_colours), (run.grid.height, run.grid.width)
    unknown = _unknown_rule(run)
    shown = legend if unknown is None else with_unknown(legend)
    create_class_map(path / "class_map.zarr", shape, shown, grid=run.angular_grid())
    prior = run.prior
    memory = None
    if prior is not None and not (lies.edge_px((run.grid.height, run.grid.width)) > MOST_TURN_PX):
        last, probabilities = prior.scan_passes[0], (prior.probabilities.path / "class_probabilities.zarr").resolve()
        coarse = (last.mosaic.path / "mosaic.zarr").resolve() if last.factor == run.grid.factor else None
        memory = FieldPriorMap(probabilities, coarse, prior.days, prior.classes, whole_pixels(lies))
    create_probabilities(
        path / "class_probabilities.zarr", shape, legend, grid=run.angular_grid(), goes_on=memory is not None
    )
    seen = (mosaic.path / "mosaic.zarr").resolve(), (patches.path / "patches.zarr").resolve()
    made = (path / "class_map.zarr").resolve(), (path / "class_probabilities.zarr").resolve()
    light, step = _light(run)
    left_out = None if run.zones.left_out is None else (path / LEFT_OUT).resolve()
    part = run.settings.extent != EXTENT_WHOLE
    return Drawing(work.weights, *seen, *made, light, step, memory, left_out, unknown, part)


def _unknown_rule(run: SurveyRun) -> UnknownRule | None:
    """Which pixels are called unknown; None where the weights do not know what is familiar, or nobody asks."""
    rate, settings = run.settings.unknown_rate, run.settings
    if run.ood_detector is None or rate is None:
        return None
    light, step = _light(run)
    coarse_ms = settings.scan_exposure_ms if run.plan.plain else settings.coarse_exposure_ms
    coarse_light = (coarse_ms or run.camera.exposure_ms) / DEFAULT_EXPOSURE_MS
    return UnknownRule(run.described.config.classes, rate, light, coarse_light, step)


def _light(run: SurveyRun) -> tuple[float, int]:
    """Exposure of a line that is read in detail as a fraction of the reference, and pixels to the next."""
    settings = run.settings
    exposure_ms = settings.scan_exposure_ms if run.plan.plain else None
    return (exposure_ms or run.camera.exposure_ms) / DEFAULT_EXPOSURE_MS, settings.scan_step or 1


def _prior_map_figures(run: SurveyRun, lies: FieldShift, comparison: TemporalAgreement | None) -> dict[str, Any]:
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


def out_of_range_pixels(class_map: StageRef) -> dict[str, int]:
    """Coarse and fine pixels that were left out of a map, as no sensor gives their values; empty without any."""
    path = class_map.path / OUT_OF_RANGE
    return dict(read_table(path)) if path.is_file() else {}


def coarse_prediction_at(run: SurveyRun, mosaic: StageRef) -> CoarsePrediction:
    """What the model says of a stored coarse mosaic alone, the whole field at once: for those that hold it anyway."""
    return read_coarse_prediction(
        run.weights, coarse_region(run.weights, mosaic.path / "mosaic.zarr", whole_field(run.grid))
    )

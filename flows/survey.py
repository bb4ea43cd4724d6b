"""The stages of a survey in their order: from raw sweeps to a class map and its receipt.

Each stage takes and returns addresses of stores, not arrays. Existing stores are not computed again, so that a stopped
survey resumes. `flows.prefect_flow` makes an ordinary Prefect flow of it, in which each stage is a task.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

from spectralzoom.flows.observer import Observer, current_observer, tidy_up
from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.products import Control, Pass, Products
from spectralzoom.flows.publish.publishing import RunRef, clear_intermediate, clear_raw, publish
from spectralzoom.flows.settings.values import KEEP_RAW, RIG
from spectralzoom.flows.stage import Stores
from spectralzoom.flows.stages.capture import SweepRequest, capture_coarse, capture_fine
from spectralzoom.flows.stages.condense import condense_coarse, condense_fine
from spectralzoom.flows.stages.effects import choose_effects
from spectralzoom.flows.stages.evaluate import evaluate
from spectralzoom.flows.stages.ground import ground
from spectralzoom.flows.stages.locate import locate
from spectralzoom.flows.stages.overview import read_overview
from spectralzoom.flows.stages.raster import condense_raster
from spectralzoom.flows.stages.rectify import rectify, rectify_fine
from spectralzoom.flows.stages.register import register_coarse, register_fine
from spectralzoom.flows.stages.score import load_plan, score
from spectralzoom.flows.stages.segment import segment
from spectralzoom.pipeline.errors import SurveyStopped
from spectralzoom.pipeline.planning.fine_pass import FinePlan
from spectralzoom.storage.arrays.raster_pixels import RasterPixels
from spectralzoom.storage.store import Archive, Ref


def carry_out(plan: SurveyPlan, started: datetime) -> RunRef:
    """Run the stages of a planned survey and publish its run; inside a Prefect flow the stages are its tasks.

    Returns the address of the published run, or of the last store if ``until`` of the settings stops the survey.
    Raises PipelineError: what is wrong, what is allowed, and what to do.
    """
    observer = current_observer()
    archive = Archive.open(plan.settings.out)
    archive.reclaim()  # remove incomplete stores of killed runs
    for warning in plan.field.warnings:
        observer.warn(warning)
    for note in plan.notes:
        observer.note(note)
    stores = Stores(
        archive, name=plan.field.name, watch=observer.watch, log=observer.log, note=observer.note, finish=tidy_up
    )
    with archive.in_use(), plan.pool.open(), plan.field.hold:
        try:
            products = run_stages(stores, plan)
        except SurveyStopped as stopped:
            return RunRef(stopped.uri, archive.root / stopped.uri, stopped=stopped)
        clear_intermediate(archive, plan, products)
        control = _control(archive, plan, observer)
        run = publish(stores, plan, products, control, started=started, note=observer.note)
        if control is not None:
            clear_raw(control.stores, control.plan, control.products, run, note=observer.note)
        return clear_raw(stores, plan, products, run, note=observer.note)


def run_stages(stores: Stores, plan: SurveyPlan) -> Products:
    """Run all stages of a survey, and return their stores. Raises SurveyStopped: the settings stop it before its map.

    In a dry run, a store that is missing leaves open whether there is a second pass: then both are run.
    """
    field = plan.field
    is_judged = field.scene.labelled and plan.settings.accuracy
    effects = _effects(stores, plan) if field.simulates else None
    first = None
    if field.raster is not None:
        mosaic = _raster_mosaic(stores, plan, field.raster)
    else:
        first = _first_pass(stores, plan, effects)
        mosaic = first.mosaic
    overview = None
    if plan.request.overview_first:
        overview = read_overview(stores, mosaic, work=plan.reading.gains.work, capture=plan.capture)
    attention = score(
        stores,
        mosaic,
        overview,
        gains=plan.reading.gains,
        second_pass=plan.request.planner,
        scan_record=plan.request.scan_record,
        scanned=plan.request.scanned,
        budget=plan.reading.budget,
        least_gain=plan.reading.least_gain,
    )
    second = None
    if first is not None and not plan.passes.plain:
        request = load_plan(attention) if stores.has(attention) else None
        if request is None or request.sweeps:
            second = _second_pass(stores, plan, effects, first, attention, request)
            mosaic = second.mosaic
        _stop_after(stores, plan, mosaic, "capture", "mosaic")
    stores.restore(mosaic)  # the report shows it, also where the map is stored
    class_map = segment(
        stores,
        mosaic,
        attention,
        overview,
        *(() if field.prior is None else field.prior.stores),
        gains=plan.reading.gains,
        prior=field.prior,
        reader=plan.reading.reader,
        part=plan.part,
        least_gain=plan.reading.least_gain,
        spectra=field.described.spectra,
    )
    return Products(
        mosaic=mosaic,
        attention=attention,
        overview=overview,
        class_map=class_map,
        effects=effects,
        first=first,
        second=second,
        ground=None if field.ground_grid is None else ground(stores, class_map, mosaic, ground_grid=field.ground_grid),
        accuracy=_accuracy(stores, plan, class_map, first) if is_judged else None,
    )


def _control(archive: Archive, plan: SurveyPlan, observer: Observer) -> Control | None:
    """Simulate and judge the best uniform scan of the same seconds; None unless it is asked for."""
    control = plan.control
    if control is None:
        return None

    def watch(name: str, title: str, state: str, done: float) -> None:
        observer.watch(f"control_{name}", f"control: {title}", state, done)

    stores = Stores(archive, name=f"{plan.field.name}-control", watch=watch, log=observer.log, finish=tidy_up)
    return Control(control, stores, run_stages(stores, control))


def _raster_mosaic(stores: Stores, plan: SurveyPlan, raster: RasterPixels) -> Ref:
    """Return the mosaic of a raster, which needs no capture."""
    field, settings = plan.field, plan.settings
    mosaic = condense_raster(
        stores, scene=field.scene, frame=field.frame, signal=settings.signal, raster=raster, memory=settings.memory
    )
    _stop_after(stores, plan, mosaic, "capture", "mosaic")
    return mosaic


def _effects(stores: Stores, plan: SurveyPlan) -> Ref:
    """Return the choice of effects of a simulated source."""
    settings = plan.settings
    return choose_effects(
        stores,
        scene=plan.field.scene,
        rig=settings.simulated_rig,
        sweeps=plan.typical,
        cost=settings.cost,
        asked=settings.effects,
        tol=settings.tol,
    )


def _accuracy(stores: Stores, plan: SurveyPlan, class_map: Ref, first: Pass | None) -> Ref:
    """Return the figures of a map by the labels."""
    return evaluate(
        stores,
        class_map,
        None if first is None else first.seams,
        labels=plan.field.labels,
        along=plan.passes.along,
        pointing=plan.field.simulated.pointing,
    )


def _first_pass(stores: Stores, plan: SurveyPlan, effects: Ref | None) -> Pass:
    """Capture the first pass, or the uniform scan, and rectify it."""
    field, settings = plan.field, plan.settings
    assert field.source is not None
    raw = capture_coarse(
        stores,
        effects,
        request=SweepRequest.of(plan.passes.coarse, field.camera, settings.cost),
        view=field.view,
        source=field.source,
        pool=plan.pool,
    )
    _keep(stores, plan, raw)
    signal = condense_coarse(stores, raw, camera=field.camera, signal=settings.signal)
    if plan.passes.plain:
        _stop_after(stores, plan, signal, "capture")
    seams = None
    if plan.registers:
        wavelength_nm = field.scene.wavelength_nm
        seams = register_coarse(
            stores, signal, camera=field.camera, prior_px=settings.pointing_px, wavelength_nm=wavelength_nm
        )
    places = locate(stores, signal, seams, camera=field.camera, grid=field.grid)
    mosaic = rectify(
        stores,
        signal,
        places,
        seams,
        frame=field.frame,
        camera=field.camera,
        kernel=settings.resampling,
        memory=settings.memory,
        pool=plan.pool,
    )
    if plan.passes.plain:  # no network has to choose a second pass
        _stop_after(stores, plan, mosaic, "mosaic")
    return Pass(raw, signal, mosaic, seams, places)


def _second_pass(
    stores: Stores, plan: SurveyPlan, effects: Ref | None, first: Pass, attention: Ref, request: FinePlan | None
) -> Pass:
    """Capture the requested lines, and rectify both passes."""
    field, settings = plan.field, plan.settings
    sweeps = [] if request is None else request.sweeps
    assert field.source is not None
    raw = capture_fine(
        stores,
        attention if request is not None else replace(attention, key=""),  # which leaves the lines open
        effects,
        request=SweepRequest.of(sweeps, field.camera, settings.cost, after_s=plan.passes.coarse_s),
        view=field.view,
        source=field.source,
        pool=plan.pool,
    )
    _keep(stores, plan, raw)
    signal = condense_fine(stores, raw, first.raw, camera=field.camera, signal=settings.signal)
    _stop_after(stores, plan, signal, "capture")
    seams = None
    if plan.registers:
        prior_px = settings.pointing_px
        seams = register_fine(stores, signal, first.mosaic, camera=field.camera, prior_px=prior_px, grid=field.grid)
    mosaic = rectify_fine(
        stores,
        signal,
        seams,
        frame=field.frame,
        camera=field.camera,
        light=field.light,
        kernel=settings.resampling,
        memory=settings.memory,
        pool=plan.pool,
    )
    return Pass(raw, signal, mosaic, seams)


def _keep(stores: Stores, plan: SurveyPlan, raw: Ref) -> None:
    """Make raw lines again that an earlier run cleared and this one keeps; those of a rig cannot be had again."""
    if plan.settings.keep == KEEP_RAW and plan.settings.source != RIG:
        stores.restore(raw)


def _stop_after(stores: Stores, plan: SurveyPlan, ref: Ref, *steps: str) -> None:
    """Raise SurveyStopped if one of ``steps``, whose last store is ``ref``, is ``until`` of the settings."""
    if plan.settings.until in steps:
        raise SurveyStopped(str(plan.settings.until), ref.uri, stores.archive.name)

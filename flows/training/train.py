"""Run `spectralzoom train`: train weights on labelled scenes and write them with split and figures."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from spectralzoom.flows.settings.model_flags import TrainFlags
from spectralzoom.flows.tasks.scene import masks_contain
from spectralzoom.flows.terminal.progress import one_after_the_other, show_text, table
from spectralzoom.flows.training import figures
from spectralzoom.flows.training.data import (
    Report,
    TrainingData,
    alike_note,
    check_out,
    filled,
    open_training_data,
    read_farm_name,
    untaught_note,
)
from spectralzoom.flows.training.train_scenes import CAMERA, Scenes, TrainRequest, network_config, observe_all
from spectralzoom.models.network.machine import PROCESSOR, choose_device
from spectralzoom.models.network.spectral import Normalisation
from spectralzoom.models.policies.placement import CascadeTable
from spectralzoom.models.training.capture_augmentation import REFERENCE_MS, CaptureAugmentation
from spectralzoom.models.training.examples import measured_normalisation
from spectralzoom.models.training.train import PIXELS, LabelledPixels, continued, linear_classifier, train
from spectralzoom.models.weights.checksummed_files import load_checkpoint
from spectralzoom.models.weights.files import (
    CALIBRATION,
    CASCADE,
    CLASS_VALUES,
    TRAINED_ON,
    TrainedOn,
    Weights,
    add_map_scores,
    load_encoder,
    load_weights,
    save_weights,
    with_record,
)
from spectralzoom.pipeline.errors import SceneError, SettingsError, list_some
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.simulator.scenes.built_in import built_in_laws
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import FARM_PIXEL_M
from spectralzoom.pipeline.simulator.scenes.farm.land import sun_over_farm


def train_weights(
    request: TrainRequest,
    report: Report = lambda what, done, figure: None,
    tell: Callable[[str], None] = lambda note: None,
) -> dict[str, Any]:
    """Train, validate and save weights; return their record. ``tell`` gets notes on left-out scenes.

    Raises SceneError: no labels, a single class, or scenes of different bands or classes; SettingsError: an invalid
    output path, sizes that do not fit, or an unavailable device.
    """
    checkpoint = request.out.with_name(request.out.name + ".checkpoint")
    check_out(request.out)
    load_checkpoint(checkpoint)  # a damaged one fails before minutes are spent
    flags = request.flags
    begun = None if flags.start is None else load_weights(flags.start)
    device = choose_device(flags.device)
    settings = flags.settings
    data = open_training_data(request.dataset, flags.validation, flags.scenes, CAMERA, **flags.choices())
    for note in data.notes:
        tell(note)
    scenes = observe_all(request, data, report, tell)
    check_classes(request, scenes, tell)
    if begun is None:
        normalisation = measured_normalisation(scenes.train.examples, math.sqrt(settings.darkest_ms * REFERENCE_MS))
    else:
        check_start(request, begun, scenes)
        normalisation = begun.normalisation
    scenes = scenes.normalised(normalisation)
    simulated = settings.darkest_ms < REFERENCE_MS
    augmentation = CaptureAugmentation(normalisation, min_exposure_ms=settings.darkest_ms) if simulated else None
    weights, training = _learned(request, scenes, normalisation, augmentation, begun, checkpoint, device, report)
    record = {
        "command": request.command,
        "data": data.law,
        **({CLASS_VALUES: list(scenes.common.values)} if scenes.common.values else {}),
        TRAINED_ON: asdict(_trained_on(data, scenes, settings.darkest_ms)),
        "split": scenes.split | {"held_out": list(data.held_out)},
        "settings": asdict(settings),
        "camera": asdict(CAMERA),
        "device": device,
        **({} if begun is None else {"started_from": begun.record.get("command", "")}),
        **training,
    }
    frames = scenes.validation.examples
    scans = figures.judge_scans(with_record(weights, **record), frames, augmentation, settings.seed, report)
    if scans is not None:
        record["scans"] = scans[0]
    save_weights(with_record(weights.on(PROCESSOR), **record), request.out)
    if scans is not None:
        add_map_scores(request.out, scans[1])
    checkpoint.unlink(missing_ok=True)
    return record


def _trained_on(data: TrainingData, scenes: Scenes, min_exposure_ms: float) -> TrainedOn:
    """Return the ranges of the training data; season, sun and scale are known for built-in farms alone."""
    farm: dict[str, Any] = {}
    if data.files is None:
        moments = [read_farm_name(name)[1:] for name in data.train]
        days = [day for day, _ in moments]
        heights = [sun_over_farm(*moment).elevation_deg for moment in moments]
        farm = {"day": (min(days), max(days)), "sun_elevation_deg": (min(heights), max(heights))}
        farm["ground_pixel_m"] = FARM_PIXEL_M
    nm = scenes.common.wavelength_nm
    return TrainedOn(
        bands=len(nm),
        wavelength_nm=(float(nm.min()), float(nm.max())),
        exposure_ms=(min_exposure_ms, max(min_exposure_ms, data.camera.exposure_ms)),
        scenes=len(data.train),
        classes=scenes.common.names,
        bands_nm=tuple(nm.tolist()),
        **farm,
    )


def check_classes(request: TrainRequest, scenes: Scenes, tell: Callable[[str], None]) -> None:
    """Tell the classes without a training pixel. Raises SceneError: fewer than two classes have one."""
    names, frames = scenes.common.names, [*scenes.train.keys]
    taught = [name for number, name in enumerate(names) if number not in scenes.untaught]
    if len(taught) < 2:
        note = filled(alike_note(taught[0]), frames) if taught else f"no pixel of {list_some(frames)} has a label"
        raise SceneError(f"{request.dataset}: training needs two or more classes, and {note}")
    if scenes.untaught:
        tell(untaught_note([names[number] for number in scenes.untaught]))


def check_start(request: TrainRequest, begun: Weights, scenes: Scenes) -> None:
    """Raise SettingsError unless a training can start from these weights.

    Bands, classes and sizes must be theirs, and the training must contain the pixels that they know, by the content of
    the scenes. So none of these pixels judges the result, and the record names them all.
    """
    if begun.class_names != scenes.common.names:
        both = [", ".join(names) for names in (begun.class_names, scenes.common.names)]
        raise SettingsError(
            f"--start {request.flags.start}: its classes are {both[0]}, those of {request.dataset} are {both[1]};"
            " give the same classes in the same order, in scene.toml"
        )
    split = begun.record.get("split", {})
    known = set(split.get("train", {}).values())
    masks = split.get("pixels", {})
    now = scenes.train
    for what, kept in {
        "training scenes": known <= set(now.keys.values()),
        "training pixels": all(masks_contain(now.pixels[key], masks.get(key)) for key in known & now.pixels.keys()),
        "bands": begun.basis == scenes.common.basis,
        "sizes of the network": replace(begun.config, untaught=()) == network_config(request.flags, scenes.common),
    }.items():
        if not kept:
            raise SettingsError(
                f"--start {request.flags.start}: its training had other {what}; give its data set and options"
            )


def _learned(
    request: TrainRequest,
    scenes: Scenes,
    normalisation: Normalisation,
    augmentation: CaptureAugmentation | None,
    begun: Weights | None,
    checkpoint: Path,
    device: str,
    report: Report,
) -> tuple[Weights, dict[str, Any]]:
    """Train the network; return weights, and their figures on the validation scenes for the record."""
    common = scenes.common
    settings = request.flags.settings
    examples = scenes.train.examples
    config = replace(network_config(request.flags, common), untaught=scenes.untaught)
    rng = np.random.default_rng([0x1DA])
    pixels = LabelledPixels.drawn(examples, rng, augmentation).brightened(normalisation.gain_shift, rng)
    start = linear_classifier(pixels, config.classes) | (load_encoder() if config.deep else {})
    if begun is not None:
        begun = replace(begun, segmenter=continued(begun.segmenter, config, start))
    model, summary = train(
        config,
        examples,
        normalisation.gain_shift,
        settings,
        lambda now: report("training", now.done, f"step {now.step}, loss {now.loss:.3f}"),
        start=start if begun is None else begun.segmenter.state_dict(),
        augmentation=augmentation,
        checkpoint=checkpoint,
        device=device,
    )
    weights = Weights(model, common.basis, normalisation, common.names, common.colours).on(device)
    frames = scenes.validation.examples
    found: dict[str, Any] = {}
    labelled = sum(int(np.count_nonzero(one.labels != UNLABELLED)) for one in examples)
    weights, found["readings"] = figures.better_reading(
        weights, start, frames, few=begun is None and labelled < figures.FEW_PIXELS, begun=begun
    )
    found["baselines"] = figures.judge_baselines(examples, frames, config.classes, settings.seed, report)
    if frames:
        report("validating", 0.0, f"{len(frames)} scenes")
        found[CALIBRATION] = figures.judge_calibration(weights, frames, settings.seed)
    twice = figures.read_twice(weights, frames)
    if twice:
        found[CASCADE] = asdict(CascadeTable.judged(twice, config.classes))
    found["validation"] = figures.validate(twice, config.classes)
    return weights, {"training": summary, **found}


def run_train(request: TrainRequest, console: Console) -> dict[str, Any]:
    """Train with a progress bar on ``console``; print and return the record."""
    check_counts(request.flags)
    with one_after_the_other(console) as report:
        record = train_weights(request, report, lambda note: show_text(f"note: {note}", console))
    _print_figures(record, request, console)
    return record


def check_counts(flags: TrainFlags) -> None:
    """Raise SettingsError for a count or size that is not positive, or an exposure beyond the reference."""
    counts = ("steps", "minutes", "learning_rate", "batch", "crop", "scenes", "patch", "dim", "layers", "heads")
    for name in (*counts, "validation", "seed"):
        value = getattr(flags, name)
        if value is not None and not (value > 0 if name in counts else value >= 0):
            limit = "above 0" if name in counts else "0 or more"
            raise SettingsError(f"--{name.replace('_', '-')} must be {limit}, got {value}")
    if not 0 < flags.min_exposure_ms <= REFERENCE_MS:
        limits = f"above 0 and at most {REFERENCE_MS:g}, the reference exposure"
        raise SettingsError(f"--min-exposure-ms must be {limits}, got {flags.min_exposure_ms}")


def _print_figures(record: dict[str, Any], request: TrainRequest, console: Console) -> None:
    size_mb = request.out.stat().st_size / 1e6
    show_text(f"weights: {request.out} ({size_mb:.1f} MB), {record['training']['steps']} steps", console)
    readings = record["readings"]
    of_readings, of_baselines = (
        ", ".join(f"{name} {100 * miou:.1f}" for name, miou in scores.items())
        for scores in (readings["miou"], record["baselines"] or {})
    )
    text = f"mIoU of the whole scenes by each reading: {of_readings}; " if of_readings else ""
    show_text(f"{text}kept: {readings['kept']}", console)
    what = "mIoU of classifiers of a random half of the training pixels, on the other half"
    if of_readings:
        what = f"on at most {PIXELS} of their pixels at full exposure"
    if of_baselines:
        show_text(f"{what}: {of_baselines}", console)
    judged = record["validation"]
    if judged is None:
        left = built_in_laws(request.dataset) or request.flags.hold_out or request.flags.train_mask is not None
        on = request.dataset if left else "OTHER_SCENES"
        command = shlex.join(["spectralzoom", "evaluate", on, "--weights", str(request.out)])
        more = "" if left or len(record["split"]["train"]) < 2 else "; or train with some held out: --hold-out NAMES"
        show_text(f"no scene was kept for validation; to judge the weights on other scenes: {command}{more}", console)
        if request.flags.min_exposure_ms < REFERENCE_MS:
            show_text("the file has no scan performance, by which survey --seconds chooses", console)
        return
    title = f"{judged['scenes']} scene{'s' if judged['scenes'] > 1 else ''} kept for validation"
    rows = [
        [name, *(f"{judged[name][figure]:.1%}" for figure in ("miou", "overall_accuracy"))]
        for name in ("none", "gain", "all")
    ]
    console.print(table(("patches", "mIoU", "overall"), rows, title=title))
    console.print(f"none: overview alone; all: every patch in full; gain: {judged['fraction']:.0%} of the patches")

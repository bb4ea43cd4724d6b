"""Run `spectralzoom train`: train weights on labelled scenes and write them with split and figures."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from torch import Tensor

from flows.terminal.progress import one_after_the_other, table
from flows.training.data import Report, TrainingData, alike_notes, open_training_data
from flows.training.figures import judge_baselines, judge_cascade, judge_scans, validate
from flows.training.fit_ood import SeenScenes, measure_and_add, measured_calibration, trained_on
from flows.training.train_scenes import About, TrainRequest, as_read, network_config, observe_all
from models.evaluation.expected_scores import MapScores
from models.network.machine import choose_device
from models.network.sizes import SegmenterConfig
from models.network.spectral import Normalisation
from models.training.capture_augmentation import REFERENCE_MS, CaptureAugmentation
from models.training.examples import Example, measured_normalisation
from models.training.start import LabelledPixels, better_reading, linear_discriminants
from models.training.train import Progress, train
from models.weights.checksummed_files import load_checkpoint
from models.weights.files import CALIBRATION, CASCADE, Weights, save_weights, with_record
from models.weights.parts import MAP_SCORES, TRAINED_ON
from pipeline.errors import SceneError, SettingsError
from pipeline.simulator.scenes.built_in import built_in_laws

FRAME_CROP, FARM_CROP = 384, 256  # px


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
    _check_places(request.out, checkpoint)
    load_checkpoint(checkpoint)  # a damaged one fails before minutes are spent
    device = choose_device(request.device)
    data = open_training_data(
        request.dataset,
        request.validation,
        request.scenes,
        request.camera,
        hold_out=request.hold_out,
        **request.choices,
    )
    for note in data.notes:
        tell(note)
    lesson = _lesson(request, data, report, tell)
    about = lesson.about
    split = {  # copied before validation scenes are added
        "train": dict(about.keys),
        "content": list(about.content),
        "validation": list(data.validation),
        "held_out": list(data.held_out),
        "pixels": dict(about.pixels),
    }
    weights, summary = _learned(request, lesson, checkpoint, report)
    kept, _ = observe_all(request, data, data.validation, "imaging validation scenes", report, about)
    for note in about.notes(data.validation):
        tell(note)
    frames = as_read(kept, lesson.normalisation)
    whole = SeenScenes(lesson.examples, frames, about.wavelength_nm, request.settings.darkest_ms, request.settings.seed)
    trained = trained_on(data, whole, about.names)
    beside: dict[str, Any] = {}
    if frames:
        weights, beside["readings"] = better_reading(weights, lesson.start, frames)
        counts = lesson.examples, frames, len(about.names), request.settings.seed
        beside["baselines"] = judge_baselines(*counts, report)
    figures, scores = _figures(weights, frames, lesson.augmentation, request.settings.seed, report)
    record = {
        "command": request.command,
        "data": data.law,
        TRAINED_ON: trained.as_dict(),
        "split": split,
        "settings": asdict(request.settings),
        "camera": asdict(request.camera),
        "training": summary,
        "device": device,
        **figures,
        **beside,
    }
    save_weights(with_record(weights, **record), request.out)
    checkpoint.unlink(missing_ok=True)
    ood_record = {"command": request.command, **({} if scores is None else {MAP_SCORES: scores.as_dict()})}
    why = measure_and_add(weights, request.out, whole, trained, ood_record, report)
    return record if why is None else {**record, "familiar": why}


@dataclass(frozen=True)
class Lesson:
    """Normalised scenes, sizes of the network and its initial tensors."""

    about: About
    config: SegmenterConfig
    normalisation: Normalisation
    examples: list[Example]
    augmentation: CaptureAugmentation | None  # None: the reference exposure alone

    @cached_property
    def start(self) -> Mapping[str, Tensor]:
        """Return the initial tensors: the linear discriminants of the scenes."""
        pixels = LabelledPixels.drawn(self.examples, np.random.default_rng([0x1DA]))
        return linear_discriminants(pixels, self.config.classes)


def _lesson(request: TrainRequest, data: TrainingData, report: Report, tell: Callable[[str], None]) -> Lesson:
    """Image the scenes to train on."""
    seen, about = observe_all(request, data, data.train, "imaging scenes", report)
    notes = alike_notes(about.alike)
    if len(about.alike) == len(about.keys) and len(notes) == 1:
        raise SceneError(f"{request.dataset}: training needs two or more classes, and {notes[0]}")
    for note in (*notes, *about.notes(data.train)):
        tell(note)
    darkest_ms = request.settings.darkest_ms
    normalisation = measured_normalisation(seen, math.sqrt(darkest_ms * REFERENCE_MS))
    augmentation = CaptureAugmentation(normalisation, darkest_ms=darkest_ms) if darkest_ms < REFERENCE_MS else None
    config = network_config(request, about)
    return Lesson(about, config, normalisation, as_read(seen, normalisation), augmentation)


def _learned(
    request: TrainRequest, lesson: Lesson, checkpoint: Path, report: Report
) -> tuple[Weights, dict[str, float | int]]:
    """Train the network; return weights and a summary of the training."""

    def progress(now: Progress) -> None:
        report("training", now.done, f"step {now.step}, loss {now.loss:.3f}")

    model, summary = train(
        lesson.config,
        lesson.examples,
        lesson.normalisation.gain_shift,
        request.settings,
        progress,
        start=lesson.start,
        augmentation=lesson.augmentation,
        checkpoint=checkpoint,
        device=choose_device(request.device),
    )
    about = lesson.about
    return Weights(model, about.basis, lesson.normalisation, about.names, about.colours), summary


def _figures(
    weights: Weights, frames: list[Example], augmentation: CaptureAugmentation | None, seed: int, report: Report
) -> tuple[dict[str, Any], MapScores | None]:
    """Return the figures of validation scenes for the record, and the corrections of expected scores."""
    figures = {"validation": validate(weights, frames, seed, lambda row: report("validating", 0.0, row))}
    if (cascade := judge_cascade(weights, frames)) is not None:
        figures[CASCADE] = cascade
    if (calibration := measured_calibration(weights, frames, seed)) is not None:
        figures[CALIBRATION] = calibration
        weights = with_record(weights, calibration=calibration)
    scans = judge_scans(weights, frames, augmentation, seed, report)
    return (figures, None) if scans is None else (figures | {"scans": scans.record}, scans.scores)


def _check_places(out: Path, checkpoint: Path) -> None:
    if not out.parent.is_dir():
        raise SettingsError(f"-o {out}: the folder {out.parent} does not exist; make it first")
    if out.is_dir():
        raise SettingsError(f"-o {out} is a folder, expected a file; name the weights in it")
    for path in (checkpoint, *(path.with_name(path.name + ".part") for path in (out, checkpoint))):
        if path.is_dir():
            raise SettingsError(
                f"-o {out}: {path} is a folder, and training writes a file of that name; move it, or rename the weights"
            )


def usual_crop(dataset: str) -> int:
    """Return the default size of crops [px]."""
    return FARM_CROP if built_in_laws(dataset) else FRAME_CROP


def run_train(request: TrainRequest, console: Console) -> dict[str, Any]:
    """Train with a progress bar on ``console``; print and return the record."""
    _check_counts(request)
    request = replace(request, command=request.command or asked_command())
    with one_after_the_other(console) as report:
        record = train_weights(
            request, report, lambda note: console.print(f"note: {note}", markup=False, soft_wrap=True)
        )
    _print_figures(record, request, console)
    return record


def _check_counts(request: TrainRequest) -> None:
    settings = request.settings
    counts = {
        "--steps": settings.steps,
        "--minutes": settings.minutes,
        "--batch": settings.batch,
        "--crop": settings.crop,
        "--scenes": request.scenes,
        "--patch": request.patch,
        "--width": request.width,
        "--overview-width": request.overview_width,
        "--columns": request.columns,
        **{"--" + name.replace("_", "-"): size for name, size in request.tokens.items()},
    }
    for name, value in counts.items():
        if value is not None and not value > 0:
            raise SettingsError(f"{name} must be above 0, got {value}")
    for name, number in {"--validation": request.validation, "--seed": settings.seed}.items():
        if number is not None and number < 0:
            raise SettingsError(f"{name} must be 0 or more, got {number}")
    if not 0 < settings.darkest_ms <= REFERENCE_MS:
        raise SettingsError(
            f"--min-exposure-ms must be above 0 and at most {REFERENCE_MS:g}, the reference exposure, got"
            f" {settings.darkest_ms}"
        )


def asked_command() -> str:
    """Return the command without folders, for the record."""
    words = [Path(word).name if "/" in word else word for word in sys.argv[1:]]
    return shlex.join(["spectralzoom", *words])


def _print_figures(record: dict[str, Any], request: TrainRequest, console: Console) -> None:
    out = request.out
    console.print(f"weights: {out} ({out.stat().st_size / 1e6:.1f} MB), {record['training']['steps']} steps")
    if "familiar" in record:
        console.print(record["familiar"], markup=False, soft_wrap=True)
    figures = record["validation"]
    if figures is None:
        left = built_in_laws(request.dataset) or request.hold_out or request.choices.get("train_mask") is not None
        on = request.dataset if left else "OTHER_SCENES"
        console.print(
            "no scene was kept for validation; to judge the weights on other scenes: "
            f"spectralzoom evaluate {on} --weights {out}"
            + ("" if left or len(record["split"]["train"]) < 2 else "; or train with some held out: --hold-out NAMES"),
            soft_wrap=True,
        )
        if request.settings.darkest_ms < REFERENCE_MS:
            console.print("the file has no scan performance, by which survey --seconds chooses", soft_wrap=True)
        return
    title = f"{figures['scenes']} scene{'s' if figures['scenes'] > 1 else ''} kept for validation"
    rows = [
        [name, *(f"{figures[name][figure]:.1%}" for figure in ("miou", "overall_accuracy"))]
        for name in ("none", "random", "sobel", "entropy", "gain", "all")
    ]
    console.print(table(("placement", "mIoU", "overall"), rows, title=title))
    console.print(f"none: overview alone; all: every patch in full; others: {figures['share_of_seats']:.0%}")
    if "readings" in record:
        readings = record["readings"]
        scores = readings["miou"] | (record["baselines"] or {})
        beside = ", ".join(f"{name} {100 * miou:.1f}" for name, miou in scores.items())
        console.print(f"mIoU of the whole scenes by each reading: {beside}; kept: {readings['kept']}", soft_wrap=True)

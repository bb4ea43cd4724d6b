"""Run `spectralzoom train`: train weights on labelled scenes and write them with split and figures."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from spectralzoom.flows.settings.model_flags import TrainFlags
from spectralzoom.flows.terminal.figures import counted
from spectralzoom.flows.terminal.progress import one_after_the_other, show_text, table
from spectralzoom.flows.training import figures
from spectralzoom.flows.training.data import (
    Report,
    TrainingData,
    check_out,
    check_taught,
    law_of,
    open_training_data,
    read_farm_name,
    untaught_note,
    zero_sentence,
)
from spectralzoom.flows.training.train_scenes import CAMERA, Scenes, TrainRequest, network_config, observe_all
from spectralzoom.models.evaluation.unlike_scenes import TrainingSpectra
from spectralzoom.models.network.machine import PROCESSOR, choose_device
from spectralzoom.models.network.segmenter import Segmenter
from spectralzoom.models.network.sizes import SegmenterConfig
from spectralzoom.models.network.spectral import Normalisation
from spectralzoom.models.training.capture_augmentation import REFERENCE_MS, CaptureAugmentation
from spectralzoom.models.training.examples import measured_normalisation
from spectralzoom.models.training.mixture import fit_mixture
from spectralzoom.models.training.train import (
    LabelledPixels,
    TrainingSettings,
    halfway,
    linear_classifier,
    scaled,
    train,
)
from spectralzoom.models.weights.checksummed_files import load_checkpoint
from spectralzoom.models.weights.files import (
    CALIBRATION,
    CAPTURED,
    CLASS_VALUES,
    PLAIN,
    SCANS,
    TRAINED_ON,
    TrainedOn,
    Weights,
    add_map_scores,
    add_spectra,
    load_encoder,
    load_weights,
    save_weights,
    with_record,
)
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.simulator.scenes.farm.land import sun_over_farm
from spectralzoom.pipeline.simulator.scenes.laws import FARM_PIXEL_M, built_in_laws

LABEL_ZERO = "label_zero"  # entry in a record
CORRECTED_SCENES = 4  # labelled scenes, at least, whose classifiers a network corrects


def train_weights(
    request: TrainRequest,
    report: Report = lambda what, done, figure: None,
    tell: Callable[[str], None] = lambda note: None,
) -> dict[str, Any]:
    """Train, validate and save weights; return their record. ``tell`` gets notes on left-out scenes.

    Raises SceneError: no labels, a single class, or scenes of different bands or classes; SettingsError: an invalid
    output path, weights to start from that do not fit, or an unavailable device.
    """
    flags, settings = request.flags, request.flags.settings
    checkpoint = request.out.with_name(request.out.name + ".checkpoint")
    check_out(request.out)
    load_checkpoint(checkpoint)  # a damaged one fails before minutes are spent
    if flags.start is not None and not built_in_laws(request.dataset):
        raise SettingsError(
            "--start is for built-in scenes; training on files takes seconds: train anew on all of them together"
        )
    begun = None if flags.start is None else load_weights(flags.start)
    device = choose_device(flags.device)
    data = open_training_data(request.dataset, flags.validation, flags.scenes, CAMERA, **flags.choices())
    for note in data.notes:
        tell(note)
    scenes = observe_all(request, data, report, tell)
    check_classes(request, scenes if data.files is None else scenes.joined, tell)
    if begun is None:
        normalisation = measured_normalisation(scenes.train.examples, math.sqrt(settings.darkest_ms * REFERENCE_MS))
    else:
        check_start(request, begun, scenes)
        normalisation = begun.normalisation
    scenes = scenes.normalised(normalisation)
    learner = Learner(request, data, scenes, normalisation, begun, checkpoint, device, report)
    if data.files is None:
        record = learner.written(learner.network())
    else:
        if len(scenes.untaught) > len(scenes.common.names) - 2:  # the other classes are in scenes for validation
            learner = replace(learner, scenes=scenes.joined)
        mixed = learner.mixture()
        record = learner.written(mixed)  # usable after seconds
        if learner.scenes.validation.examples:
            if (minutes := learner.minutes_left(mixed)) > 0:
                learned = learner.correction(mixed, minutes)
                record = learner.written(learned, learner.whole(learned))
            else:
                kept = counted(len(learner.scenes.validation.keys), "validation scene")
                tell(
                    f"the classifiers took half of --minutes or more: none learns from {kept}, and there is no network"
                )
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
        scenes=len(scenes.train.keys),
        classes=scenes.common.names,
        bands_nm=tuple(nm.tolist()),
        **farm,
    )


def check_classes(request: TrainRequest, scenes: Scenes, tell: Callable[[str], None]) -> None:
    """Tell the classes without a training pixel. Raises SceneError: fewer than two classes have one."""
    untaught = [scenes.common.names[number] for number in scenes.untaught]
    taught = [name for name in scenes.common.names if name not in untaught]
    check_taught(request.dataset, taught, [*scenes.train.keys])
    if untaught:
        tell(untaught_note(untaught))


def check_start(request: TrainRequest, begun: Weights, scenes: Scenes) -> None:
    """Raise SettingsError unless a training can start from these weights.

    Bands, classes and sizes must be theirs, and the training must contain the scenes that they know: its record names
    them all.
    """
    for what, kept in {
        "classes": (begun.class_names, begun.config.untaught) == (scenes.common.names, scenes.untaught),
        "training scenes": {*begun.record.get("split", {}).get("train", {}).values()} <= {*scenes.train.keys.values()},
        "bands": begun.basis == scenes.common.basis,
        "sizes of the network": replace(begun.config, untaught=()) == network_config(scenes.common),
    }.items():
        if not kept:
            raise SettingsError(
                f"--start {request.flags.start}: its training had other {what}; give its data set and options"
            )


@dataclass(frozen=True)
class Learned:
    """Weights and entries of their record."""

    weights: Weights
    found: dict[str, Any]


@dataclass(frozen=True)
class Learner:
    """The ways to learn from normalised scenes, and to write what was learned."""

    request: TrainRequest
    data: TrainingData
    scenes: Scenes
    normalisation: Normalisation
    begun: Weights | None  # to start from
    checkpoint: Path
    device: str
    report: Report

    @cached_property
    def config(self) -> SegmenterConfig:
        """Return the sizes of the networks."""
        return replace(network_config(self.scenes.common), untaught=self.scenes.untaught)

    @cached_property
    def augmentation(self) -> CaptureAugmentation | None:
        """Return the simulation of captures; None for scenes of files that stay as they are."""
        darkest_ms = self.request.flags.min_exposure_ms
        return CaptureAugmentation(self.normalisation, min_exposure_ms=darkest_ms) if self.request.captured else None

    @cached_property
    def spectra(self) -> TrainingSpectra | None:
        """Return the statistics by which a survey tells unlike scenes."""
        scenes = [one.columns[: one.shape[0], : one.shape[1]] for one in self.scenes.train.examples]
        return TrainingSpectra.measured(scenes, self.normalisation.whitening)

    def network(self) -> Learned:
        """Train networks from a linear classifier of mean spectra, or from weights."""
        examples, begun = self.scenes.train.examples, self.begun
        rng = np.random.default_rng([0x1DA])
        pixels = LabelledPixels.drawn(examples, rng, self.augmentation).brightened(self.normalisation.gain_shift, rng)
        start = linear_classifier(pixels, self.config.classes) | (load_encoder() if self.config.deep else {})
        tensors = start if begun is None else begun.segmenter.state_dict()
        model, summary = self._trained(self.config, tensors, self.request.flags.settings)
        if begun is not None:
            mean, frames = halfway(begun.segmenter, model), self.scenes.validation.examples
            model = max((model, mean), key=lambda one: figures.miou_of(self._weights(one), frames)) if frames else mean
        return Learned(self._weights(model), {"training": summary})

    def mixture(self) -> Learned:
        """Fit a mixture of classifiers, without a network."""
        worked, began = time.process_time(), time.monotonic()
        seed = self.request.flags.seed
        mixed = fit_mixture(self.scenes.train.examples, self.normalisation, self.config, seed, self.report)
        seconds, processor = round(time.monotonic() - began, 1), round(time.process_time() - worked, 1)
        spent = {"steps": 0, "seconds": seconds, "processor_seconds": processor}
        found = {"candidates": [asdict(one) for one in mixed.judged], PLAIN: mixed.plain, "training": spent}
        return Learned(self._weights(mixed.segmenter), found)

    def minutes_left(self, mixed: Learned) -> float:
        """Return the minutes for a network, beside two fits of the mixture: the last one to all scenes."""
        spent = mixed.found["training"]["processor_seconds" if self.device == PROCESSOR else "seconds"]
        return float(self.request.flags.minutes - 2 * spent / 60)

    def correction(self, mixed: Learned, minutes: float) -> Learned:
        """Train networks that correct a mixture; return the mixture unless they read the validation scenes better."""
        scenes = self.scenes
        if len(scenes.joined.train.examples) < CORRECTED_SCENES:
            return Learned(mixed.weights, {})
        config = replace(mixed.weights.config, corrected=True)
        start = {**mixed.weights.segmenter.state_dict(), **(load_encoder() if config.deep else {})}
        scores: dict[float, float] = {}

        def best(model: Segmenter) -> float:
            scores.update(figures.corrected_miou(mixed.weights, self._weights(model), scenes.validation.examples))
            return max(scores, key=lambda part: scores[part])

        settings = replace(self.request.flags.settings, minutes=minutes)
        model, summary = self._trained(config, start, settings, lambda model: best(model) > 0)
        stopped = bool(scores) and max(scores, key=lambda part: scores[part]) == 0
        part = 0.0 if stopped else best(model)
        found = {"training": summary, "corrections": {f"{part:g}": miou for part, miou in scores.items()}}
        return Learned(self._weights(scaled(model, part)) if part else mixed.weights, found)

    def whole(self, learned: Learned) -> Learned:
        """Fit the mixture to all scenes, those for validation too; networks that correct it stay as they are."""
        anew = replace(self, scenes=self.scenes.joined).mixture()
        own, networks = anew.weights.segmenter, learned.weights.segmenter.state_dict()
        if learned.weights.config.corrected:
            own = Segmenter(replace(own.config, corrected=True)).eval()
            own.load_state_dict({**networks, **anew.weights.segmenter.state_dict()})
        return Learned(self._weights(own), {**anew.found, **learned.found})

    def written(self, learned: Learned, whole: Learned | None = None) -> dict[str, Any]:
        """Judge weights by the validation scenes, save them or those of the ``whole`` data, and return the record."""
        taught, kept = (self.scenes, learned) if whole is None else (self.scenes.joined, whole)
        seed, frames = self.request.flags.seed, self.scenes.validation
        record = {**self._about(taught), **kept.found, **self._judged(learned.weights)}
        laws = [law_of(name) if built_in_laws(self.request.dataset) else "" for name in frames.keys]
        judged = with_record(learned.weights, **record)
        scans = figures.judge_scans(judged, frames.examples, laws, self.augmentation, seed, self.report)
        if scans is not None:
            record[SCANS] = scans[0]
        save_weights(with_record(kept.weights.on(PROCESSOR), **record), self.request.out)
        if self.spectra is not None:
            add_spectra(self.request.out, self.spectra)
        if scans is not None:
            add_map_scores(self.request.out, scans[1])
        return record

    def _about(self, taught: Scenes) -> dict[str, Any]:
        """Return the entries of a record on command and data, for weights that learned from some scenes."""
        request, data, values = self.request, self.data, self.scenes.common.values
        return {
            "command": request.command,
            "data": data.law,
            **({CLASS_VALUES: list(values)} if values else {}),
            TRAINED_ON: asdict(_trained_on(data, taught, request.flags.min_exposure_ms)),
            "split": {
                **taught.split,
                "validation": self.scenes.validation.keys,
                "validated": [*self.scenes.validation.content],
                "held_out": list(data.held_out),
            },
            **({} if data.files is None else {LABEL_ZERO: taught.label_zero}),
            "settings": asdict(request.flags.settings),
            "camera": asdict(CAMERA),
            CAPTURED: request.captured,
            "device": self.device,
            **({} if self.begun is None else {"started_from": self.begun.record.get("command", "")}),
        }

    def _judged(self, weights: Weights) -> dict[str, Any]:
        """Return figures on the validation scenes, for the record."""
        frames = self.scenes.validation.examples
        if not frames:
            return {"validation": None}
        self.report("validating", 0.0, f"{len(frames)} scenes")
        calibration = figures.judge_calibration(weights, frames, self.request.flags.seed)
        return {**figures.judge_reading(weights, frames), CALIBRATION: calibration}

    def _trained(
        self,
        config: SegmenterConfig,
        start: Mapping[str, Any],
        settings: TrainingSettings,
        helps: Callable[[Segmenter], bool] | None = None,
    ) -> tuple[Segmenter, dict[str, Any]]:
        return train(
            config,
            self.scenes.train.examples,
            self.normalisation.gain_shift,
            settings,
            lambda now: self.report("training", now.done, f"step {now.step}, loss {now.loss:.3f}"),
            start=start,
            helps=helps,
            augmentation=self.augmentation,
            checkpoint=self.checkpoint,
            device=self.device,
        )

    def _weights(self, model: Segmenter) -> Weights:
        common = self.scenes.common
        return Weights(model, common.basis, self.normalisation, common.names, common.colours).on(self.device)


def run_train(request: TrainRequest, console: Console) -> dict[str, Any]:
    """Train with a progress bar on ``console``; print and return the record."""
    check_counts(request.flags)
    with one_after_the_other(console) as report:
        record = train_weights(request, report, lambda note: show_text(f"note: {note}", console))
    _print_figures(record, request, console)
    if text := zero_sentence(**record.get(LABEL_ZERO, {})):
        show_text(text, console)
    return record


def check_counts(flags: TrainFlags) -> None:
    """Raise SettingsError for a count that is not positive, or an exposure beyond the reference."""
    least = dict.fromkeys(("steps", "minutes", "learning_rate", "scenes"), "above 0")
    for name, limit in (least | dict.fromkeys(("validation", "seed"), "0 or more")).items():
        value = getattr(flags, name)
        if value is not None and not (value > 0 or (value == 0 and name not in least)):
            raise SettingsError(f"--{name.replace('_', '-')} must be {limit}, got {value}")
    if not 0 < flags.min_exposure_ms <= REFERENCE_MS:
        limits = f"above 0 and at most {REFERENCE_MS:g}, the reference exposure"
        raise SettingsError(f"--min-exposure-ms must be {limits}, got {flags.min_exposure_ms}")


def _print_figures(record: dict[str, Any], request: TrainRequest, console: Console) -> None:
    size_mb = request.out.stat().st_size / 1e6
    steps = record["training"]["steps"]
    show_text(f"weights: {request.out} ({size_mb:.1f} MB){f', {steps} steps' if steps else ''}", console)
    if "candidates" in record:
        rows = [
            [
                one["name"],
                f"{one['miou']:.1%}",
                f"{one['accuracy']:.1%}",
                "" if one is record["candidates"][-1] else f"{one['weight']:.2f}",
                f"{one['seconds']:.1f}",
            ]
            for one in record["candidates"]
        ]
        columns = ("classifier", "mIoU", "overall", "weight", "seconds")
        console.print(table(columns, rows, title="By cross-validation"))
        show_text(
            "values: bands; relative: bands over their norm; around: means in windows; weight: in the mixture", console
        )
        show_text("cross-validation on these scenes is no forecast for other ground", console)
    if "corrections" in record:
        shown = ", ".join(f"{part} {100 * miou:.1f}" for part, miou in record["corrections"].items())
        show_text(f"mIoU of the validation scenes by the fraction of the network's correction: {shown}", console)
    judged = record["validation"]
    if judged is None:
        left = built_in_laws(request.dataset) or request.flags.hold_out
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

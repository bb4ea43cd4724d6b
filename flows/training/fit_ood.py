"""Describe the training data of weights, and fit their out-of-distribution detector.

`spectralzoom train --fit-ood` does so for existing weights: it images the scenes of their training again and adds the
detector to their file. The weights themselves do not change.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from flows.terminal.progress import one_after_the_other
from flows.training.data import Report, TrainingData, open_training_data, read_farm_name
from flows.training.figures import judge_calibration, judge_scans
from flows.training.train_scenes import Scenes, TrainRequest, check_out, observe_all, training_capture
from models.training.capture_augmentation import REFERENCE_MS
from models.training.ood_fit import fit_ood
from models.training.train import TrainingSettings
from models.weights.files import CALIBRATION, MAP_SCORES, TrainedOn, Weights, add_ood, load_weights
from pipeline.errors import SceneError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.simulator.scenes.built_in import built_in_laws
from pipeline.simulator.scenes.farm.farm_scene import FARM_PIXEL_M
from pipeline.simulator.scenes.farm.land import sun_over_farm


def trained_on(data: TrainingData, scenes: Scenes, darkest_ms: float) -> TrainedOn:
    """Return the ranges of the training data; season, sun and scale are known for built-in farms alone."""
    nm = scenes.common.wavelength_nm
    exposures = (darkest_ms, max(darkest_ms, data.camera.exposure_ms))
    span, bands_nm = (float(nm.min()), float(nm.max())), tuple(nm.tolist())
    trained = TrainedOn(len(nm), span, exposures, len(data.train), scenes.common.names, bands_nm=bands_nm)
    if data.files is not None:
        return trained
    moments = [read_farm_name(name)[1:] for name in data.train]
    days, heights = [day for day, _ in moments], [sun_over_farm(*moment).elevation_deg for moment in moments]
    return replace(
        trained, day=(min(days), max(days)), sun_elevation_deg=(min(heights), max(heights)), ground_pixel_m=FARM_PIXEL_M
    )


def fit_and_add(
    weights: Weights,
    files: tuple[Path, Path],
    scenes: Scenes,
    trained: TrainedOn,
    seed: int,
    record: dict[str, Any],
    report: Report,
) -> None:
    """Fit the out-of-distribution detector of the weights in the first of ``files``, and write both into the second.

    Raises SceneError: it cannot be fitted.
    """
    ood_detector = fit_ood(
        scenes.train.examples,
        scenes.validation.examples,
        weights.normalisation,
        darkest_ms=trained.exposure_ms[0],
        bands=trained.bands,
        seed=seed,
        report=lambda done: report("fitting the out-of-distribution detector", done, ""),
    )
    add_ood(*files, ood_detector, trained, record)


@dataclass(frozen=True)
class OodRequest:
    """Request to fit a detector: weights, their data set, and the file to write."""

    dataset: str
    weights: Path
    out: Path
    choices: dict[str, Any] = field(default_factory=dict)  # of load_data_set: labels, bands, wavelengths, masks
    command: str = ""


def measure_ood(request: OodRequest, report: Report = lambda what, done, figure: None) -> dict[str, Any]:
    """Fit the out-of-distribution detector of weights and save it; return its record.

    Raises SettingsError: an invalid output path, other data than those of the training, or no validation scene;
    WeightsError: the weights cannot be read.
    """
    check_out(request.out)
    weights = load_weights(request.weights)
    data, config, settings = _data_of(weights, request), weights.config, weights.record.get("settings", {})
    seed, darkest_ms = int(settings.get("seed", 0)), float(settings.get("darkest_ms", REFERENCE_MS))
    how = TrainRequest(
        request.dataset,
        request.out,
        patch=config.patch,
        columns=config.columns,
        choices=request.choices,
        settings=TrainingSettings(seed=seed),
        camera=data.camera,
    )
    scenes = observe_all(how, data, report)
    if (scenes.common.basis, scenes.common.names) != (weights.basis, weights.class_names):
        raise SettingsError(f"{request.dataset} has other bands or classes than {request.weights} was trained on")
    scenes = scenes.normalised(weights.normalisation)
    report("segmenting validation scenes", 0.0, "")
    frames = scenes.validation.examples
    scans = judge_scans(weights, frames, training_capture(weights.normalisation, darkest_ms), seed, report)
    record = {
        "command": request.command,
        "scenes": len(scenes.train.examples),
        "validation": len(frames),
        CALIBRATION: judge_calibration(weights, frames, seed),
        **({} if scans is None else {MAP_SCORES: scans[1].as_dict()}),
    }
    files, trained = (request.weights, request.out), trained_on(data, scenes, darkest_ms)
    try:
        fit_and_add(weights, files, scenes, trained, seed, record, report)
    except SceneError as error:
        raise SettingsError(f"--fit-ood {request.weights}: {error}") from error
    return record


def _data_of(weights: Weights, request: OodRequest) -> TrainingData:
    """Open the data of the training. Raises SettingsError: the data set is another."""
    split = weights.record.get("split") or {}
    own, kept = list(split.get("train", {})), list(split.get("validation", ()))
    scenes = len(own) if built_in_laws(request.dataset) else None
    camera = LineCamera(**weights.record.get("camera", {}))
    held_out = {} if scenes else {"hold_out": tuple(split.get("held_out", ()))}
    data = open_training_data(request.dataset, len(kept), scenes, camera, **held_out, **request.choices)
    if (list(data.train), list(data.validation)) != (own, kept):
        raise SettingsError(
            f"--fit-ood {request.weights}: these weights were trained on {weights.record.get('data', 'other data')},"
            f" {len(own)} scenes{f', the first {own[0]}' if own else ''}; {request.dataset} has others: give the data"
            " set of their training"
        )
    return data


def run_measure_ood(request: OodRequest, console: Console) -> dict[str, Any]:
    """Fit with a progress bar on ``console``; return the record."""
    with one_after_the_other(console) as report:
        record = measure_ood(request, report)
    summary = f"weights with an out-of-distribution detector: {request.out}, fitted to {record['scenes']} scenes"
    console.print(summary, markup=False, soft_wrap=True)
    error = record[CALIBRATION]["expected_error"]
    console.print(f"calibration error: {100 * error:.2f} points on {record['validation']} scenes", soft_wrap=True)
    return record

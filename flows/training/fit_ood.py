"""Describe the training data of weights, fit their out-of-distribution detector and measure their calibration.

`spectralzoom train --fit-ood` does so for existing weights: it images the scenes of their training again and adds the
detector to their file. The weights themselves do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from flows.terminal.progress import one_after_the_other
from flows.training.data import Report, TrainingData, open_training_data, read_farm_name
from flows.training.figures import judge_scans
from flows.training.train_scenes import TrainRequest, as_read, observe_all
from models.evaluation.metrics import JudgedMap, judge_confidence
from models.reading.inference import map_of_columns
from models.training.capture_augmentation import REFERENCE_MS, CaptureAugmentation
from models.training.examples import Example
from models.training.ood_fit import fit_ood
from models.training.train import TrainingSettings
from models.weights.files import CALIBRATION, Weights, add_ood, load_weights
from models.weights.parts import MAP_SCORES, TrainedOn
from pipeline.errors import SceneError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.simulator.scenes.built_in import built_in_laws
from pipeline.simulator.scenes.farm.farm_scene import FARM_PIXEL_M
from pipeline.simulator.scenes.farm.land import sun_over_farm


@dataclass(frozen=True)
class SeenScenes:
    """Training and validation scenes, with their bands and exposures."""

    train: Sequence[Example]
    validation: Sequence[Example]
    wavelength_nm: NDArray[np.float64]
    darkest_ms: float
    seed: int


def trained_on(data: TrainingData, seen: SeenScenes, classes: tuple[str, ...]) -> TrainedOn:
    """Return the ranges of the training data; season, sun and scale are known for built-in farms alone."""
    low, high = float(seen.wavelength_nm.min()), float(seen.wavelength_nm.max())
    exposures = (seen.darkest_ms, max(seen.darkest_ms, data.camera.exposure_ms))
    bands_nm = tuple(seen.wavelength_nm.tolist())
    trained = TrainedOn(len(bands_nm), (low, high), exposures, len(data.train), classes, bands_nm=bands_nm)
    if data.files is not None:
        return trained
    moments = [read_farm_name(name)[1:] for name in data.train]
    days, heights = [day for day, _ in moments], [sun_over_farm(*moment).elevation_deg for moment in moments]
    return replace(
        trained, day=(min(days), max(days)), sun_elevation_deg=(min(heights), max(heights)), ground_pixel_m=FARM_PIXEL_M
    )


def measured_calibration(weights: Weights, frames: Sequence[Example], seed: int) -> dict[str, Any] | None:
    """Return the calibration of maps of full scans on validation scenes; None without one."""
    maps = []
    for frame in frames:
        grid = SceneGrid(*frame.shape, weights.config.patch, 1)
        _, every_class = map_of_columns(weights, frame.columns.astype(np.float32), grid)
        maps.append(JudgedMap.of(every_class, frame.labels[: grid.height, : grid.width]))
    return judge_confidence(maps, seed) if maps else None


def measure_and_add(
    weights: Weights,
    path: Path,
    seen: SeenScenes,
    trained: TrainedOn,
    record: dict[str, Any],
    report: Report,
    *,
    out: Path | None = None,
) -> str | None:
    """Fit the out-of-distribution detector of the weights in ``path``, and add it there, or in a copy at ``out``.

    Returns a message where it cannot be fitted, else None.
    """
    try:
        ood_detector = fit_ood(
            seen.train,
            seen.validation,
            weights.normalisation,
            darkest_ms=seen.darkest_ms,
            bands=len(seen.wavelength_nm),
            seed=seen.seed,
            report=lambda done: report("fitting the out-of-distribution detector", done, ""),
        )
    except SceneError as error:
        return f"no pixel will be classified as unknown: {error}"
    add_ood(path, out or path, ood_detector, trained, record)
    return None


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
    if not request.out.parent.is_dir() or request.out.is_dir():
        raise SettingsError(f"-o {request.out}: expected the name of a file in a folder that exists")
    weights = load_weights(request.weights)
    data = _data_of(weights, request)
    seen = _observed(weights, data, request, report)
    report("segmenting validation scenes", 0.0, "")
    trained = trained_on(data, seen, weights.class_names)
    augmentation = (
        CaptureAugmentation(weights.normalisation, darkest_ms=seen.darkest_ms)
        if seen.darkest_ms < REFERENCE_MS
        else None
    )
    scans = judge_scans(weights, seen.validation, augmentation, seen.seed, report)
    record = {
        "command": request.command,
        "scenes": len(seen.train),
        "validation": len(seen.validation),
        CALIBRATION: measured_calibration(weights, seen.validation, seen.seed),
        **({} if scans is None else {MAP_SCORES: scans.scores.as_dict()}),
    }
    why = measure_and_add(weights, request.weights, seen, trained, record, report, out=request.out)
    if why is not None:
        raise SettingsError(f"--fit-ood {request.weights}: {why}")
    return record


def _data_of(weights: Weights, request: OodRequest) -> TrainingData:
    """Open the data of the training. Raises SettingsError: the data set is another."""
    split = weights.record.get("split") or {}
    own = list(split.get("train", {}))
    scenes = len(own) if built_in_laws(request.dataset) else None
    camera = LineCamera(**weights.record.get("camera", {}))
    held_out = {} if scenes else {"hold_out": tuple(split.get("held_out", ()))}
    data = open_training_data(
        request.dataset, len(split.get("validation", ())), scenes, camera, **held_out, **request.choices
    )
    if list(data.train) != own or list(data.validation) != list(split.get("validation", ())):
        raise SettingsError(
            f"--fit-ood {request.weights}: these weights were trained on {weights.record.get('data', 'other data')},"
            f" {len(own)} scenes{f', the first {own[0]}' if own else ''}; {request.dataset} has others: give the data"
            " set of their training"
        )
    return data


def _observed(weights: Weights, data: TrainingData, request: OodRequest, report: Report) -> SeenScenes:
    settings, config = weights.record.get("settings", {}), weights.config
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
    examples: list[list[Example]] = []
    about = None
    for what, names in (("imaging scenes", data.train), ("imaging validation scenes", data.validation)):
        if not names:
            raise SettingsError(
                f"--fit-ood {request.weights}: no scene was kept for validation when these weights were trained, which"
                " the false-alarm rate needs; train them with --validation 1 or more"
            )
        found, about = observe_all(how, data, names, what, report, about)
        examples.append(as_read(found, weights.normalisation))
        if (about.basis, about.names) != (weights.basis, weights.class_names):
            raise SettingsError(f"{request.dataset} has other bands or classes than {request.weights} was trained on")
    assert about is not None
    return SeenScenes(examples[0], examples[1], about.wavelength_nm, darkest_ms, seed)


def run_measure_ood(request: OodRequest, console: Console) -> dict[str, Any]:
    """Fit with a progress bar on ``console``; return the record."""
    with one_after_the_other(console) as report:
        record = measure_ood(request, report)
    summary = f"weights with an out-of-distribution detector: {request.out}, fitted to {record['scenes']} scenes"
    console.print(summary, markup=False, soft_wrap=True)
    error = record[CALIBRATION]["expected_error"]
    console.print(f"calibration error: {100 * error:.2f} points on {record['validation']} scenes", soft_wrap=True)
    return record

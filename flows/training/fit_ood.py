"""Describe the training data of weights, and fit their out-of-distribution detector."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from flows.training.data import Report, TrainingData, read_farm_name
from flows.training.train_scenes import Scenes
from models.training.ood_fit import fit_ood
from models.weights.files import TrainedOn, Weights, add_ood
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
    weights: Weights, out: Path, scenes: Scenes, trained: TrainedOn, seed: int, record: dict[str, Any], report: Report
) -> None:
    """Fit the out-of-distribution detector of the weights in the file ``out``, and add it to the file.

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
    add_ood(out, ood_detector, trained, record)

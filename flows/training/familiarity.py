"""What new weights say of what they were trained on, and what is familiar to them: measured as training ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.training.data import Report, TrainingData, read_farm_name
from models.network.spectral import patches_of
from models.reading.inference import glance_of_columns, segment
from models.training.calibration import JudgedMap, judge_confidence
from models.training.examples import Example
from models.training.familiar import fit_familiar
from models.weights.familiar_files import FamiliarWeights, familiar_path, save_familiar
from models.weights.files import Weights, content_key
from models.weights.trained_on import TrainedOn
from pipeline.errors import SceneError
from pipeline.geometry.grid import SceneGrid
from pipeline.simulator.scenes.farm.farm_scene import FARM_PIXEL_M
from pipeline.simulator.scenes.farm.seasons import sun_over_farm


@dataclass(frozen=True)
class SeenScenes:
    """Scenes as training saw them, and those kept from it."""

    train: Sequence[Example]
    validation: Sequence[Example]
    wavelength_nm: NDArray[np.float64]
    darkest_ms: float
    seed: int


def trained_on(data: TrainingData, seen: SeenScenes, classes: tuple[str, ...]) -> TrainedOn:
    """Ranges of what training saw; season, sun and scale of the farm alone, which states them."""
    low, high = float(seen.wavelength_nm.min()), float(seen.wavelength_nm.max())
    exposures = (seen.darkest_ms, max(seen.darkest_ms, data.camera.exposure_ms))
    told = TrainedOn(len(seen.wavelength_nm), (low, high), exposures, len(data.train), classes)
    if data.files is not None:
        return told
    moments = [read_farm_name(name)[1:] for name in data.train]
    days, heights = [day for day, _ in moments], [sun_over_farm(*moment).elevation_deg for moment in moments]
    return TrainedOn(
        told.bands,
        told.wavelength_nm,
        told.exposure_ms,
        told.scenes,
        classes,
        (min(days), max(days)),
        (min(heights), max(heights)),
        FARM_PIXEL_M,
    )


def measured_calibration(weights: Weights, frames: Sequence[Example], seed: int) -> dict[str, Any] | None:
    """How sure of itself the map of a full scan may be, by scenes kept from training; None without one."""
    maps = []
    for frame in frames:
        grid = SceneGrid(*frame.shape, weights.config.patch, weights.config.factor)
        cells, valid = patches_of(frame.fine, grid.patch).astype(np.float32), grid.valid_seats()
        drawn = segment(weights, glance_of_columns(weights, frame.coarse, grid), cells[valid], valid, every_class=True)
        assert drawn.log_probability is not None
        maps.append(JudgedMap.of(drawn.log_probability, frame.labels[: grid.height, : grid.width]))
    return judge_confidence(maps, seed) if maps else None


def save_beside(
    weights: Weights,
    path: Path,
    seen: SeenScenes,
    told: TrainedOn,
    record: dict[str, Any],
    report: Report,
    *,
    out: Path | None = None,
) -> str | None:
    """Measure what is familiar to weights that lie at ``path``, and write it beside them, or to ``out``.

    Gives why there is nothing to write, in words; a file of other weights that lay beside these is then removed.
    """
    try:
        familiar = fit_familiar(
            seen.train,
            seen.validation,
            weights.normalisation,
            darkest_ms=seen.darkest_ms,
            bands=len(seen.wavelength_nm),
            seed=seen.seed,
            report=lambda done: report("measuring what is familiar", done, ""),
        )
    except SceneError as error:
        familiar_path(path).unlink(missing_ok=True)
        return f"nothing will be called unknown: {error}"
    save_familiar(FamiliarWeights(familiar, content_key(path), told, record), out or familiar_path(path))
    return None

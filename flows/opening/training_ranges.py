"""Compare a survey with the data that its weights were trained on."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import BUILT_IN_SCENES
from spectralzoom.models.network.spectral import project
from spectralzoom.models.weights.files import Description, TrainedOn, Weights
from spectralzoom.pipeline.ground.map_grid import median_footprint_m
from spectralzoom.pipeline.ground.view import GroundView
from spectralzoom.pipeline.simulator.scenes.farm.land import sun_over_farm
from spectralzoom.pipeline.simulator.scenes.laws import FARM_PIXEL_M
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.storage.arrays.raster_pixels import RasterPixels

OTHER_UNIT = 20.0  # largest ratio of medians
SAMPLED_ROWS = 64  # rows of which it is measured
DAYS, SUN_DEG, DARKER, SCALE, BAND_NM = 10, 3.0, 0.9, 1.5, 25.0  # tolerances of the ranges of training


def beyond_training(
    settings: Settings, scene: RasterScene, described: Description, trained: TrainedOn | None
) -> list[str]:
    """Return conditions outside of the training data; ``trained`` is None if they are unknown."""
    _, reached = described.basis.matrix(scene.wavelength_nm)
    known = np.ones_like(reached)  # spectral features that training covered
    if trained is not None and trained.bands_nm is not None:
        _, known = described.basis.matrix(np.array(trained.bands_nm))
    found: list[str] = []
    if (known & ~reached).any():
        found.append(f"the bands cover {(known & reached).sum()} of the weights' {known.sum()} spectral features")
    if described.untaught:
        found.append(f"classes without a training pixel, which are never drawn: {', '.join(described.untaught)}")
    if trained is not None:
        if lacking := _lacking(trained.bands_nm or (), scene, described):
            found.append(f"no band near {', '.join(f'{nm:g}' for nm in lacking)} nm")
        low, high = trained.wavelength_nm
        beyond = (scene.wavelength_nm < low - BAND_NM) | (scene.wavelength_nm > high + BAND_NM)
        if 2 * beyond.sum() > len(beyond):
            found.append(f"bands outside of {low:.0f}-{high:.0f} nm: {beyond.sum()} of {len(beyond)}")
        found += _season(settings.moment, trained, now=settings.source == "rig")
        usual = settings.camera.exposure_ms
        least = trained.exposure_ms[0]
        taken = settings.scan_exposure_ms or usual
        shortest = (taken if settings.plain else min(usual, taken)) * scene.light_fraction
        if shortest < DARKER * least and not settings.is_map:  # a raster has no exposures
            under = "" if scene.light_fraction == 1 else " under a clear sky, by their light"
            found.append(f"exposures of {shortest:g} ms{under} (training: {least:g} ms and more, by --min-exposure-ms)")
        pixel_m, known_m = None, trained.ground_pixel_m
        if settings.scene in BUILT_IN_SCENES:
            pixel_m = FARM_PIXEL_M  # independent of the pose
        elif settings.pose is not None:
            pixel_m = median_footprint_m(GroundView(settings.pose, settings.camera.ifov_rad), scene.shape)
        if pixel_m is not None and known_m is not None and not 1 / SCALE <= pixel_m / known_m <= SCALE:
            found.append(f"GSD of {100 * pixel_m:.3g} cm (training: {100 * known_m:.3g} cm)")
    return found


def training_warning(found: Sequence[str], path: Path) -> tuple[str, ...]:
    """Return the warning that conditions lie outside of the training of weights; or nothing."""
    advice = "Expect a poorer map; train on such labelled scenes: spectralzoom train DATASET -o my.safetensors"
    return (f"outside of the training data of {path.name}: {'; '.join(found)}. {advice}",) if found else ()


def _lacking(bands_nm: Sequence[float], scene: RasterScene, described: Description) -> list[float]:
    """Return the bands of a training that a scene has no band near to, where each is a spectral feature of its own."""
    bands = np.unique(bands_nm)
    if not 0 < len(bands) <= described.basis.columns:
        return []
    gaps = np.diff(bands, prepend=-np.inf, append=np.inf)
    near_nm = np.maximum(BAND_NM, np.minimum(gaps[:-1], gaps[1:]) / 2) if len(bands) > 1 else BAND_NM
    apart_nm = np.abs(bands[:, None] - scene.wavelength_nm).min(axis=1)
    return [float(nm) for nm in bands[apart_nm > near_nm]]


def other_unit(raster: RasterPixels, wavelength_nm: NDArray[np.float64], weights: Weights) -> list[str]:
    """Return the median of a raster where it is far from that of training; some rows are read."""
    first = max(0, (raster.grid.height - SAMPLED_ROWS) // 2)
    matrix, reached = weights.basis.matrix(wavelength_nm)
    seen = project(raster.rows(first, min(first + SAMPLED_ROWS, raster.grid.height)), matrix)[..., reached]
    known = float(np.median(weights.normalisation.centre[reached])) if reached.any() else 0.0
    here = float(np.median(seen[np.isfinite(seen)])) if np.isfinite(seen).any() else known
    if known <= 0 or known / OTHER_UNIT <= here <= known * OTHER_UNIT:
        return []
    return [f"values with a median of {here:.3g} (training: {known:.3g}; a scene.toml may state another unit's scale)"]


def _season(moment: tuple[int, float] | None, trained: TrainedOn, *, now: bool) -> list[str]:
    """Return notes on day (of a rig: today) and sun elevation outside of the training data."""
    found = []
    day = moment[0] if moment else datetime.now(UTC).timetuple().tm_yday if now else None
    if day is not None and trained.day is not None:
        first, last = trained.day
        if not first - DAYS <= day <= last + DAYS:
            of_day, *seen = [f"{date(2025, 1, 1) + timedelta(days=one - 1):%B}" for one in (day, first, last)]
            found.append(f"day {day} of the year ({of_day}; training: {' to '.join(seen)})")
    if moment is not None and trained.sun_elevation_deg is not None:
        height = sun_over_farm(*moment).elevation_deg
        low, _ = trained.sun_elevation_deg
        if height < low - SUN_DEG:
            found.append(f"a sun elevation of {height:.0f} degrees (training: {low:.0f} and more)")
    return found

"""What of a survey lies outside of what its weights were trained on, in one note that says what to do."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta
from pathlib import Path

from flows.settings.survey_settings import BUILT_IN_SCENES, Settings
from models.weights.files import Description
from models.weights.parts import TrainedOn
from pipeline.geometry.grid import SceneGrid
from pipeline.ground.map_grid import median_footprint_m
from pipeline.ground.view import GroundView
from pipeline.simulator.scenes.farm.farm_scene import FARM_PIXEL_M
from pipeline.simulator.scenes.farm.seasons import sun_over_farm
from pipeline.simulator.scenes.scene import RasterScene

DAYS, SUN_DEG, DARKER, SCALE, BAND_NM = 10, 3.0, 0.9, 1.5, 25.0  # as much beside its ranges is still within training


def beyond_training(
    settings: Settings, scene: RasterScene, described: Description, trained: TrainedOn | None, path: Path
) -> tuple[str, ...]:
    """One note of all that training did not see, or none; ``trained`` is None where nobody knows what it saw."""
    found = _bands(scene, described, trained)
    if trained is not None:
        grid = SceneGrid(*scene.shape, described.config.patch, described.config.factor)
        found += [*_season(settings, trained), *_light(settings, trained), *_scale(settings, grid, trained)]
    if not found:
        return ()
    return (
        f"outside of what {path.name} was trained on: {'; '.join(found)}. Expect a poorer map; weights that know this"
        f" are trained on labelled scenes of it: spectralzoom train DATASET --init {path.name} -o my.safetensors",
    )


def _bands(scene: RasterScene, described: Description, trained: TrainedOn | None) -> list[str]:
    """Spectral columns without a band, and bands far beyond those of training."""
    _, reached = described.basis.matrix(scene.wavelength_nm)
    found = []
    if not reached.all():
        found.append(f"the bands reach {reached.sum()} of the weights' {len(reached)} spectral columns")
    if trained is not None:
        low, high = trained.wavelength_nm
        beyond = (scene.wavelength_nm < low - BAND_NM) | (scene.wavelength_nm > high + BAND_NM)
        if 2 * beyond.sum() > len(beyond):
            found.append(f"{beyond.sum()} of {len(beyond)} bands, which lie outside of its {low:.0f}-{high:.0f} nm")
    return found


def _season(settings: Settings, trained: TrainedOn) -> list[str]:
    """The day of the look, and how high the sun stands."""
    moment, found = settings.moment, []
    day = moment[0] if moment else datetime.now(UTC).timetuple().tm_yday if settings.source == "rig" else None
    if day is not None and trained.day is not None:
        first, last = trained.day
        if not first - DAYS <= day <= last + DAYS:
            found.append(f"day {day} of the year ({_month(day)}; it saw {_month(first)} to {_month(last)})")
    if moment is not None and trained.sun_elevation_deg is not None:
        height, (low, _) = sun_over_farm(*moment).elevation_deg, trained.sun_elevation_deg
        if height < low - SUN_DEG:
            found.append(f"a sun {height:.0f} degrees high (it saw {low:.0f} and more)")
    return found


def _month(day: int) -> str:
    return f"{date(2025, 1, 1) + timedelta(days=day - 1):%B}"


def _light(settings: Settings, trained: TrainedOn) -> list[str]:
    """Exposures shorter than any that training showed; a raster has none."""
    if settings.is_map:
        return []
    usual, least = settings.camera.exposure_ms, trained.exposure_ms[0]
    asked = {settings.scan_exposure_ms or usual} if settings.plain else {usual, settings.coarse_exposure_ms or usual}
    return [f"lines of {min(asked):g} ms (it saw {least:g} ms and more)"] if min(asked) < DARKER * least else []


def _scale(settings: Settings, grid: SceneGrid, trained: TrainedOn) -> list[str]:
    """A pixel that shows much more or much less of the ground."""
    pixel_m = None
    if settings.scene in BUILT_IN_SCENES:
        pixel_m = FARM_PIXEL_M  # as it is drawn, wherever the rig is said to stand
    elif settings.pose is not None:
        pixel_m = median_footprint_m(GroundView(settings.pose, settings.camera.ifov_rad), (grid.height, grid.width))
    if pixel_m is None or trained.ground_pixel_m is None:
        return []
    if 1 / SCALE <= pixel_m / trained.ground_pixel_m <= SCALE:
        return []
    return [f"pixels of {100 * pixel_m:.3g} cm of the ground (it saw {100 * trained.ground_pixel_m:.3g} cm)"]

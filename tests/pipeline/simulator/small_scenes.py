"""Minimal scenes from arrays, choices of effects and pointing errors for tests of the simulator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.simulator.effects.counting import GAUSSIAN, SHOT
from spectralzoom.pipeline.simulator.effects.effect import Effect
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.pipeline.simulator.render import BY_NAME, EFFECTS
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene, SceneRadiance, SceneRaster, raster_from_values
from spectralzoom.pipeline.simulator.selection import survey_probe


def made_scene(
    planes: ArrayLike, electrons: ArrayLike, wavelength_nm: ArrayLike, white: ArrayLike | None = None, **more: Any
) -> RasterScene:
    """Return a scene of planes (y, x, component) and electrons (component, band); white is their maximum."""
    light = np.asarray(electrons, np.float32)
    brightest = light if light.ndim == 1 else light.max(axis=0)
    radiance = Once.of(SceneRadiance(light, brightest if white is None else np.asarray(white, np.float32)))
    nm = np.asarray(wavelength_nm, np.float64)
    raster = SceneRaster.of(np.ascontiguousarray(planes, np.float32))
    return RasterScene("made", "made", raster, radiance, np.ones(len(nm), np.float32), nm, **more)


def image_scene(values: ArrayLike, camera: LineCamera, wavelength_nm: ArrayLike) -> RasterScene:
    """Return a scene of an image's values (y, x, band)."""
    return raster_from_values(np.asarray(values), camera, name="image", wavelength_nm=np.asarray(wavelength_nm, float))


@contextmanager
def looking_at_less() -> Iterator[None]:
    """Limit the samples of probes, within the context, to about half of those of a small sweep."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(survey_probe, "MOST_SAMPLES", 1000)
        patch.setattr(survey_probe, "FINEST_SAMPLES", 100)
        yield


def leave_slit_unmeasured(patch: pytest.MonkeyPatch) -> None:
    """Skip the comparison of the slit's variants: most of a probe's work, which only slit and rotation need."""
    patch.setattr(survey_probe, "_slit_errors", lambda *_: {})


def seen_at(scene: RasterScene, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return components at points, (..., component): linear between pixels, with the edge repeated outside."""
    found = [map_coordinates(plane, [y, x], order=1, mode="nearest") for plane in np.moveaxis(scene.planes, -1, 0)]
    return np.stack(found, axis=-1)


def effects_on(*names: str) -> dict[Effect, str]:
    """Return effects by their names, in the order of the chain: exact variants, except for cheap shot noise."""
    assert set(names) <= set(BY_NAME)
    return {one: GAUSSIAN if one is SHOT else one.variants[0] for one in EFFECTS if one.name in names}


@dataclass(frozen=True)
class CommonOffset(PointingErrors):
    """Pointing errors with the same offset (along, scan) in px for every sweep."""

    offset_px: float = 0.0
    way_px: tuple[float, float] = (0.0, 0.0)

    def offset(self, sweep_name: str) -> NDArray[np.float64]:
        """Return the same error for every sweep."""
        return np.array(self.way_px)

"""Scenes and probes that tests of the simulator are made with: arrays in, the rest as small as it may be."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pipeline.geometry.camera import LineCamera
from pipeline.lazy import Once
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, SceneRaster


def made_scene(planes: ArrayLike, electrons: ArrayLike, wavelength_nm: ArrayLike, **more: Any) -> RasterScene:
    """A scene of planes (y, x, component) and electrons (component, band), its panel as bright as the greatest."""
    light = np.asarray(electrons, np.float32)
    white = light if light.ndim == 1 else light.max(axis=0)
    nm = np.asarray(wavelength_nm, np.float64)
    raster = SceneRaster.of(np.ascontiguousarray(planes, np.float32))
    return RasterScene(
        "made", "made", raster, Once.of(SceneLight(light, white)), np.ones(len(nm), np.float32), nm, **more
    )


def scene_of(values: ArrayLike, camera: LineCamera | None = None, nm: ArrayLike = (), **more: Any) -> RasterScene:
    """A scene of values (y, x) or (y, x, band), in bands from 400 to 900 nm unless told."""
    cube = np.asarray(values)
    cube = cube[..., None] if cube.ndim == 2 else cube
    bands = (
        np.linspace(400, 900, cube.shape[2]) if len(np.shape(nm)) == 0 or not len(np.asarray(nm)) else np.asarray(nm)
    )
    return raster_from_values(cube, camera or LineCamera(), name="t", wavelength_nm=bands, **more)

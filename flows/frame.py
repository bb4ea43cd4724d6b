"""Frame of all images of a survey, view of its camera, and labels that judge its map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.ground.georeference import georeference_record
from spectralzoom.pipeline.once import Once
from spectralzoom.storage.arrays.georeference import AngularGrid
from spectralzoom.storage.store import Ref, array_digest


@dataclass(frozen=True)
class FieldView:
    """View of a camera on a field: camera, bands, and the parameters of the light but sweeps and effects."""

    camera: LineCamera
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None
    light: Mapping[str, Any]


@dataclass(frozen=True)
class FieldFrame:
    """Frame of the images of a survey: pixels, bands, georeference and nodata."""

    grid: SceneGrid
    ifov_rad: float
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None
    missing: NDArray[np.bool_] | None  # (y, x) nodata; None: no pixel
    geobox: GeoBox | None  # of the fine grid; None: no georeference

    @cached_property
    def key(self) -> dict[str, Any]:
        """Return the parameters of images besides their inputs."""
        bands = {"wavelength_nm": self.wavelength_nm, "fwhm_nm": self.fwhm_nm}
        return {"grid": self.grid, "missing": self.missing, **bands, **georeference_record(self.geobox)}

    def angular_grid(self) -> AngularGrid:
        """Return the grid of the scene's pixels."""
        return AngularGrid(self.ifov_rad, (self.grid.height, self.grid.width), geobox=self.geobox)


@dataclass(frozen=True)
class FieldLabels:
    """Labels of a field in the classes of the weights, without pixels of their training; drawn when first used."""

    read: Once[NDArray[np.uint8] | None]  # (y, x)
    scene: str | None  # key of a built-in scene, which has no other labels; None for other scenes

    @property
    def key(self) -> str:
        """Return what the labels depend on besides the weights; those of a built-in scene are not drawn for it."""
        if self.scene is not None:
            return self.scene
        found = self.read()
        return "none" if found is None else array_digest(found)


@dataclass(frozen=True)
class Prior:
    """The earlier run whose class probabilities a visit starts from."""

    run: str
    probabilities: Ref  # the store with class_probabilities.zarr
    mosaic: Ref  # of that run
    days: float  # between that visit and this one
    day_of_year: float | None  # of this visit; None if it is unknown
    classes: tuple[int, ...]  # of each class of the weights the number in the class probabilities; -1 for a new class
    warned: bool = False  # its map has a warning

    @property
    def key(self) -> dict[str, object]:
        """Return what a map depends on besides `stores`."""
        return {"days": self.days, "day_of_year": self.day_of_year, "classes": self.classes}

    @property
    def stores(self) -> list[Ref]:
        """Return the stores of earlier runs that a visit reads."""
        return [self.probabilities, self.mosaic]

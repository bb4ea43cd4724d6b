"""Area of interest and plots of a survey, on the pixels of its field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from spectralzoom.pipeline.geometry.grid import SceneGrid, patch_means
from spectralzoom.storage.store import array_digest


@dataclass(frozen=True)
class SurveyZones:
    """Zones and plots on the pixels of a field."""

    grid: SceneGrid
    kept: NDArray[np.bool_] | None = None  # (y, x) pixels inside the area; None: all of the field
    plots: Mapping[str, BaseGeometry] | None = None  # by name, in pixels; None where there are none
    notes: tuple[str, ...] = ()

    @cached_property
    def fractions(self) -> NDArray[np.float64] | None:
        """Return the fraction of each patch inside zones (patch,); None: all of it."""
        return None if self.kept is None else patch_means(self.kept, self.grid)

    @property
    def shown_patches(self) -> NDArray[np.bool_] | None:
        """Return the patches (patch,) that hold a pixel to map, which lines have to show; None: all of them."""
        return None if self.fractions is None else self.fractions > 0

    @cached_property
    def left_out(self) -> NDArray[np.bool_] | None:
        """Return the pixels (y, x) outside of zones; None where there are none."""
        return None if self.kept is None else ~self.kept

    @cached_property
    def key(self) -> dict[str, str]:
        """Return the parameters of zones for store keys; empty without zones."""
        return {} if self.kept is None else {"zones": array_digest(self.kept)}

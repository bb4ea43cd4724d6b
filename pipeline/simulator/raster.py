"""What a scene of pixels is made of: planes and labels, drawn when they are first looked at, and the light of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.once import Once

Drawn = tuple[NDArray[np.float32], NDArray[np.uint8] | None]


class Raster:
    """Planes (y, x, component) float32 and labels (y, x) uint8 of a scene, drawn when they are first asked for.

    Their shape is known before. Raises SceneError for an empty one.
    """

    def __init__(self, shape: tuple[int, ...], *, labelled: bool, draw: Callable[[], Drawn]) -> None:
        if len(shape) != 3 or 0 in shape:
            raise SceneError(f"a scene must be (y, x, component) and not empty, got {shape}")
        self.shape = (shape[0], shape[1], shape[2])
        self.labelled = labelled
        self._drawn = Once(lambda: self._checked(*draw()))

    @staticmethod
    def of(planes: NDArray[np.float32], labels: NDArray[np.uint8] | None = None) -> Raster:
        """Hold arrays that are there already; SceneError where they do not fit each other."""
        raster = Raster(planes.shape, labelled=labels is not None, draw=lambda: (planes, labels))
        raster.drawn()
        return raster

    def drawn(self) -> Drawn:
        """Planes and labels (None without any); SceneError where what is drawn is not what was announced."""
        return self._drawn()

    def _checked(self, planes: NDArray[np.float32], labels: NDArray[np.uint8] | None) -> Drawn:
        size = None if labels is None else labels.shape
        if planes.shape != self.shape or size != (self.shape[:2] if self.labelled else None):
            raise SceneError(f"the scene is {self.shape} px, its planes {planes.shape}, its labels {size}; crop or pad")
        return planes, labels


@dataclass(frozen=True)
class Light:
    """Electrons at the default exposure: (component, band) per unit of component, and (band,) of the white panel."""

    electrons: NDArray[np.float32]
    panel_electrons: NDArray[np.float32]

"""What a scene of pixels is made of: planes and labels, drawn when they are first looked at, and the light of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.once import Once

Drawn = tuple[NDArray[np.float32], NDArray[np.uint8] | None]
_BINOMIAL = (np.array([1, 8, 28, 56, 70, 56, 28, 8, 1]) / 256).astype(np.float32)


class SceneRaster:
    """Planes (y, x, component) float32 and labels (y, x) uint8 of a scene, drawn when they are first asked for.

    Their shape is known before. Raises SceneError for an empty one.
    """

    def __init__(self, shape: tuple[int, ...], *, labelled: bool, draw: Callable[[], Drawn]) -> None:
        if len(shape) != 3 or 0 in shape:
            raise SceneError(f"a scene must be (y, x, component) and not empty, got {shape}")
        self.shape = (shape[0], shape[1], shape[2])
        self.labelled = labelled
        self._drawn = Once(lambda: self._checked(*draw()))
        self._thinned: dict[int, Once[NDArray[np.float32]]] = {}
        self._lock = Lock()

    @staticmethod
    def of(planes: NDArray[np.float32], labels: NDArray[np.uint8] | None = None) -> SceneRaster:
        """Hold arrays that are there already; SceneError where they do not fit each other."""
        raster = SceneRaster(planes.shape, labelled=labels is not None, draw=lambda: (planes, labels))
        raster.drawn()
        return raster

    def drawn(self) -> Drawn:
        """Planes and labels (None without any); SceneError where what is drawn is not what was announced."""
        return self._drawn()

    def thinned(self, level: int) -> NDArray[np.float32]:
        """Give the planes blurred, and every ``level``-th pixel of them, the first one first; 1, 2, 4, 8, ...

        From each level to the next every second pixel is left, after the binomial kernel of nine taps (variance 2,
        Burt, Adelson, 1983): what it passes of waves that fewer pixels would show as others is below 2 % from 0.3
        cycles per px on. Outside of the scene its edge is repeated; light is kept.
        """
        if level == 1:
            return self.drawn()[0]
        with self._lock:
            once = self._thinned.setdefault(level, Once(lambda: _halved(_halved(self.thinned(level // 2), 0), 1)))
        return once()

    def _checked(self, planes: NDArray[np.float32], labels: NDArray[np.uint8] | None) -> Drawn:
        size = None if labels is None else labels.shape
        if planes.shape != self.shape or size != (self.shape[:2] if self.labelled else None):
            raise SceneError(f"the scene is {self.shape} px, its planes {planes.shape}, its labels {size}; crop or pad")
        return planes, labels


def _halved(planes: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Every second row or column of the blurred planes; one more than half, for positions up to the last."""
    size, count = planes.shape[axis], planes.shape[axis] // 2 + 1
    half = len(_BINOMIAL) // 2
    total = np.zeros((*planes.shape[:axis], count, *planes.shape[axis + 1 :]), np.float32)
    for offset, weight in enumerate(_BINOMIAL):
        at = np.clip(2 * np.arange(count) + offset - half, 0, size - 1)
        total += weight * planes.take(at, axis=axis)
    return total


@dataclass(frozen=True)
class SceneLight:
    """Electrons at the default exposure: (component, band) per unit of component, and (band,) of the white panel."""

    electrons: NDArray[np.float32]
    panel_electrons: NDArray[np.float32]

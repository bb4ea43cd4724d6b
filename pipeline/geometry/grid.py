"""Define the scene grid: pixels, patches and padding."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import ShapeError

Kind = TypeVar("Kind", bound=np.generic)
UNLABELLED = 255  # pixel without a class, in (y, x) uint8 images of class indices


@dataclass(frozen=True)
class SceneGrid:
    """A scene of ``height`` x ``width`` px with patches of ``patch`` px.

    The padded grid is the smallest multiple of ``patch`` that holds the scene. Patches are numbered row by row.
    """

    height: int
    width: int
    patch: int

    def __post_init__(self) -> None:
        for name in ("height", "width", "patch"):
            if getattr(self, name) < 1:
                raise ShapeError(f"the scene grid's {name} must be at least 1, got {getattr(self, name)}")

    @property
    def padded_shape(self) -> tuple[int, int]:
        """Return (y, x) of the padded fine grid [px]."""
        return -(-self.height // self.patch) * self.patch, -(-self.width // self.patch) * self.patch

    @property
    def patch_shape(self) -> tuple[int, int]:
        """Return (rows, columns) of patches on the padded grid."""
        y, x = self.padded_shape
        return y // self.patch, x // self.patch

    def valid_fraction(self) -> NDArray[np.float64]:
        """Return the fraction of each patch's pixels that lie on the scene, (rows, columns), above 0 and at most 1."""
        rows, columns = self.patch_shape
        down = np.clip(self.height - np.arange(rows) * self.patch, 0, self.patch)
        across = np.clip(self.width - np.arange(columns) * self.patch, 0, self.patch)
        return down[:, None] * across[None, :] / self.patch**2

    def every_patch(self) -> NDArray[np.intp]:
        """Return the numbers of all patches, ascending."""
        rows, columns = self.patch_shape
        return np.arange(rows * columns)

    def patch_origin(self, patch_index: NDArray[np.integer]) -> NDArray[np.intp]:
        """Return (patch, 2) y and x of the first pixel of each patch."""
        rows, columns = np.divmod(np.asarray(patch_index), self.patch_shape[1])
        return np.stack([rows, columns], axis=-1).astype(np.intp) * self.patch


def cuts(size: int, step: int) -> Iterator[slice]:
    """Yield the parts of ``size`` rows or other numbers, ``step`` in each but the last."""
    return (slice(first, min(first + step, size)) for first in range(0, size, step))


def patch_pixels(grid: SceneGrid, image: NDArray[Kind]) -> NDArray[Kind]:
    """Cut a (y, x) image of the scene into patches, (patch, y, x) by their numbers; 0 fills the rest."""
    rows, columns = grid.patch_shape
    p = grid.patch
    padded = np.zeros(grid.padded_shape, image.dtype)
    padded[: grid.height, : grid.width] = image
    return padded.reshape(rows, p, columns, p).transpose(0, 2, 1, 3).reshape(rows * columns, p, p)


def pad_by_reflection(image: NDArray[np.generic], shape: tuple[int, int]) -> NDArray[np.generic]:
    """Extend the first two axes to ``shape`` by reflection; one single pixel is repeated."""
    beyond = [(0, max(size - have, 0)) for size, have in zip(shape, image.shape, strict=False)]
    return np.pad(image, [*beyond, *[(0, 0)] * (image.ndim - len(shape))], mode="reflect")


def patch_means(mask: NDArray[np.bool_], grid: SceneGrid) -> NDArray[np.float64]:
    """Return the mean over the pixels of each patch that lie on the scene, (patch,)."""
    return np.asarray(patch_pixels(grid, mask).mean(axis=(1, 2)) / grid.valid_fraction().ravel())

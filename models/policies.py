"""Attention policies: how much a fine look at each seat is worth, judged from the glance alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from models.inference import Glance
from pipeline.errors import SettingsError, ShapeError

Scores = NDArray[np.float64]
POLICIES = ("entropy", "sobel", "random", "mask")


def score_seats(policy: str, seen: Glance, *, seed: int = 0, mask: NDArray[np.generic] | None = None) -> Scores:
    """Score every seat of the padded grid, (seats,) float64; a seat counts by the share of it that lies on the scene.

    Parameters
    ----------
    policy
        ``entropy`` of the glance's classes, ``sobel`` edges of the coarse image (the paper's ED), ``random`` by
        ``seed``, or ``mask``: a given (y, x) image of the scene's size (the paper's fixed attention policy), in which
        NaN counts as 0.

    Raises
    ------
    SettingsError : an unknown policy, or ``mask`` without a mask.
    ShapeError : a mask of another size than the scene's.
    """
    if policy == "random":
        scores = np.random.default_rng([seed, 0x5EA7]).random(seen.grid.seat_shape)
    elif policy == "mask":
        scores = _mask_scores(seen, mask)
    elif policy in _PIXEL_SCORES:
        scores = _seat_means(_PIXEL_SCORES[policy](seen), seen)
    else:
        raise SettingsError(f"unknown policy {policy!r}; choose one of {', '.join(POLICIES)}")
    share = seen.grid.valid_share()
    worth: Scores = np.where(share > 0, scores, 0.0) * share
    return worth.ravel()


def pixel_entropy(probability: NDArray[np.floating]) -> NDArray[np.float64]:
    """Entropy over the last axis [nat]; a probability of 0 adds 0."""
    from scipy.special import xlogy

    exact = probability.astype(np.float64)
    entropy: NDArray[np.float64] = -xlogy(exact, exact).sum(axis=-1)
    return entropy


def _entropy(seen: Glance) -> NDArray[np.float64]:
    return pixel_entropy(seen.probability)


def _edges(seen: Glance) -> NDArray[np.float64]:
    from scipy.ndimage import sobel

    brightness = seen.columns.astype(np.float64).mean(axis=-1)
    down, across = (sobel(brightness, axis=axis, mode="nearest") for axis in (0, 1))
    edges: NDArray[np.float64] = np.hypot(down, across)
    return edges


_PIXEL_SCORES: dict[str, Callable[[Glance], NDArray[np.float64]]] = {"entropy": _entropy, "sobel": _edges}
SEEING_POLICIES = tuple(_PIXEL_SCORES)  # the others take nothing of a glance but its grid


def _seat_means(pixels: NDArray[np.float64], seen: Glance) -> Scores:
    """Mean over the coarse pixels of each seat that lie on the scene (their share decides at the border)."""
    grid, cells = seen.grid, seen.grid.patch // seen.grid.factor
    coarse = _scene_share((grid.height, grid.width), grid.factor, pixels.shape)
    rows, columns = grid.seat_shape
    weighted = (pixels * coarse).reshape(rows, cells, columns, cells).sum(axis=(1, 3))
    share = coarse.reshape(rows, cells, columns, cells).sum(axis=(1, 3))
    means: Scores = np.divide(weighted, share, out=np.zeros((rows, columns)), where=share > 0)
    return means


def _scene_share(size: tuple[int, int], factor: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Share of each coarse pixel that lies on the scene, on a coarse grid of ``shape``."""
    down, across = (np.clip(px / factor - np.arange(n), 0.0, 1.0) for px, n in zip(size, shape, strict=True))
    share: NDArray[np.float64] = down[:, None] * across[None, :]
    return share


def _mask_scores(seen: Glance, mask: NDArray[np.generic] | None) -> Scores:
    grid = seen.grid
    if mask is None:
        raise SettingsError("the policy 'mask' needs --mask FILE, an image of the scene's size")
    if mask.shape[:2] != (grid.height, grid.width):
        raise ShapeError(f"the mask is {mask.shape[:2]} px, the scene is {(grid.height, grid.width)} px")
    flat = mask.reshape(grid.height, grid.width, -1).astype(np.float64).mean(axis=-1)
    full = np.zeros(grid.padded_shape)
    full[: grid.height, : grid.width] = np.where(np.isnan(flat), 0.0, flat)
    rows, columns = grid.seat_shape
    total = full.reshape(rows, grid.patch, columns, grid.patch).sum(axis=(1, 3))
    share = grid.valid_share() * grid.patch**2
    means: Scores = np.divide(total, share, out=np.zeros((rows, columns)), where=share > 0)
    return means

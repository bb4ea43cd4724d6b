"""Attention policies: how much a fine look at each seat is worth, judged from the glance alone.

One table of those that need neither training nor weights of their own; what stands out in an image is measured in
`models.policies.saliency`, and what lies where in `models.policies.spacing`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from models.network.self_attention import attention_of_seats
from models.policies.saliency import fine_grained, spectral_residual
from models.policies.spacing import centre_scores, random_scores, stratified_scores, uniform_scores
from models.reading.inference import CoarseLook, Glance
from pipeline.errors import SettingsError, ShapeError
from pipeline.geometry.grid import SceneGrid

Scores = NDArray[np.float64]
Policy = Literal[
    "gain",
    "entropy",
    "margin",
    "sobel",
    "saliency",
    "spectral-residual",
    "random",
    "stratified",
    "centre",
    "uniform",
    "mask",
    "vgg-static",
    "vgg-trained",
    "self-attention",
]
POLICIES: tuple[Policy, ...] = get_args(Policy)

MOST_SUMMED = 1e280  # of a mask's values: larger ones are summed in a larger unit


def score_seats(
    policy: str,
    seen: Glance,
    *,
    seed: int = 0,
    mask: NDArray[np.generic] | None = None,
    network: NetworkScore | None = None,
) -> Scores:
    """Score every seat of the padded grid, (seats,) float64; a seat counts by the share of it that lies on the scene.

    Parameters
    ----------
    policy
        What the weights expect a look to gain: ``gain``. How much of the encoder's own attention the place receives:
        ``self-attention``. By the glance's classes: ``entropy``, or ``margin``, 1 less what the likeliest is ahead of
        the next. By the coarse image: ``sobel`` edges (the paper's ED), ``saliency`` (fine-grained) or
        ``spectral-residual``. By place: ``random`` and ``stratified``, by ``seed``, the ``centre`` first, or
        ``uniform``, a grid. Or ``mask``: a given (y, x) image of the scene's size (the paper's fixed attention
        policy), in which NaN counts as 0.
        Or the greatest saliency of the seat's coarse pixels to ``network``: ``vgg-static``, the paper's SA, by
        photographs, or ``vgg-trained``, its TA, by a network that learned from data of one's own.

    Raises
    ------
    SettingsError : an unknown policy, ``mask`` without a mask, or saliency without OpenCV's contrib modules.
    ShapeError : a mask of another size than the scene's.
    """
    if policy == "gain":
        scores = _expected_gain(seen)
    elif policy == "self-attention":
        scores = _received_attention(seen)
    elif policy in _PLACE_SCORES:
        scores = _PLACE_SCORES[policy](seen.grid, seed)
    elif policy == "mask":
        scores = _mask_scores(seen, mask)
    elif policy in _PIXEL_SCORES:
        scores = _seat_means(_PIXEL_SCORES[policy](seen), seen)
    elif policy in _IMAGE_SCORES:
        scores = _seat_means(_on_the_scene(_IMAGE_SCORES[policy], seen), seen)
    elif policy in NETWORK_POLICIES:
        scores = _network_scores(policy, seen, network)
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


def _expected_gain(seen: Glance) -> Scores:
    if seen.gain is None:
        raise SettingsError("the policy 'gain' asks the weights, and nothing was read with them")
    return seen.gain.astype(np.float64)


def _received_attention(seen: Glance) -> Scores:
    if seen.tokens is None:
        raise SettingsError("the policy 'self-attention' asks the weights, and nothing was read with them")
    return attention_of_seats(seen.tokens, seen.grid.seat_shape, seen.grid.factor)


def _entropy(seen: Glance) -> NDArray[np.float64]:
    return pixel_entropy(seen.probability)


def _margin(seen: Glance) -> NDArray[np.float64]:
    ranked = np.sort(seen.probability.astype(np.float64), axis=-1)  # NaN comes last and stays NaN
    second = ranked[..., -2] if ranked.shape[-1] > 1 else 0.0
    margin: NDArray[np.float64] = 1.0 - (ranked[..., -1] - second)
    return margin


def _edges(seen: Glance) -> NDArray[np.float64]:
    from scipy.ndimage import sobel

    brightness = seen.columns.astype(np.float64).mean(axis=-1)
    down, across = (sobel(brightness, axis=axis, mode="nearest") for axis in (0, 1))
    edges: NDArray[np.float64] = np.hypot(down, across)
    return edges


def _on_the_scene(measure: ImageScore, seen: Glance) -> NDArray[np.float64]:
    """Measure the part of the coarse image that lies on the scene; beyond it nothing stands out."""
    y, x = seen.grid.coarse_shape
    pixels = np.zeros(seen.columns.shape[:2])
    pixels[:y, :x] = measure(seen.columns[:y, :x])
    return pixels


ImageScore = Callable[[NDArray[np.floating]], NDArray[np.float64]]
_PIXEL_SCORES: dict[str, Callable[[Glance], NDArray[np.float64]]] = {
    "entropy": _entropy,
    "margin": _margin,
    "sobel": _edges,
}
_IMAGE_SCORES: dict[str, ImageScore] = {"saliency": fine_grained, "spectral-residual": spectral_residual}
_PLACE_SCORES: dict[str, Callable[[SceneGrid, int], Scores]] = {
    "random": random_scores,
    "stratified": stratified_scores,
    "centre": centre_scores,
    "uniform": uniform_scores,
}
NetworkScore = Callable[[CoarseLook], NDArray[np.float64]]  # (y, x) of the padded coarse grid
NETWORK_POLICIES = ("vgg-static", "vgg-trained")  # by the coarse image alone, through a network of the user's
# by what lies around each pixel: a large field may be scored in parts
SEEING_POLICIES = ("gain", "self-attention", *_PIXEL_SCORES, *NETWORK_POLICIES)
IMAGE_POLICIES = tuple(_IMAGE_SCORES)  # by the coarse image of the whole field at once; the glance is not needed
SEEDED_POLICIES = ("random", "stratified")


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


def _network_scores(policy: str, seen: Glance, network: NetworkScore | None) -> Scores:
    """The greatest of the coarse pixels of each seat that lie on the scene, as the paper pools."""
    if network is None:
        raise SettingsError(f"the policy {policy!r} needs --vgg FILE, the weights of VGG19")
    grid, cells = seen.grid, seen.grid.patch // seen.grid.factor
    pixels = network(seen)
    there = _scene_share((grid.height, grid.width), grid.factor, pixels.shape) > 0
    rows, columns = grid.seat_shape
    greatest: Scores = np.where(there, pixels, 0.0).reshape(rows, cells, columns, cells).max(axis=(1, 3))
    return greatest


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
    unit = 2.0**-100 if np.abs(full).max() > MOST_SUMMED else 1.0  # else sums would end the range of numbers
    total = (full * unit).reshape(rows, grid.patch, columns, grid.patch).sum(axis=(1, 3))
    share = grid.valid_share() * grid.patch**2
    means: Scores = np.divide(total, share, out=np.zeros((rows, columns)), where=share > 0) / unit
    return means

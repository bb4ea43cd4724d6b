"""Attention policies: how much a fine look at each patch is worth, judged from the coarse prediction alone.

Two of them measure what stands out in the coarse image (OpenCV's contrib modules). Both look at one grey image, the
mean of all bands after each was stretched to its own range: neither the brightness of a band nor the order of bands
counts. What is not finite takes its band's median, a band without contrast adds nothing, and where no band has any,
nothing stands out. What lies where is scored in `models.policies.spacing`, saliency by VGG19 in `models.policies.vgg`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import scipy
from numpy.typing import NDArray

from models.network.self_attention import attention_of_patches
from models.network.sizes import SCORER_WIDTH, SegmenterConfig, saliency_multiply_adds, scorer_inputs
from models.policies.spacing import centre_scores, random_scores, stratified_scores, uniform_scores
from models.reading.inference import CoarsePass, CoarsePrediction
from pipeline.errors import SettingsError
from pipeline.geometry.grid import SceneGrid

Pixels = NDArray[np.float64]
LEVELS = 65535  # of a stretched band; whole numbers add up alike in any order
DARK, BRIGHT = 0.1, 99.9  # percentiles between which a band is stretched: one dead pixel is not its range
FLAT = 1e-6  # a range smaller than this fraction of the values is rounding, not contrast
MOST_PX = (
    1024  # a side of the image whose spectrum is taken: work and memory of larger ones grow, patches do not show it
)
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


def fine_grained(bands: NDArray[np.floating]) -> Pixels:
    """Contrast of each pixel with six of its surroundings, 24 to 224 px wide, (y, x) in 0..1 of (y, x, band).

    Raises SettingsError where OpenCV is missing, or lacks its contrib modules.
    """
    saliency = _opencv().StaticSaliencyFineGrained_create()
    image = grey_image(bands)
    return np.zeros(bands.shape[:2]) if image is None else _compute(saliency, np.rint(255 * image).astype(np.uint8))


def spectral_residual(bands: NDArray[np.floating]) -> Pixels:
    """Where the image is not what its smoothed log spectrum predicts, (y, x) in 0..1 of (y, x, band).

    The spectrum is that of the whole image at its own size, up to 1024 px a side. (At the 64 px of its authors the
    measure finds objects, not the few pixels of a patch.) Raises SettingsError as `fine_grained`.
    """
    saliency = _opencv().StaticSaliencySpectralResidual_create()
    saliency.setImageHeight(min(bands.shape[0], MOST_PX))
    saliency.setImageWidth(min(bands.shape[1], MOST_PX))
    image = grey_image(bands)
    return np.zeros(bands.shape[:2]) if image is None else _compute(saliency, (255 * image).astype(np.float32))


def grey_image(bands: NDArray[np.floating]) -> Pixels | None:
    """Mean of the bands, each stretched to its own range, stretched itself: (y, x) in 0..1; None without contrast."""
    total = np.zeros(bands.shape[:2], np.int64)
    for number in range(bands.shape[-1]):
        band = _stretched(bands[..., number].astype(np.float64))
        if band is not None:
            total += np.rint(LEVELS * band).astype(np.int64)
    return _stretched(total.astype(np.float64))


def _stretched(values: Pixels) -> Pixels | None:
    """Bring the 0.1 and 99.9 % percentiles to 0 and 1, and what is not finite to the median; None without contrast."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return None
    low, middle, high = np.percentile(finite, (DARK, 50.0, BRIGHT))
    if _is_flat(low, high):  # something small on a plain ground: all that there is to see
        low, high = finite.min(), finite.max()
    if _is_flat(low, high):
        return None
    filled = np.where(np.isfinite(values), values, middle)
    stretched: Pixels = np.clip((filled - low) / (high - low), 0.0, 1.0)
    return stretched


def _is_flat(low: float, high: float) -> bool:
    return bool(high - low <= FLAT * max(abs(low), abs(high)))


def _compute(saliency: Any, image: NDArray[np.generic]) -> Pixels:
    """Let OpenCV measure one image; a number that its logarithm of nothing left behind counts as 0."""
    found = np.asarray(saliency.computeSaliency(np.ascontiguousarray(image))[1], np.float64)
    return np.nan_to_num(found, nan=0.0, posinf=0.0, neginf=0.0)


def _opencv() -> Any:
    try:
        return importlib.import_module("cv2").saliency
    except (ImportError, AttributeError) as error:
        raise SettingsError(
            "the policies saliency and spectral-residual need OpenCV with its contrib modules;"
            " pip install opencv-contrib-python-headless, or choose another policy"
        ) from error


def score_patches(
    policy: str,
    seen: CoarsePrediction,
    *,
    seed: int = 0,
    mask: NDArray[np.generic] | None = None,
    network: NetworkScore | None = None,
) -> Scores:
    """Score every patch of the padded grid, (patches,) float64; a patch counts by the fraction of it that lies on the scene.

    ``policy`` is one of `POLICIES`: what the weights expect a look to gain (``gain``); how much of the encoder's own
    attention the place receives (``self-attention``); by the coarse prediction's classes ``entropy``, or ``margin``, 1 less what
    the likeliest is ahead of the next; by the coarse image ``sobel`` edges (the paper's ED), ``saliency``
    (fine-grained) or ``spectral-residual``; by place ``random`` and ``stratified``, by ``seed``, the ``centre`` first,
    or ``uniform``, a grid; ``mask``: a given (y, x) image of the scene's size (the paper's fixed attention policy), in
    which NaN counts as 0; or the greatest saliency of the patch's coarse pixels to ``network``: ``vgg-static``, the
    paper's SA, by photographs, or ``vgg-trained``, its TA, by a network that learned from data of one's own.

    Raises SettingsError for an unknown policy, ``mask`` without a mask, or saliency without OpenCV's contrib modules;
    ShapeError for a mask of another size than the scene's.
    """
    if (policy == "gain" and seen.gain is None) or (policy == "self-attention" and seen.tokens is None):
        raise SettingsError(f"the policy {policy!r} asks the weights, and nothing was read with them")
    if policy == "gain" and seen.gain is not None:
        scores = seen.gain.astype(np.float64)
    elif policy == "self-attention" and seen.tokens is not None:
        scores = attention_of_patches(seen.tokens, seen.grid.patch_shape, seen.grid.factor)
    elif policy in _PLACE_SCORES:
        scores = _PLACE_SCORES[policy](seen.grid, seed)
    elif policy == "mask":
        scores = _mask_scores(seen, mask)
    elif policy in _PIXEL_SCORES:
        scores = _patch_means(_PIXEL_SCORES[policy].of(seen), seen)
    elif policy in _IMAGE_SCORES:
        y, x = seen.grid.coarse_shape
        pixels = np.zeros(seen.columns.shape[:2])  # beyond the scene nothing stands out
        pixels[:y, :x] = _IMAGE_SCORES[policy].of(seen.columns[:y, :x])
        scores = _patch_means(pixels, seen)
    elif policy in NETWORK_POLICIES:
        scores = _network_scores(policy, seen, network)
    else:
        raise SettingsError(f"unknown policy {policy!r}; choose one of {', '.join(POLICIES)}")
    fraction = seen.grid.valid_fraction()
    expected_gain: Scores = np.where(fraction > 0, scores, 0.0) * fraction
    return expected_gain.ravel()


def score_multiply_adds(policy: str, config: SegmenterConfig, grid: SceneGrid, *, channels: int = 3) -> int:
    """Multiply-adds of scoring every patch of a grid; ``channels`` are those that VGG19 reads, which reads some more."""
    coarse = grid.padded_shape[0] // config.factor, grid.padded_shape[1] // config.factor
    pixels = coarse[0] * coarse[1]
    if policy in NETWORK_POLICIES:
        return saliency_multiply_adds(coarse, config.columns, channels)
    if policy == "self-attention":  # the weights of one layer once more, and their sum over heads and queries
        tokens = pixels // config.patch**2 * config.token_side**2
        return tokens**2 * (config.dim + config.heads)
    if policy == "gain":  # entropy and pooling per coarse pixel, then the network per patch
        inputs, patch_index = scorer_inputs(config), pixels // (config.patch // config.factor) ** 2
        per_patch = SCORER_WIDTH * (inputs + 9 + SCORER_WIDTH + 1) + 1
        return pixels * (2 + config.classes + inputs) + patch_index * per_patch
    score = (_PIXEL_SCORES | _IMAGE_SCORES).get(policy)
    if score is None:  # by place, or given
        return 0
    return (score.adds + score.per_class * config.classes + score.per_column * config.columns) * pixels


def pixel_entropy(probability: NDArray[np.floating]) -> NDArray[np.float64]:
    """Entropy over the last axis [nat]; a probability of 0 adds 0."""
    exact = probability.astype(np.float64)
    entropy: NDArray[np.float64] = -scipy.special.xlogy(exact, exact).sum(axis=-1)
    return entropy


def _margin(seen: CoarsePrediction) -> NDArray[np.float64]:
    ranked = np.sort(seen.probability.astype(np.float64), axis=-1)  # NaN comes last and stays NaN
    second = ranked[..., -2] if ranked.shape[-1] > 1 else 0.0
    margin: NDArray[np.float64] = 1.0 - (ranked[..., -1] - second)
    return margin


def _edges(seen: CoarsePrediction) -> NDArray[np.float64]:
    brightness = seen.columns.astype(np.float64).mean(axis=-1)
    down, across = (scipy.ndimage.sobel(brightness, axis=axis, mode="nearest") for axis in (0, 1))
    edges: NDArray[np.float64] = np.hypot(down, across)
    return edges


class PixelScore(NamedTuple):
    """A score of coarse pixels, and the multiply-adds that it takes of each."""

    of: Callable[[Any], Pixels]
    adds: int
    per_column: int = 0
    per_class: int = 0


_PIXEL_SCORES = {  # of the coarse prediction
    "entropy": PixelScore(lambda seen: pixel_entropy(seen.probability), 2, per_class=1),
    "margin": PixelScore(_margin, 4),
    "sobel": PixelScore(_edges, 19, per_column=1),
}
_IMAGE_SCORES = {  # of the coarse image, (y, x, column)
    "saliency": PixelScore(fine_grained, 75, per_column=2),
    "spectral-residual": PixelScore(spectral_residual, 120, per_column=1),
}
_PLACE_SCORES: dict[str, Callable[[SceneGrid, int], Scores]] = {
    "random": random_scores,
    "stratified": stratified_scores,
    "centre": centre_scores,
    "uniform": uniform_scores,
}
NetworkScore = Callable[[CoarsePass], NDArray[np.float64]]  # (y, x) of the padded coarse grid
NETWORK_POLICIES = ("vgg-static", "vgg-trained")  # by the coarse image alone, through a network of the user's
# by what lies around each pixel: a large field may be scored in parts
SEEING_POLICIES = ("gain", "self-attention", *_PIXEL_SCORES, *NETWORK_POLICIES)
GLANCING_POLICIES = ("gain", "self-attention", "entropy", "margin")  # those that ask what the network made of it
IMAGE_POLICIES = tuple(
    _IMAGE_SCORES
)  # by the coarse image of the whole field at once; the coarse prediction is not needed
SEEDED_POLICIES = ("random", "stratified")


def _patch_means(pixels: NDArray[np.float64], seen: CoarsePrediction) -> Scores:
    """Mean over the coarse pixels of each patch that lie on the scene (their share decides at the border)."""
    grid, cells = seen.grid, seen.grid.patch // seen.grid.factor
    coarse = _scene_fraction((grid.height, grid.width), grid.factor, pixels.shape)
    rows, columns = grid.patch_shape
    weighted = (pixels * coarse).reshape(rows, cells, columns, cells).sum(axis=(1, 3))
    fraction = coarse.reshape(rows, cells, columns, cells).sum(axis=(1, 3))
    means: Scores = np.divide(weighted, fraction, out=np.zeros((rows, columns)), where=fraction > 0)
    return means


def _scene_fraction(size: tuple[int, int], factor: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Fraction of each coarse pixel that lies on the scene, on a coarse grid of ``shape``."""
    down, across = (np.clip(px / factor - np.arange(n), 0.0, 1.0) for px, n in zip(size, shape, strict=True))
    fraction: NDArray[np.float64] = down[:, None] * across[None, :]
    return fraction


def _network_scores(policy: str, seen: CoarsePrediction, network: NetworkScore | None) -> Scores:
    """The greatest of the coarse pixels of each patch that lie on the scene, as the paper pools."""
    if network is None:
        raise SettingsError(f"the policy {policy!r} needs --vgg FILE, the weights of VGG19")
    grid, cells = seen.grid, seen.grid.patch // seen.grid.factor
    pixels = network(seen)
    there = _scene_fraction((grid.height, grid.width), grid.factor, pixels.shape) > 0
    rows, columns = grid.patch_shape
    greatest: Scores = np.where(there, pixels, 0.0).reshape(rows, cells, columns, cells).max(axis=(1, 3))
    return greatest


def _mask_scores(seen: CoarsePrediction, mask: NDArray[np.generic] | None) -> Scores:
    grid = seen.grid
    if mask is None:
        raise SettingsError("the policy 'mask' needs --mask FILE, an image of the scene's size")
    flat = mask.reshape(grid.height, grid.width, -1).astype(np.float64).mean(axis=-1)
    full = np.zeros(grid.padded_shape)
    full[: grid.height, : grid.width] = np.where(np.isnan(flat), 0.0, flat)
    rows, columns = grid.patch_shape
    unit = 2.0**-100 if np.abs(full).max() > MOST_SUMMED else 1.0  # else sums would end the range of numbers
    total = (full * unit).reshape(rows, grid.patch, columns, grid.patch).sum(axis=(1, 3))
    fraction = grid.valid_fraction() * grid.patch**2
    means: Scores = np.divide(total, fraction, out=np.zeros((rows, columns)), where=fraction > 0) / unit
    return means

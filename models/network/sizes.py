"""Sizes of the networks: all that is needed to build them, and to count what they cost, without building them.

Multiply-adds of the segmenter are counted by stage, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from numbers import Integral
from typing import Literal, get_args

from pipeline.errors import ShapeError
from pipeline.geometry.grid import SceneGrid

Positions = Literal["2d"]  # how tokens are told their places: by row and column
MOST_CLASSES = 255  # maps are uint8 and 255 stands for unlabelled
# What nobody builds: sizes beyond these are damage, or an attempt to have memory filled.
MOST = {
    "columns": 4096,
    "patch": 1024,
    "factor": 1024,
    "width": 4096,
    "coarse_width": 4096,
    "dim": 16384,
    "layers": 256,
    "heads": 1024,
    "mlp_ratio": 64,
}
BOTTOM = 4  # pixels a side at the lowest level of a patch
PATCHES_AT_ONCE = 64  # their features fit the caches; larger chunks go to memory and back at every layer
TOKEN_PX = 16  # a token stands for at most so many pixels a side
SCORER_WIDTH = 16  # channels of the network that scores patches
MOST_GAIN = 5.0  # gains are clipped to this [nat per px]; one confident error would outweigh a field
OTHERS = 5  # images that a reader of memories reads beside probabilities: seen, age, lights, step
GATES = 3  # of its own: how far the memory, and the look, are believed; how far both together replace the memory


def level_widths(width: int, patch: int) -> list[int]:
    """Channels of each level, from full patch resolution down to ``BOTTOM`` px: width, 2 width, then 3 width."""
    levels = (patch // BOTTOM).bit_length()
    if patch < BOTTOM or patch != BOTTOM << (levels - 1):
        raise ShapeError(f"a patch must be {BOTTOM} px times a power of two, got {patch}; choose 8, 16 or 32")
    return [width * min(level + 1, 3) for level in range(levels)]


@dataclass(frozen=True)
class SegmenterConfig:
    """Sizes of a segmenter; everything needed to build it again. Raises ShapeError for sizes that do not fit."""

    classes: int
    columns: int = 24
    patch: int = 16
    factor: int = 4
    width: int = 24  # channels of fine pixels
    coarse_width: int = 16  # channels of coarse pixels
    dim: int = 128
    layers: int = 4
    heads: int = 4
    mlp_ratio: int = 3
    positions: Positions = "2d"

    def __post_init__(self) -> None:
        for name in ("classes", *MOST):
            if isinstance(getattr(self, name), bool) or not isinstance(getattr(self, name), Integral):
                raise ShapeError(f"{name} of a segmenter must be a whole number, got {getattr(self, name)!r}")
        if not 2 <= self.classes <= MOST_CLASSES:
            raise ShapeError(f"a segmenter needs 2 to {MOST_CLASSES} classes, got {self.classes}")
        for name, most in MOST.items():
            if not 1 <= getattr(self, name) <= most:
                least = f"{name} of a segmenter must be at least 1"
                raise ShapeError(f"{least} and at most {most}, got {getattr(self, name)}")
        level_widths(self.width, self.patch)  # refuses a patch that cannot be halved down to the lowest level
        if self.patch % self.factor:
            raise ShapeError(f"patch {self.patch} must divide by the factor {self.factor}")
        if self.dim % 4 or self.dim % self.heads:
            raise ShapeError(f"token width {self.dim} must divide by 4 and by its {self.heads} heads")
        if self.positions not in get_args(Positions):
            raise ShapeError(
                f"positions of a segmenter is one of {', '.join(get_args(Positions))}, got {self.positions!r}"
            )

    @property
    def token_side(self) -> int:
        """Tokens a side of a patch: one for every 16 px, so 2 of a patch of 32 px and 1 of smaller ones."""
        return max(1, self.patch // TOKEN_PX)


def scorer_inputs(config: SegmenterConfig) -> int:
    """Numbers that are known of a patch: mean and greatest feature and entropy, and mean probabilities."""
    return 2 * config.coarse_width + config.classes + 2


@dataclass(frozen=True)
class TemporalSizes:
    """All that is needed to build the network again."""

    classes: int
    columns: int
    factor: int = 4  # fine pixels a side of a coarse one
    width: int = 32
    coarse_width: int = 16

    def multiply_adds(self, pixels: int) -> int:
        """Multiply-adds of reading so many fine pixels."""
        entered = 2 * self.classes + OTHERS + self.coarse_width
        fine = 9 * self.width * (entered + self.width + self.classes + GATES)
        coarse = 9 * self.width * (2 * self.columns + 1 + self.coarse_width)
        return pixels * fine + pixels // self.factor**2 * coarse


@dataclass(frozen=True)
class MultiplyAdds:
    """Multiply-adds of one survey's segmentation. Norms, activations, softmax and interpolation count as 0."""

    coarse_prediction: int  # the coarse pass read alone, its part of the map with it
    score: int  # the policy (`models.policies.policies.score_multiply_adds`)
    encode: int  # fine patches to tokens, and the transformer over these
    decode: int  # the map at captured patches

    @property
    def total(self) -> int:
        """Everything together."""
        return self.coarse_prediction + self.score + self.encode + self.decode


def multiply_adds(
    config: SegmenterConfig, grid: SceneGrid, patches: int, bands: int, *, score: int = 0
) -> MultiplyAdds:
    """Count a survey with ``patches`` fine patches of ``bands`` bands, whose policy took ``score``.

    The coarse prediction is the reading of the coarse pass, counted once: fine patches read what is kept of it.
    """
    p, s = config.patch, config.factor
    rows, columns = (size // (p * s) for size in grid.padded_shape)
    cells, side, pixels = rows * columns, config.token_side**2, p * p
    wide, narrow = config.width, config.coarse_width
    basis = pixels * bands * config.columns
    drawn = _head(config, narrow) + pixels * (9 * narrow**2 + narrow * config.classes)
    coarse_prediction = cells * (basis + _stem(config, narrow) + drawn) + _transformer(config, cells * side, 0)
    encode = patches * (basis + _stem(config, wide)) + _transformer(config, patches * side, cells * side)
    under = (p // s + 2) ** 2 * narrow * wide
    decode = patches * (_head(config, wide) + under + pixels * (11 * wide**2 + wide * config.classes))
    return MultiplyAdds(coarse_prediction, score, encode, decode)


def _levels(config: SegmenterConfig, width: int) -> list[tuple[int, int]]:
    """(channels, pixels) of each level of a patch."""
    return [(channels, (config.patch >> i) ** 2) for i, channels in enumerate(level_widths(width, config.patch))]


def _stem(config: SegmenterConfig, width: int) -> int:
    levels = _levels(config, width)
    enter = config.columns * levels[0][0] * levels[0][1]
    blocks = sum(9 * channels * channels * pixels for channels, pixels in levels)
    down = sum(4 * upper * lower * pixels for (upper, _), (lower, pixels) in pairwise(levels))
    return enter + blocks + down + levels[-1][0] * BOTTOM**2 * config.dim


def _head(config: SegmenterConfig, width: int) -> int:
    levels = _levels(config, width)
    blocks = sum(9 * channels * channels * pixels for channels, pixels in levels[:-1])
    up = sum(4 * upper * lower * pixels for (upper, _), (lower, pixels) in pairwise(levels))
    return blocks + up + levels[-1][0] * BOTTOM**2 * config.dim


def _transformer(config: SegmenterConfig, tokens: int, before: int) -> int:
    """Closed form L ((4 + 2 r) d^2 N + 2 N (M + N) d) of N tokens that read M others and each other."""
    d, r = config.dim, config.mlp_ratio
    return config.layers * ((4 + 2 * r) * d * d * tokens + 2 * tokens * (before + tokens) * d)

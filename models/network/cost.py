"""Multiply-adds of the segmenter by stage, in closed form: what a plan costs before and after it is run."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from models.network.sizes import BOTTOM, SegmenterConfig, level_widths
from pipeline.geometry.grid import SceneGrid


@dataclass(frozen=True)
class MultiplyAdds:
    """Multiply-adds of one survey's segmentation. Norms, activations, softmax and interpolation count as 0."""

    glance: int  # the coarse pass read alone, its part of the map with it
    score: int  # the policy (`models.policies.policies.score_multiply_adds`)
    encode: int  # fine patches to tokens, and the transformer over these (a control's: over all that it reads)
    decode: int  # the map at captured seats (a control's: all of it)

    @property
    def total(self) -> int:
        """Everything together."""
        return self.glance + self.score + self.encode + self.decode


def multiply_adds(config: SegmenterConfig, grid: SceneGrid, seats: int, bands: int, *, score: int = 0) -> MultiplyAdds:
    """Count a survey with ``seats`` fine patches of ``bands`` bands, whose policy took ``score``.

    The glance is the reading of the coarse pass, counted once: fine patches read what is kept of it.
    """
    p, s = config.patch, config.factor
    rows, columns = (size // (p * s) for size in grid.padded_shape)
    cells, side, pixels = rows * columns, config.token_side**2, p * p
    wide, narrow = config.width, config.coarse_width
    basis = pixels * bands * config.columns
    drawn = _head(config, narrow) + pixels * (9 * narrow**2 + narrow * config.classes)
    glance = cells * (basis + _stem(config, narrow) + drawn) + _transformer(config, cells * side, 0)
    encode = seats * (basis + _stem(config, wide)) + _transformer(config, seats * side, cells * side)
    under = (p // s + 2) ** 2 * narrow * wide
    decode = seats * (_head(config, wide) + under + pixels * (11 * wide**2 + wide * config.classes))
    return MultiplyAdds(glance, score, encode, decode)


def control_multiply_adds(config: SegmenterConfig, grid: SceneGrid, seats: int, bands: int) -> MultiplyAdds:
    """Count the map of one scene drawn by a control; ``seats`` fine patches are for the paper's network alone.

    A dense network reads every valid seat, whatever was asked for. A policy is not counted.
    """
    p, s = config.patch, config.factor
    cells = grid.padded_shape[0] // (p * s) * (grid.padded_shape[1] // (p * s))
    if config.design == "paper":
        tokens = cells + seats
        patch = p * p * (bands * config.columns + config.columns * config.dim)
        return MultiplyAdds(0, 0, tokens * patch + _transformer(config, tokens, 0), cells * config.dim * config.classes)
    step = 2 if config.sight == "halved" else 1
    patches = -(-grid.height // (p * step)) * -(-grid.width // (p * step))
    looked_at = cells if config.sight == "coarse" else patches
    encode = looked_at * p * p * bands * config.columns + patches * _stem(config, config.width)
    encode += _transformer(config, patches * config.token_side**2, 0)
    last = p * p * (9 * config.width**2 + config.width * config.classes)
    return MultiplyAdds(0, 0, encode, patches * (_head(config, config.width) + last))


def _levels(config: SegmenterConfig, width: int) -> list[tuple[int, int]]:
    """(channels, pixels) of each level of a patch."""
    return [(channels, (config.patch >> i) ** 2) for i, channels in enumerate(level_widths(width, config.patch))]


def _stem(config: SegmenterConfig, width: int) -> int:
    levels = _levels(config, width)
    enter = config.columns * levels[0][0] * levels[0][1]
    blocks = sum(9 * channels * channels * pixels for channels, pixels in levels)
    down = sum(4 * upper * lower * pixels for (upper, _), (lower, pixels) in pairwise(levels))
    kernel = config.columns * config.patch**2 * config.dim if config.patch_kernel else 0
    return enter + blocks + down + levels[-1][0] * BOTTOM**2 * config.dim + kernel


def _head(config: SegmenterConfig, width: int) -> int:
    levels = _levels(config, width)
    blocks = sum(9 * channels * channels * pixels for channels, pixels in levels[:-1])
    up = sum(4 * upper * lower * pixels for (upper, _), (lower, pixels) in pairwise(levels))
    return blocks + up + levels[-1][0] * BOTTOM**2 * config.dim


def _transformer(config: SegmenterConfig, tokens: int, before: int) -> int:
    """Closed form L ((4 + 2 r) d^2 N + 2 N (M + N) d) of N tokens that read M others and each other."""
    d, r = config.dim, config.mlp_ratio
    return config.layers * ((4 + 2 * r) * d * d * tokens + 2 * tokens * (before + tokens) * d)

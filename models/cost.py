"""Multiply-adds of the segmenter by stage, in closed form: what a plan costs before and after it is run."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from models.sizes import BOTTOM, SegmenterConfig, level_widths
from models.vgg_sizes import saliency_multiply_adds
from pipeline.grid import SceneGrid


@dataclass(frozen=True)
class MultiplyAdds:
    """Multiply-adds of one survey's segmentation. Norms, activations, softmax and interpolation count as 0."""

    glance: int  # the coarse pass read alone
    score: int  # the policy
    encode: int  # coarse and fine patches to tokens, and the transformer over both
    decode: int  # the map: coarse pixels and captured seats

    @property
    def total(self) -> int:
        """Everything together."""
        return self.glance + self.score + self.encode + self.decode


SCORE_PER_PIXEL = {  # per coarse pixel; entropy also per class
    "entropy": 2, "margin": 4, "sobel": 19, "saliency": 75, "spectral-residual": 120,
    "random": 0, "stratified": 0, "centre": 0, "uniform": 0, "mask": 0,
}  # fmt: skip


def multiply_adds(config: SegmenterConfig, grid: SceneGrid, seats: int, bands: int, policy: str | None) -> MultiplyAdds:
    """Count a survey with ``seats`` fine patches of ``bands`` bands; ``policy=None`` counts neither glance nor score.

    Without a policy every pixel of the fine pass is read (``all``): no glance is needed, the coarse patches stay.
    """
    p, s = config.patch, config.factor
    rows, columns = (size // (p * s) for size in grid.padded_shape)
    cells = rows * columns
    stem = _stem(config) + p * p * bands * config.columns
    encode = cells * stem + seats * stem + _transformer(config, cells + seats) + _grid(config, cells, seats)
    decode = cells * _coarse_decoder(config) + seats * _fine_decoder(config)
    glance = cells * stem + _transformer(config, cells) + _grid(config, cells, 0) + cells * _coarse_decoder(config)
    if policy is None:
        return MultiplyAdds(0, 0, encode, decode)
    return MultiplyAdds(glance, _score(config, policy, (rows * p, columns * p)), encode, decode)


def _score(config: SegmenterConfig, policy: str, coarse: tuple[int, int]) -> int:
    """The policy over (y, x) coarse pixels; VGG19 reads some more around them."""
    if policy == "vgg-static":
        return saliency_multiply_adds(coarse, config.columns)
    per_pixel = SCORE_PER_PIXEL[policy] + (config.classes if policy == "entropy" else 0)
    return per_pixel * coarse[0] * coarse[1]


def _levels(config: SegmenterConfig) -> list[tuple[int, int]]:
    """(channels, pixels) of each level of a patch."""
    return [(width, (config.patch >> i) ** 2) for i, width in enumerate(level_widths(config.width, config.patch))]


def _stem(config: SegmenterConfig) -> int:
    levels = _levels(config)
    enter = config.columns * levels[0][0] * levels[0][1]
    blocks = sum(9 * width * width * pixels for width, pixels in levels)
    down = sum(4 * upper * lower * pixels for (upper, _), (lower, pixels) in pairwise(levels))
    return enter + blocks + down + levels[-1][0] * BOTTOM**2 * config.dim


def _head(config: SegmenterConfig) -> int:
    levels = _levels(config)
    blocks = sum(9 * width * width * pixels for width, pixels in levels[:-1])
    up = sum(4 * upper * lower * pixels for (upper, _), (lower, pixels) in pairwise(levels))
    return blocks + up + levels[-1][0] * BOTTOM**2 * config.dim


def _transformer(config: SegmenterConfig, tokens: int) -> int:
    """Closed form L ((4 + 2 r) d^2 N + 2 N^2 d)."""
    d, r = config.dim, config.mlp_ratio
    return config.layers * ((4 + 2 * r) * d * d * tokens + 2 * tokens * tokens * d)


def _grid(config: SegmenterConfig, cells: int, seats: int) -> int:
    """Gates of the fine tokens and the 3 x 3 mixing of the seat grid."""
    return seats * 2 * config.dim * config.dim + cells * config.factor**2 * 9 * config.dim


def _coarse_decoder(config: SegmenterConfig) -> int:
    pixels, width = config.patch**2, config.width
    return _head(config) + pixels * (9 * width * width + width * config.classes)


def _fine_decoder(config: SegmenterConfig) -> int:
    pixels, width = config.patch**2, config.width
    return _head(config) + pixels * (2 * width * width + 9 * width * width + width * config.classes)

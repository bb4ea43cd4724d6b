"""Sizes of the networks: all that is needed to build them, and to count what they cost, without building them.

Multiply-adds of the segmenter are counted by stage, in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from numbers import Integral

from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.pipeline.geometry.grid import SceneGrid

MOST_CLASSES = 255  # maps are uint8 and 255 stands for unlabelled
# Larger sizes in a file are damage, or an attempt to fill the memory.
MOST = {
    "columns": 4096,
    "patch": 1024,
    "width": 4096,
    "overview_width": 4096,
    "dim": 16384,
    "layers": 256,
    "heads": 1024,
    "mlp_ratio": 64,
}
BOTTOM = 4  # pixels a side at the lowest level of a patch
PATCHES_AT_ONCE = 64  # their features fit the caches; larger chunks go to memory and back at every layer
CELL_PX = 2  # pixels a side of the spectral features of the temporal reader
VALUES, RELATIVE, AROUND = "values", "relative", "around"  # features of a mixture's parts
MEAN_WINDOWS = (1, 3, 5, 9, 15, 31, 61)  # pixels a side around a pixel whose means are features
SPREAD_WINDOWS = (5, 15, 31, 61)  # the same of standard deviations
AROUND_PX = 5  # pixels a side whose mean spectrum the spectral classifier reads
TOKEN_PX = 32  # pixels a side that a token stands for
PLANES = 3  # beside the spectral features of a pixel: exposure, line spacing, binned samples
OTHERS = 7  # inputs of the temporal reader beside probabilities: seen, age, both lights, line spacing, season (2)
PHOTO_FIRST = 32  # channels of the first convolution of the encoder for large frames
# Its stages: channels, pixels a side of a filter, stride, ratio of inner channels, blocks.
PHOTO_STAGES = ((16, 3, 1, 1, 1), (24, 3, 2, 6, 2), (40, 5, 2, 6, 2), (80, 3, 2, 6, 3), (112, 5, 1, 6, 1))
GATES = 3  # of the temporal reader: weight of prior map, weight of visit, weight of both against the prior map


def level_widths(width: int, patch: int, deep: bool = False) -> list[int]:
    """Return the channels of each level, down to ``BOTTOM`` px: 1, 2, 3 and 3 widths, or 1, 2, 4 and 8 if ``deep``."""
    levels = (patch // BOTTOM).bit_length()
    if patch < BOTTOM or patch != BOTTOM << (levels - 1):
        raise ShapeError(f"a patch must be {BOTTOM} px times a power of two, got {patch}; choose 8, 16 or 32")
    return [width * (2**level if deep else min(level + 1, 3)) for level in range(levels)]


@dataclass(frozen=True)
class SegmenterConfig:
    """Sizes of a segmenter; everything needed to build it again. Raises ShapeError for sizes that do not fit."""

    classes: int
    columns: int = 24
    patch: int = 16
    width: int = 20  # channels of a pixel that the full network reads
    overview_width: int = 8  # channels of a pixel of the overview
    dim: int = 64
    layers: int = 3
    heads: int = 4
    mlp_ratio: int = 3
    deep: bool = False  # an overview for large frames, with an encoder that was trained on ImageNet
    untaught: tuple[int, ...] = ()  # classes without a training pixel: their probability is 0
    # of a mixture: features, hidden channels (0: linear) and weight; none: a linear classifier alone
    parts: tuple[tuple[str, int, float], ...] = ()
    components: tuple[int, int] = (0, 0)  # of spectra and of relative spectra, around a pixel
    corrected: bool = True  # an overview and a full network correct the classifiers of pixels

    @property
    def features(self) -> int:
        """Return the channels of the overview's features."""
        return self.overview_width if self.corrected else 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "untaught", tuple(self.untaught))  # a list in files
        object.__setattr__(self, "components", tuple(self.components))
        object.__setattr__(
            self, "parts", tuple((str(kind), int(hidden), float(weight)) for kind, hidden, weight in self.parts)
        )
        for name in ("classes", *MOST):
            if isinstance(getattr(self, name), bool) or not isinstance(getattr(self, name), Integral):
                raise ShapeError(f"{name} of a segmenter must be a whole number, got {getattr(self, name)!r}")
        if not 2 <= self.classes <= MOST_CLASSES:
            raise ShapeError(f"a segmenter needs 2 to {MOST_CLASSES} classes, got {self.classes}")
        for name, most in MOST.items():
            if not 1 <= getattr(self, name) <= most:
                least = f"{name} of a segmenter must be at least 1"
                raise ShapeError(f"{least} and at most {most}, got {getattr(self, name)}")
        known = all(
            kind in (VALUES, RELATIVE, AROUND) and 0 <= hidden <= MOST["width"] for kind, hidden, _ in self.parts
        )
        if not known or not all(0 <= weight <= 1 for _, _, weight in self.parts):
            raise ShapeError(f"parts of a mixture have features, hidden channels and a weight, got {self.parts}")
        if not all(0 <= size <= self.columns + 1 for size in self.components):
            raise ShapeError(f"components {self.components} of {self.columns} columns do not exist")
        if not {*self.untaught} < {*range(self.classes)}:
            raise ShapeError(f"untaught must be some of the {self.classes} classes, got {self.untaught}")
        level_widths(self.width, self.patch)  # refuses a patch that cannot be halved down to the lowest level
        if self.dim % 4 or self.dim % self.heads:
            raise ShapeError(f"token width {self.dim} must divide by 4 and by its {self.heads} heads")


@dataclass(frozen=True)
class TemporalSizes:
    """All that is needed to build the network again."""

    classes: int
    columns: int
    width: int = 40
    coarse_width: int = 16

    def multiply_adds(self, pixels: int) -> int:
        """Multiply-adds of reading so many fine pixels."""
        fine = self.width * (2 * self.classes + OTHERS + self.coarse_width + 9 + self.classes + GATES)
        coarse = self.width * (2 * self.columns + 1 + 9 + self.coarse_width + self.width + 9) + 9 * self.coarse_width
        return pixels * fine + pixels // CELL_PX**2 * coarse


@dataclass(frozen=True)
class MultiplyAdds:
    """Multiply-adds of one survey's segmentation. Norms, means, activations, softmax and interpolation count as 0."""

    overview: int  # of every pixel
    score: int  # the policy (`models.policies.policies.score_multiply_adds`)
    detail: int  # the full network on chosen patches

    @property
    def total(self) -> int:
        """Everything together."""
        return self.overview + self.score + self.detail


def multiply_adds(
    config: SegmenterConfig, grid: SceneGrid, patches: int, bands: int, *, score: int = 0
) -> MultiplyAdds:
    """Count a field of ``bands`` bands or components, ``patches`` patches read in full; their policy took ``score``."""
    rows, columns = (-(-size // TOKEN_PX) for size in grid.padded_shape)
    tokens = rows * columns
    pixels = math.prod(grid.padded_shape)
    classified = tokens * TOKEN_PX**2 if config.corrected else pixels  # the networks read whole tokens
    base = pixels * bands * config.columns + classified * base_multiply_adds(config)
    if not config.corrected:
        return MultiplyAdds(base, score, 0)
    inputs = config.columns + PLANES
    lowest = level_widths(config.overview_width, TOKEN_PX, config.deep)[-1] * BOTTOM**2
    overview = (_photo_pyramid if config.deep else _pyramid)(inputs, config.overview_width, TOKEN_PX)
    overview += 2 * lowest * config.dim  # to a token and back
    drawn = pixels * config.overview_width * config.classes
    patch = config.patch**2 * config.width * config.classes
    patch += _pyramid(inputs + config.overview_width, config.width, config.patch)
    dim = config.dim  # tokens read each other: L ((4 + 2 r) d^2 N + 2 N^2 d)
    read = config.layers * ((4 + 2 * config.mlp_ratio) * dim * dim * tokens + 2 * tokens * tokens * dim)
    return MultiplyAdds(base + tokens * overview + drawn + read, score, patches * patch)


def base_multiply_adds(config: SegmenterConfig) -> int:
    """Count the classifiers of one pixel; means and standard deviations of windows count as 0."""
    if not config.parts:
        return config.columns * config.classes
    widths = feature_widths(config)
    used = [(kind, hidden) for kind, hidden, weight in config.parts if weight]
    found = config.columns**2  # scene values
    found += sum(config.components) * config.columns if AROUND in dict(used) else 0
    for kind, hidden in used:
        found += (widths[kind] + config.classes) * hidden if hidden else widths[kind] * config.classes
    return found


def feature_widths(config: SegmenterConfig) -> dict[str, int]:
    """Return the number of features of each kind."""
    around = sum(config.components) * (len(MEAN_WINDOWS) + len(SPREAD_WINDOWS))
    return {VALUES: config.columns, RELATIVE: config.columns + 1, AROUND: around}


def _levels(width: int, size: int, deep: bool) -> list[tuple[int, int]]:
    """Channels and pixels of each level of a cell of ``size`` px."""
    return [(channels, (size >> i) ** 2) for i, channels in enumerate(level_widths(width, size, deep))]


def _pyramid(inputs: int, width: int, size: int) -> int:
    """Stem and head of a cell of ``size`` px: the way in, residual blocks, and the ways between levels."""
    levels = _levels(width, size, deep=False)
    blocks = sum(2 * 9 * c**2 * pixels for c, pixels in levels)
    blocks -= 9 * levels[-1][0] ** 2 * levels[-1][1]  # the lowest level has none on the way up
    between = sum(8 * upper * lower * pixels for (upper, _), (lower, pixels) in pairwise(levels))
    return inputs * width * size**2 + blocks + between


def _photo_pyramid(inputs: int, width: int, size: int) -> int:
    """Return the count of the encoder for large frames and the head, in a cell of ``size`` px."""
    levels = _levels(width, size, deep=True)
    pixels = size**2 // 4
    found = inputs * (width + 3) * size**2 + 3 * 9 * PHOTO_FIRST * pixels
    before = PHOTO_FIRST
    for channels, kernel, stride, ratio, blocks in PHOTO_STAGES:
        for block in range(blocks):
            found += (ratio > 1) * ratio * before**2 * pixels
            pixels = pixels if block else pixels // stride**2
            found += ratio * before * (kernel**2 + channels) * pixels
            before = channels
    found += before * levels[-1][0] * pixels
    found += sum(stage[0] * c * side for stage, (c, side) in zip(PHOTO_STAGES, levels[1:], strict=False))
    found += sum(4 * upper * lower * side for (upper, _), (lower, side) in pairwise(levels))
    return found + sum(9 * c**2 * side for c, side in levels[1:-1])

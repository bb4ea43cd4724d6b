"""A mixture of small classifiers of the pixels' spectra and of their surroundings: the base that a network corrects.

Features of a pixel: ``px`` are its whitened columns; ``pxn`` its columns over their norm, and the logarithm of the
norm; ``ctx`` are components of both, with their means and standard deviations in windows around the pixel. A part is a
linear classifier or a network of one hidden layer; the mixture is the weighted mean of their probabilities.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

MEANS = (1, 3, 5, 9, 15, 31, 61)  # px a side of the windows whose means are features
SPREADS = (5, 15, 31, 61)  # of those whose standard deviations are
PX, PXN, CTX = "px", "pxn", "ctx"
LEAST_NORM = 1e-12
FLOOR = 1e-7  # of a class that a training had: no part rules it out


@dataclass(frozen=True)
class MixtureConfig:
    """Sizes of a mixture: everything needed to build it again."""

    parts: tuple[tuple[str, int], ...]  # features and hidden width (0: linear) of each
    own: int = 0  # components of px in ctx
    shape: int = 0  # components of pxn in ctx


def window_means(image: Tensor, side: int) -> Tensor:
    """Return means of ``side`` x ``side`` px of an image (B, c, y, x), whose borders are repeated."""
    if side == 1:
        return image
    half = side // 2
    rows = F.avg_pool2d(F.pad(image, (0, 0, half, half), mode="replicate"), (side, 1), stride=1)
    return F.avg_pool2d(F.pad(rows, (half, half, 0, 0), mode="replicate"), (1, side), stride=1)


class Part(nn.Module):
    """A linear classifier, or one with a hidden layer: features (..., feature) to logits (..., class)."""

    def __init__(self, features: int, hidden: int, classes: int) -> None:
        super().__init__()
        self.first = nn.Linear(features, hidden or classes)
        self.last = nn.Linear(hidden, classes) if hidden else nn.Identity()

    def forward(self, features: Tensor) -> Tensor:
        found: Tensor = self.first(features)
        return self.last(F.relu(found)) if isinstance(self.last, nn.Linear) else found


class Mixture(nn.Module):
    """Probabilities of every class by several parts; logits (B, class, y, x) of columns (B, column, y, x)."""

    def __init__(self, config: MixtureConfig, columns: int, classes: int) -> None:
        super().__init__()
        self.config, self.columns, self.classes = config, columns, classes
        self.register_buffer("to_values", torch.eye(columns))  # whitened columns to scene values
        self.register_buffer("centre", torch.zeros(columns))
        self.register_buffer("own_axes", torch.zeros(columns, config.own))
        self.register_buffer("shape_axes", torch.zeros(columns + 1, config.shape))
        self.register_buffer("shape_centre", torch.zeros(columns + 1))
        self.register_buffer("weight", torch.ones(len(config.parts)) / max(len(config.parts), 1))
        self.register_buffer("prior", torch.zeros(classes))  # added to the logarithms; -inf for a class never taught
        self.parts = nn.ModuleList(Part(self.width(kind), hidden, classes) for kind, hidden in config.parts)

    def width(self, kind: str) -> int:
        """Return the number of features."""
        around = (self.config.own + self.config.shape) * (len(MEANS) + len(SPREADS))
        return {PX: self.columns, PXN: self.columns + 1, CTX: around}[kind]

    def relative(self, columns: Tensor) -> Tensor:
        """Return columns (..., column) over their norm, and its logarithm, (..., column + 1)."""
        values = columns @ self.to_values + self.centre
        norm = values.norm(dim=-1, keepdim=True).clamp_min(LEAST_NORM)
        return torch.cat([values / norm, norm.log()], dim=-1)

    def around(self, image: Tensor) -> Tensor:
        """Return the features of surroundings, (B, column, y, x) -> (B, feature, y, x)."""
        columns = image.movedim(1, -1)
        relative = self.relative(columns) - self.shape_centre
        base = torch.cat([columns @ self.own_axes, relative @ self.shape_axes], dim=-1).movedim(-1, 1)
        means = {side: window_means(base, side) for side in MEANS}
        squares = base.square()
        spreads = [(window_means(squares, side) - means[side].square()).clamp_min(0).sqrt() for side in SPREADS]
        return torch.cat([*means.values(), *spreads], dim=1)

    def features(self, image: Tensor, kinds: Sequence[str]) -> dict[str, Tensor]:
        """Return the features of every pixel by their kind, (B, y, x, feature) each."""
        columns = image.movedim(1, -1)
        made: dict[str, Tensor] = {}
        for kind in dict.fromkeys(kinds):
            made[kind] = {PX: lambda: columns @ self.to_values, PXN: lambda: self.relative(columns)}.get(
                kind, lambda: self.around(image).movedim(1, -1)
            )()
        return made

    def forward(self, image: Tensor) -> Tensor:
        """Return logarithms of the mixed probabilities, (B, class, y, x), with the prior."""
        made = self.features(image, [kind for kind, _ in self.config.parts])
        mixed = sum(
            weight * part(made[kind]).softmax(dim=-1)
            for (kind, _), part, weight in zip(self.config.parts, self.parts, self.weight, strict=True)
        )
        return ((1 - FLOOR) * mixed + FLOOR / self.classes).log().add(self.prior).movedim(-1, 1)

"""Classifiers of the pixels' spectra and of their surroundings, mixed: the base that a network corrects.

Features of a pixel: ``values`` are its spectral features in scene values; ``relative`` are these over their norm, and
the logarithm of the norm; ``around`` are components of both with their means and standard deviations in windows.
"""

from __future__ import annotations

from collections.abc import Collection

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from spectralzoom.models.network.sizes import (
    AROUND,
    MEAN_WINDOWS,
    RELATIVE,
    SPREAD_WINDOWS,
    VALUES,
    SegmenterConfig,
    feature_widths,
)

LEAST_NORM = 1e-12
LEAST = 1e-6  # probability of a class that a training had: no part alone rules it out


def window_means(image: Tensor, side: int) -> Tensor:
    """Return means of ``side`` x ``side`` px of an image (B, c, y, x), whose borders are repeated."""
    half = side // 2
    if not half:
        return image
    rows = F.avg_pool2d(F.pad(image, (0, 0, half, half), mode="replicate"), (side, 1), stride=1)
    return F.avg_pool2d(F.pad(rows, (half, half, 0, 0), mode="replicate"), (1, side), stride=1)


class Part(nn.Module):
    """A linear classifier, or one with a hidden layer: features (..., feature) to logits (..., class)."""

    def __init__(self, features: int, hidden: int, classes: int) -> None:
        super().__init__()
        self.first = nn.Linear(features, hidden or classes)
        self.last = nn.Linear(hidden, classes) if hidden else None

    def forward(self, features: Tensor) -> Tensor:
        """Return the logits."""
        found: Tensor = self.first(features)
        return found if self.last is None else self.last(F.relu(found))


class Mixture(nn.Module):
    """The weighted mean of the parts' probabilities, of whitened columns (B, column, y, x)."""

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.config = config
        own, relative = config.components
        columns, widths = config.columns, feature_widths(config)
        self.to_values = nn.Parameter(torch.eye(columns), requires_grad=False)  # of whitened columns
        self.centre = nn.Parameter(torch.zeros(columns), requires_grad=False)
        self.own_axes = nn.Parameter(torch.zeros(columns, own), requires_grad=False)
        self.relative_axes = nn.Parameter(torch.zeros(columns + 1, relative), requires_grad=False)
        self.relative_centre = nn.Parameter(torch.zeros(columns + 1), requires_grad=False)
        self.prior = nn.Parameter(torch.zeros(config.classes), requires_grad=False)  # added to logarithms
        self.parts = nn.ModuleList(Part(widths[kind], hidden, config.classes) for kind, hidden, _ in config.parts)

    def relative(self, columns: Tensor) -> Tensor:
        """Return scene values (..., column) over their norm, and its logarithm, (..., column + 1)."""
        values = columns @ self.to_values + self.centre
        norm = values.norm(dim=-1, keepdim=True).clamp_min(LEAST_NORM)
        return torch.cat([values / norm, norm.log()], dim=-1)

    def around(self, columns: Tensor) -> Tensor:
        """Return the features of surroundings, (B, y, x, column) -> (B, y, x, feature)."""
        relative = (self.relative(columns) - self.relative_centre) @ self.relative_axes
        base = torch.cat([columns @ self.own_axes, relative], dim=-1).movedim(-1, 1)
        means = {side: window_means(base, side) for side in MEAN_WINDOWS}
        squares = base.square()  # of components around 0: their difference is exact enough
        spreads = [(window_means(squares, side) - means[side].square()).clamp_min(0).sqrt() for side in SPREAD_WINDOWS]
        return torch.cat([*means.values(), *spreads], dim=1).movedim(1, -1)

    def features(self, image: Tensor, kinds: Collection[str]) -> dict[str, Tensor]:
        """Return the features of every pixel, (B, y, x, feature) of each kind."""
        columns = image.movedim(1, -1)
        found: dict[str, Tensor] = {}
        if VALUES in kinds:
            found[VALUES] = columns @ self.to_values
        if RELATIVE in kinds:
            found[RELATIVE] = self.relative(columns)
        if AROUND in kinds:
            found[AROUND] = self.around(columns)
        return found

    def forward(self, image: Tensor) -> Tensor:
        """Return the logarithms of the mixed probabilities and of the prior, (B, class, y, x)."""
        used = [
            (kind, part, weight)
            for (kind, _, weight), part in zip(self.config.parts, self.parts, strict=True)
            if weight
        ]
        found = self.features(image, {kind for kind, _, _ in used})
        mixed = torch.zeros((), device=image.device)
        for kind, part, weight in used:
            mixed = mixed + weight * part(found[kind]).softmax(dim=-1)
        return mixed.clamp_min(LEAST).log().add(self.prior).movedim(-1, 1)

    def by_part(self, image: Tensor, number: int) -> Tensor:
        """Return the logits (B, class, y, x) of one part alone, such as the best plain classifier."""
        kind = self.config.parts[number][0]
        logits: Tensor = self.parts[number](self.features(image, {kind})[kind])
        return logits.movedim(-1, 1)

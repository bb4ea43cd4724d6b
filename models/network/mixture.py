"""Classifiers of the pixels' spectra and of their surroundings, mixed: the base that a network corrects.

Features of a pixel: ``values`` are its spectral features in scene values; ``relative`` are these over their norm, and
the logarithm of the norm; ``around`` are components of both with their means and standard deviations in windows.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from spectralzoom.models.network.sizes import (
    AROUND,
    CONTEXT_WINDOWS,
    MEAN_WINDOWS,
    RELATIVE,
    SPREAD_WINDOWS,
    VALUES,
    SegmenterConfig,
    feature_widths,
)
from spectralzoom.pipeline.geometry.grid import cuts

LEAST_NORM = 1e-12
STRIP_ROWS = 128  # whose features are computed at once
REACH = max(MEAN_WINDOWS) // 2  # rows around a strip that its windows cover
CONTEXT_LEAST = 1e-4  # mean probability of a class around a pixel
LEAST = 1e-6  # probability of a class that a training had: no part alone rules it out


def window_means(image: Tensor, side: int) -> Tensor:
    """Return means of ``side`` x ``side`` px of an image (B, c, y, x), whose borders are repeated.

    Sums are float64, where the device has it: their cost does not depend on the side of the window.
    """
    half = side // 2
    if not half:
        return image
    sums = F.pad(image, (half + 1, half, half + 1, half), mode="replicate")
    sums = sums.to(torch.float32 if image.device.type == "mps" else torch.float64)
    for axis in (2, 3):
        sums, count = sums.cumsum(axis), sums.shape[axis] - side
        sums = sums.narrow(axis, side, count) - sums.narrow(axis, 0, count)
    return sums / side**2


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
        if config.context:
            self.context = Part(len(CONTEXT_WINDOWS) * config.classes, 0, config.classes)

    @property
    def each_part(self) -> list[Part]:
        """Return the parts in their order."""
        return [part for part in self.parts if isinstance(part, Part)]

    def relative(self, columns: Tensor) -> Tensor:
        """Return scene values (..., column) over their norm, and its logarithm, (..., column + 1)."""
        values = columns @ self.to_values + self.centre
        norm = values.norm(dim=-1, keepdim=True).clamp_min(LEAST_NORM)
        return torch.cat([values / norm, norm.log()], dim=-1)

    def around(self, columns: Tensor, rows: slice = slice(None)) -> Tensor:
        """Return the features of surroundings of some rows, (B, y, x, column) -> (B, row, x, feature)."""
        relative = (self.relative(columns) - self.relative_centre) @ self.relative_axes
        base = torch.cat([columns @ self.own_axes, relative], dim=-1).movedim(-1, 1)
        means = {side: window_means(base, side)[:, :, rows] for side in MEAN_WINDOWS}
        squares = base.square()
        spreads = [
            (window_means(squares, side)[:, :, rows] - means[side].square()).clamp_min(0).sqrt()
            for side in SPREAD_WINDOWS
        ]
        return torch.cat([one.to(base.dtype) for one in (*means.values(), *spreads)], dim=1).movedim(1, -1)

    def features(self, image: Tensor, kinds: Collection[str], rows: slice = slice(None)) -> dict[str, Tensor]:
        """Return the features of every pixel of some rows, (B, row, x, feature) of each kind."""
        columns = image.movedim(1, -1)
        found: dict[str, Tensor] = {}
        if VALUES in kinds:
            found[VALUES] = columns[:, rows] @ self.to_values
        if RELATIVE in kinds:
            found[RELATIVE] = self.relative(columns[:, rows])
        if AROUND in kinds:
            found[AROUND] = self.around(columns, rows)
        return found

    def strips(self, image: Tensor, kinds: Collection[str]) -> Iterator[dict[str, Tensor]]:
        """Yield the features of every pixel, `STRIP_ROWS` rows at a time: those of a whole frame take gigabytes."""
        height = image.shape[2]
        for rows in cuts(height, STRIP_ROWS):
            first, last = max(rows.start - REACH, 0), min(rows.stop + REACH, height)
            yield self.features(image[:, :, first:last], kinds, slice(rows.start - first, rows.stop - first))

    def forward(self, image: Tensor) -> Tensor:
        """Return the logarithms of the probabilities, mixed or in context, and of the prior, (B, class, y, x)."""
        mixed = self.mixed(image)
        if self.config.context:
            mixed = self.context(self.surrounding(mixed)).softmax(dim=-1)
        return mixed.clamp_min(LEAST).log().add(self.prior).movedim(-1, 1)

    def of_pixels(self, image: Tensor, kinds: Collection[str], places: Tensor) -> dict[str, Tensor]:
        """Return the features (pixel, feature) of each kind, of ascending ``places`` in one image (1, c, y, x)."""
        some = places.split(torch.bincount(places // (STRIP_ROWS * image.shape[3]), minlength=1).tolist())  # type: ignore[no-untyped-call]
        found: dict[str, list[Tensor]] = {kind: [] for kind in kinds}
        for strip, (own, features) in enumerate(zip(some, self.strips(image, kinds), strict=False)):
            for kind, every in features.items():
                found[kind].append(every.flatten(0, 2)[own - strip * STRIP_ROWS * image.shape[3]])
        return {kind: torch.cat(parts) for kind, parts in found.items()}

    def surrounding(self, mixed: Tensor) -> Tensor:
        """Return logarithms of the mean probabilities around each pixel, (B, y, x, class) -> (B, y, x, feature)."""
        image = mixed.movedim(-1, 1)
        means = [window_means(image, side).to(mixed.dtype) for side in CONTEXT_WINDOWS]
        return torch.cat(means, dim=1).clamp_min(CONTEXT_LEAST).log().movedim(1, -1)

    def mixed(self, image: Tensor) -> Tensor:
        """Return the weighted mean of the parts' probabilities, (B, y, x, class)."""
        used = [
            (kind, part, weight)
            for (kind, _, weight), part in zip(self.config.parts, self.parts, strict=True)
            if weight
        ]
        kinds = {kind for kind, _, _ in used}
        mixed = [
            torch.stack([weight * part(found[kind]).softmax(dim=-1) for kind, part, weight in used]).sum(dim=0)
            for found in self.strips(image, kinds)
        ]
        return torch.cat(mixed, dim=1)

    def by_part(self, image: Tensor, number: int) -> Tensor:
        """Return the logits (B, class, y, x) of one part alone, such as the best plain classifier."""
        kind = self.config.parts[number][0]
        logits = [self.parts[number](found[kind]) for found in self.strips(image, {kind})]
        return torch.cat(logits, dim=1).movedim(-1, 1)

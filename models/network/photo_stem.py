"""Encoder of the overview for large frames: the first blocks of EfficientNet-Lite0, trained on ImageNet.

Its batch norms learn from the crops of a step. Maps are read by means of many crops, which the end of a training sets.
"""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from spectralzoom.models.network.layers import pointwise
from spectralzoom.models.network.sizes import PHOTO_FIRST, PHOTO_STAGES, PLANES

EPSILON = 1e-3  # of its batch norms
COLOUR_SPREAD = 0.5  # of the three colours; columns have a spread of 1


class NormedConv(nn.Module):
    """Convolution and batch norm, for images of even sides; a stride of 2 pads more below and on the right."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> None:
        super().__init__()
        dilation = 2 if kernel == 1 else 1  # as in `pointwise`
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, dilation=dilation, groups=groups, bias=False)
        self.norm = nn.BatchNorm2d(outputs, EPSILON)
        self.before, self.after = (kernel - stride) // 2, (kernel - stride + 1) // 2

    def forward(self, x: Tensor) -> Tensor:
        padded = F.pad(x, (self.before, self.after, self.before, self.after)) if self.after else x
        return cast(Tensor, self.norm(self.conv(padded)))


class InvertedResidual(nn.Module):
    """More channels, a filter for each of them, then fewer channels, (P, c, y, x) (Sandler et al. 2018)."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, ratio: int) -> None:
        super().__init__()
        self.expand = NormedConv(inputs, ratio * inputs) if ratio > 1 else None
        self.filter = NormedConv(ratio * inputs, ratio * inputs, kernel, stride, ratio * inputs)
        self.project = NormedConv(ratio * inputs, outputs)
        self.adds = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        wide = x if self.expand is None else F.relu6(self.expand(x))
        found: Tensor = self.project(F.relu6(self.filter(wide)))
        return x + found if self.adds else found


class PhotoStem(nn.Module):
    """Encoder of a U-Net of four levels: an image to features at every level, each half as large as the last.

    Three colours, sums of the columns, are what the convolutions of photographs read. The lowest level also has the
    features at half of its resolution.
    """

    def __init__(self, inputs: int, widths: list[int]) -> None:
        super().__init__()
        self.enter = pointwise(inputs, widths[0])
        self.colours = pointwise(inputs, 3)
        self.first = NormedConv(3, PHOTO_FIRST, 3, 2)
        stages, before = [], PHOTO_FIRST
        for channels, kernel, stride, ratio, blocks in PHOTO_STAGES:
            repeated = (InvertedResidual(channels, channels, kernel, 1, ratio) for _ in range(blocks - 1))
            stages.append(nn.Sequential(InvertedResidual(before, channels, kernel, stride, ratio), *repeated))
            before = channels
        self.stages = nn.ModuleList(stages)
        self.sides = nn.ModuleList(
            pointwise(stage[0], width) for stage, width in zip(PHOTO_STAGES, widths[1:], strict=False)
        )
        self.low = pointwise(before, widths[-1])
        columns = inputs - PLANES
        with torch.no_grad():  # red, green and blue: the last, the middle and the first column
            places = torch.linspace(columns - 1, 0, 3)[:, None]
            mixed = (1 - (torch.arange(columns) - places).abs()).clamp(min=0)
            self.colours.weight.zero_()
            self.colours.weight[:, :columns, 0, 0] = COLOUR_SPREAD * mixed

    def forward(self, image: Tensor) -> list[Tensor]:
        """Compute the features of each level, finest first, from (B, inputs, y, x); sides divide by 16."""
        image = image.contiguous(memory_format=torch.channels_last)
        x = F.relu6(self.first(self.colours(image)))
        found = [self.enter(image)]
        for number, stage in enumerate(self.stages):
            x = stage(x)
            if number < len(self.sides):
                found.append(self.sides[number](x))
        found[-1] = found[-1] + F.interpolate(self.low(x), scale_factor=2.0)
        return found

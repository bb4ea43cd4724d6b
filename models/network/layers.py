"""Layers of the networks that torch has in a slower form."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from spectralzoom.models.network.sizes import AROUND_PX


def pointwise(inputs: int, outputs: int) -> nn.Conv2d:
    """Return a convolution of single pixels. Its dilation has no effect, but torch is 2 to 4 times as fast with it.

    Without a dilation one thread takes a matrix product of planes, for which it copies the image.
    """
    return nn.Conv2d(inputs, outputs, 1, dilation=2)


def mean_around(image: Tensor) -> Tensor:
    """Return means of up to ``AROUND_PX`` x ``AROUND_PX`` neighbours of each pixel, (B, c, y, x)."""
    reach = AROUND_PX // 2
    box = image.new_ones(image.shape[1], 1, AROUND_PX, AROUND_PX)
    places = (torch.arange(side, dtype=image.dtype, device=image.device) for side in image.shape[2:])
    rows, columns = ((at + reach).clamp(max=len(at) - 1) - (at - reach).clamp(min=0) + 1 for at in places)
    # a tenth of the time of avg_pool2d
    return F.conv2d(image, box, padding=reach, groups=image.shape[1]).div_(rows[:, None] * columns)

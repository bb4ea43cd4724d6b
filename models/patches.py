"""The pixel side of the segmenter: what a patch shows, down to a token and back up to features per pixel."""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.sizes import BOTTOM
from models.sizes import level_widths as level_widths


class ChannelNorm(nn.Module):
    """Root-mean-square norm over the channels of each pixel, independent of neighbours and of the batch."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        """(P, c, y, x) -> the same shape."""
        scale = torch.rsqrt(x.square().mean(dim=1, keepdim=True) + 1e-6)
        return x * scale * self.weight[None, :, None, None]


class Residual(nn.Module):
    """One 3 x 3 convolution around which the input goes on."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = ChannelNorm(channels)
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(P, c, y, x) -> the same shape."""
        mixed: Tensor = x + self.conv(F.gelu(self.norm(x)))
        return mixed


class PatchStem(nn.Module):
    """Patches of spectral columns to features at every level and one token; both scales share it."""

    def __init__(self, columns: int, widths: list[int], dim: int) -> None:
        super().__init__()
        self.enter = nn.Conv2d(columns, widths[0], 1)
        self.scale_shift = nn.Parameter(torch.zeros(2, widths[0]))
        self.blocks = nn.ModuleList(Residual(width) for width in widths)
        self.down = nn.ModuleList(nn.Conv2d(upper, lower, 2, stride=2) for upper, lower in pairwise(widths))
        self.token = nn.Linear(widths[-1] * BOTTOM**2, dim)

    def forward(self, patches: Tensor, *, coarse: bool) -> tuple[list[Tensor], Tensor]:
        """(P, columns, p, p) -> features of each level, finest first, and tokens (P, dim)."""
        x = self.enter(patches) + self.scale_shift[int(coarse)][None, :, None, None]
        features = []
        for level, block in enumerate(self.blocks):
            if level:
                x = self.down[level - 1](x)
            x = block(x)
            features.append(x)
        return features, self.token(x.flatten(1))


class PatchHead(nn.Module):
    """Context vectors and the stem's features back up to features per pixel of each patch."""

    def __init__(self, widths: list[int], dim: int) -> None:
        super().__init__()
        self.bottom = widths[-1]
        self.context = nn.Linear(dim, widths[-1] * BOTTOM**2)
        self.up = nn.ModuleList(nn.Conv2d(lower, 4 * upper, 1) for upper, lower in pairwise(widths))
        self.blocks = nn.ModuleList(Residual(width) for width in widths[:-1])

    def forward(self, features: list[Tensor], context: Tensor) -> Tensor:
        """Features of each level (P, c, y, x) and context (P, dim) -> (P, width, p, p)."""
        x: Tensor = features[-1] + self.context(context).view(-1, self.bottom, BOTTOM, BOTTOM)
        for level in range(len(features) - 2, -1, -1):
            x = features[level] + F.pixel_shuffle(self.up[level](F.gelu(x)), 2)
            x = self.blocks[level](x)
        return x

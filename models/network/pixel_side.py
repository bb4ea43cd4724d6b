"""The pixel side of the segmenter: what a patch shows, down to a token and back up to features per pixel."""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.network.sizes import BOTTOM
from models.network.sizes import level_widths as level_widths


class ChannelNorm(nn.Module):
    """Root-mean-square norm over the channels of each pixel, independent of neighbours and of the batch."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        """(P, c, y, x) -> the same shape."""
        exact = torch.promote_types(x.dtype, torch.float32)
        size = torch.linalg.vector_norm(x, dim=1, keepdim=True, dtype=exact)
        scale = torch.rsqrt(size.square() / x.shape[1] + 1e-6)
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
    """Patches of spectral columns to features at every level and ``side`` x ``side`` tokens."""

    def __init__(self, columns: int, widths: list[int], dim: int, side: int, kernel: int = 0) -> None:
        super().__init__()
        self.embed = nn.Conv2d(columns, dim, kernel, stride=kernel) if kernel else None  # a vision transformer's
        self.enter = nn.Conv2d(columns, widths[0], 1)
        self.blocks = nn.ModuleList(Residual(width) for width in widths)
        self.down = nn.ModuleList(nn.Conv2d(upper, lower, 2, stride=2) for upper, lower in pairwise(widths))
        self.token = nn.Conv2d(widths[-1], dim, BOTTOM // side, stride=BOTTOM // side)

    def forward(self, patches: Tensor) -> tuple[list[Tensor], Tensor]:
        """(P, columns, p, p) -> features of each level, finest first, and tokens (P, side^2, dim), row by row."""
        x = self.enter(patches.contiguous(memory_format=torch.channels_last))  # convolutions run up to 3x as fast on it
        features = []
        for level, block in enumerate(self.blocks):
            if level:
                x = self.down[level - 1](x)
            x = block(x)
            features.append(x)
        # In bfloat16, channels last, a kernel that covers its whole input gives wrong sums (torch 2.13, CPU).
        tokens = self.token(x.contiguous())
        if self.embed is not None:
            tokens = tokens + self.embed(patches.contiguous())
        return features, tokens.flatten(2).transpose(1, 2)


class PatchHead(nn.Module):
    """What tokens learned, and the stem's features, back up to features per pixel of each patch."""

    def __init__(self, widths: list[int], dim: int, side: int) -> None:
        super().__init__()
        self.side = side
        self.context = nn.Conv2d(dim, widths[-1] * (BOTTOM // side) ** 2, 1)
        self.up = nn.ModuleList(nn.Conv2d(lower, 4 * upper, 1) for upper, lower in pairwise(widths))
        self.blocks = nn.ModuleList(Residual(width) for width in widths[:-1])

    def forward(self, features: list[Tensor], tokens: Tensor) -> Tensor:
        """Features of each level (P, c, y, x) and tokens (P, side^2, dim) -> (P, width, p, p)."""
        grid = tokens.transpose(1, 2).reshape(-1, tokens.shape[-1], self.side, self.side)
        x: Tensor = features[-1] + F.pixel_shuffle(self.context(grid), BOTTOM // self.side)
        for level in range(len(features) - 2, -1, -1):
            x = features[level] + F.pixel_shuffle(self.up[level](F.gelu(x)), 2)
            x = self.blocks[level](x)
        return x

"""Parts of the networks: codes of places, the transformer over tokens, and the way from pixels to features and back."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from pipeline.errors import ShapeError

LONGEST_PERIOD = 128.0  # cells of a token; the shortest is 2


def code_2d(yx: Tensor, dim: int) -> Tensor:
    """Sines and cosines of both coordinates, (..., 2) cells -> (..., dim) float32.

    Angular frequencies run geometrically from pi (period 2 cells) to pi/64. Computed in float64 and cast once: at
    1e7 px the error stays below 1e-6, where float32 angles would be off by half a turn.
    Raises ShapeError for a width that does not divide by 4, or places in half precision.
    """
    if dim % 4:
        raise ShapeError(f"a 2-D code needs a width that divides by 4, got {dim}")
    if yx.dtype in (torch.float16, torch.bfloat16):  # whole numbers run together above 2048 and 256
        raise ShapeError(f"places of tokens must be float32, float64 or whole numbers, got {yx.dtype}")
    count = dim // 4
    periods = torch.linspace(math.log(2.0), math.log(LONGEST_PERIOD), count, dtype=torch.float64).exp()
    turns = yx.to(torch.float64)[..., None] / periods.to(yx.device)
    angle = 2 * math.pi * (turns - turns.round())
    return torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2).to(torch.float32)


class TokenAttention(nn.Module):
    """Multi-head attention with normalised queries and keys: bounded logits, safe in half precision."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        if dim % heads:
            raise ShapeError(f"tokens of width {dim} do not divide by {heads} heads; choose another number of heads")
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.out = nn.Linear(dim, dim)
        self.query_norm = nn.RMSNorm(dim // heads, eps=1e-6)
        self.key_norm = nn.RMSNorm(dim // heads, eps=1e-6)

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, d) tokens that read each other -> (B, N, d)."""
        b, n, d = x.shape
        q, k, v = self.qkv(x).view(b, n, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(self.query_norm(q), self.key_norm(k), v)
        joined: Tensor = self.out(mixed.transpose(1, 2).reshape(b, n, d))
        return joined


class EncoderBlock(nn.Module):
    """Pre-norm transformer block, (B, N, d) -> (B, N, d)."""

    def __init__(self, dim: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.attention = TokenAttention(dim, heads)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, mlp_ratio * dim), nn.GELU(), nn.Linear(mlp_ratio * dim, dim))

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attention(self.norm1(x))
        mixed: Tensor = x + self.mlp(self.norm2(x))
        return mixed


class Encoder(nn.Module):
    """A stack of blocks over tokens."""

    def __init__(self, dim: int, layers: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(EncoderBlock(dim, heads, mlp_ratio) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> Tensor:
        """Encode (B, N, d) tokens that read each other."""
        for block in self.blocks:
            x = block(x)
        encoded: Tensor = self.norm(x)
        return encoded


def cut(image: Tensor, patch: int) -> Tensor:
    """An image as patches, row by row: (B, c, y, x) -> (B, N, c, p, p)."""
    b, c, y, x = image.shape
    cells = image.view(b, c, y // patch, patch, x // patch, patch).permute(0, 2, 4, 1, 3, 5)
    return cells.reshape(b, y // patch * (x // patch), c, patch, patch)


def joined(patches: Tensor, columns: int) -> Tensor:
    """Undo ``cut``: patches in rows of ``columns``, (B, N, c, p, p) -> (B, c, y, x)."""
    b, n, c, p, _ = patches.shape
    cells = patches.view(b, n // columns, columns, c, p, p).permute(0, 3, 1, 4, 2, 5)
    return cells.reshape(b, c, n // columns * p, columns * p)


class ChannelNorm(nn.Module):
    """Root-mean-square norm over the channels of each pixel (P, c, y, x), whatever its neighbours and the batch."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        exact = torch.promote_types(x.dtype, torch.float32)
        scale = torch.rsqrt(x.to(exact).square().mean(dim=1, keepdim=True) + 1e-6)
        return x * scale * self.weight[None, :, None, None]


class Residual(nn.Module):
    """One 3 x 3 convolution around which the input (P, c, y, x) goes on."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = ChannelNorm(channels)
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        mixed: Tensor = x + self.conv(F.gelu(self.norm(x)))
        return mixed


class Stem(nn.Module):
    """The way down: an image to features at every level, each half as large as the one before."""

    def __init__(self, inputs: int, widths: list[int]) -> None:
        super().__init__()
        self.enter = nn.Conv2d(inputs, widths[0], 1)
        self.blocks = nn.ModuleList(Residual(width) for width in widths)
        self.down = nn.ModuleList(nn.Conv2d(upper, lower, 2, stride=2) for upper, lower in pairwise(widths))

    def forward(self, image: Tensor) -> list[Tensor]:
        """(B, inputs, y, x) -> features of each level, finest first."""
        x = self.enter(image.contiguous(memory_format=torch.channels_last))  # convolutions run up to 3x as fast on it
        features = []
        for level, block in enumerate(self.blocks):
            if level:
                x = self.down[level - 1](x)
            x = block(x)
            features.append(x)
        return features


class Head(nn.Module):
    """The way up: features of each level, and what was added to the lowest, to features of each pixel."""

    def __init__(self, widths: list[int]) -> None:
        super().__init__()
        self.up = nn.ModuleList(nn.Conv2d(lower, 4 * upper, 1) for upper, lower in pairwise(widths))
        self.blocks = nn.ModuleList(Residual(width) for width in widths[:-1])

    def forward(self, features: list[Tensor]) -> Tensor:
        """Features of each level, finest first, (B, c, y, x) -> (B, width, y, x) of the finest."""
        x = features[-1]
        for level in range(len(features) - 2, -1, -1):
            x = features[level] + F.pixel_shuffle(self.up[level](F.gelu(x)), 2)
            x = self.blocks[level](x)
        return x

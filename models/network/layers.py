"""Parts of the networks: codes of places, the transformer over tokens, and a patch's pixels down to them and back.

In the transformer coarse tokens read each other and fine tokens read both; nothing flows from fine to coarse. So what a
coarse pass says is computed once: the coarse prediction keeps the keys and values of its tokens, and a second pass pays
for its own tokens only, however often places are added.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.network.sizes import BOTTOM
from pipeline.errors import ShapeError

LONGEST_PERIOD = 128.0  # patches; the shortest is 2
Memory = tuple[Tensor, Tensor]  # keys and values of one layer, (B, heads, N, d / heads)


def code_2d(yx: Tensor, dim: int) -> Tensor:
    """Sines and cosines of both coordinates, (..., 2) patches -> (..., dim) float32.

    Angular frequencies run geometrically from pi (period 2 patches) to pi/64. Computed in float64 and cast once: at
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

    def forward(self, x: Tensor, before: Memory | None) -> tuple[Tensor, Memory]:
        """(B, N, d) tokens that read ``before`` and each other -> (B, N, d), and their own keys and values."""
        b, n, d = x.shape
        q, own = self.ask(x)
        keys, values = own if before is None else (torch.cat(pair, dim=2) for pair in zip(before, own, strict=True))
        mixed = F.scaled_dot_product_attention(q, keys, values)
        joined: Tensor = self.out(mixed.transpose(1, 2).reshape(b, n, d))
        return joined, own

    def ask(self, x: Tensor) -> tuple[Tensor, Memory]:
        """Queries (B, heads, N, d / heads) of (B, N, d) tokens, and their own keys and values."""
        b, n, d = x.shape
        q, k, v = self.qkv(x).view(b, n, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        return self.query_norm(q), (self.key_norm(k), v)


class EncoderBlock(nn.Module):
    """Pre-norm transformer block, (B, N, d) -> (B, N, d), and what later tokens may read of them."""

    def __init__(self, dim: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.attention = TokenAttention(dim, heads)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, mlp_ratio * dim), nn.GELU(), nn.Linear(mlp_ratio * dim, dim))

    def forward(self, x: Tensor, before: Memory | None) -> tuple[Tensor, Memory]:
        read, own = self.attention(self.norm1(x), before)
        x = x + read
        return x + self.mlp(self.norm2(x)), own


class Encoder(nn.Module):
    """A stack of blocks over tokens of any scale."""

    def __init__(self, dim: int, layers: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(EncoderBlock(dim, heads, mlp_ratio) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor, before: list[Memory] | None = None) -> tuple[Tensor, list[Memory]]:
        """Encode (B, N, d) tokens that read ``before`` (one entry a layer) and each other."""
        memory: list[Memory] = []
        for layer, block in enumerate(self.blocks):
            x, own = block(x, None if before is None else before[layer])
            memory.append(own)
        return self.norm(x), memory


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
        size = torch.linalg.vector_norm(x, dim=1, keepdim=True, dtype=exact)
        scale = torch.rsqrt(size.square() / x.shape[1] + 1e-6)
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


class PatchStem(nn.Module):
    """Patches of spectral columns to features at every level and ``side`` x ``side`` tokens."""

    def __init__(self, columns: int, widths: list[int], dim: int, side: int) -> None:
        super().__init__()
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

"""The transformer that reads coarse and fine tokens together."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from pipeline.errors import ShapeError


class Attention(nn.Module):
    """Multi-head self-attention with normalised queries and keys: bounded logits, safe in half precision."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        if dim % heads:
            raise ShapeError(f"tokens of width {dim} do not divide by {heads} heads; choose another number of heads")
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.out = nn.Linear(dim, dim)
        self.query_norm = nn.RMSNorm(dim // heads, eps=1e-6)
        self.key_norm = nn.RMSNorm(dim // heads, eps=1e-6)

    def forward(self, x: Tensor, key_bias: Tensor) -> Tensor:
        """(B, N, d) and an additive bias per key (B, N), -inf for keys to leave out -> (B, N, d)."""
        b, n, d = x.shape
        q, k, v = self.qkv(x).view(b, n, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        mask = key_bias[:, None, None, :].to(x.dtype).expand(b, 1, n, n)
        mixed = F.scaled_dot_product_attention(self.query_norm(q), self.key_norm(k), v, attn_mask=mask)
        joined: Tensor = self.out(mixed.transpose(1, 2).reshape(b, n, d))
        return joined


class Block(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, dim: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.attention = Attention(dim, heads)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, mlp_ratio * dim), nn.GELU(), nn.Linear(mlp_ratio * dim, dim))

    def forward(self, x: Tensor, key_bias: Tensor) -> Tensor:
        """(B, N, d) -> (B, N, d)."""
        x = x + self.attention(self.norm1(x), key_bias)
        read: Tensor = x + self.mlp(self.norm2(x))
        return read


class Encoder(nn.Module):
    """A stack of blocks over tokens of any scale.

    A key that stands for more ground may weigh more: each logit gets alpha log(area) with alpha learned from 0
    (the prior of token merging, Bolya et al. 2023, sec. 3).
    """

    def __init__(self, dim: int, layers: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(dim, heads, mlp_ratio) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)
        self.area_weight = nn.Parameter(torch.zeros(()))

    def forward(self, x: Tensor, scale: Tensor, valid: Tensor) -> Tensor:
        """Encode (B, N, d) tokens with ``scale`` = log2 side (B, N) and ``valid`` (B, N); invalid ones leave as zeros.

        What an invalid token holds, NaN included, reaches no other token.
        """
        x = torch.where(valid[..., None], x, torch.zeros((), dtype=x.dtype, device=x.device))
        bias = self.area_weight * (2 * math.log(2.0)) * scale.to(x.dtype)
        bias = bias.masked_fill(~valid, float("-inf"))
        for block in self.blocks:
            x = block(x, bias)
        return torch.where(valid[..., None], self.norm(x), torch.zeros((), dtype=x.dtype, device=x.device))

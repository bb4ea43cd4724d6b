"""The transformer of both scales: coarse tokens read each other, fine tokens read both.

Nothing flows from fine to coarse. So what a coarse pass says is computed once: the glance keeps the keys and values of
its tokens, and a second look pays for its own tokens only, however often places are added.
"""

from __future__ import annotations

from contextvars import ContextVar

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from pipeline.errors import ShapeError

LAST_QUERIES: ContextVar[list[Tensor] | None] = ContextVar("LAST_QUERIES", default=None)  # self_attention.py
Memory = tuple[Tensor, Tensor]  # keys and values of one layer, (B, heads, N, d / heads)


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

    def forward(self, x: Tensor, before: Memory | None, kept: Tensor | None) -> tuple[Tensor, Memory]:
        """(B, N, d) tokens that read ``before`` and each other -> (B, N, d), and their own keys and values.

        ``kept`` (B, keys) is False where a key is to be left out.
        """
        b, n, d = x.shape
        q, own = self.ask(x)
        keys, values = own if before is None else (torch.cat(pair, dim=2) for pair in zip(before, own, strict=True))
        mask = None if kept is None else kept[:, None, None, :].expand(b, 1, n, kept.shape[1])
        mixed = F.scaled_dot_product_attention(q, keys, values, attn_mask=mask)
        joined: Tensor = self.out(mixed.transpose(1, 2).reshape(b, n, d))
        return joined, own

    def ask(self, x: Tensor) -> tuple[Tensor, Memory]:
        """Queries (B, heads, N, d / heads) of (B, N, d) tokens, and their own keys and values."""
        b, n, d = x.shape
        q, k, v = self.qkv(x).view(b, n, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        asked: Tensor = self.query_norm(q)
        if (last := LAST_QUERIES.get()) is not None:
            last[:] = [asked]
        return asked, (self.key_norm(k), v)


class EncoderBlock(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, dim: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.attention = TokenAttention(dim, heads)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, mlp_ratio * dim), nn.GELU(), nn.Linear(mlp_ratio * dim, dim))

    def forward(self, x: Tensor, before: Memory | None, kept: Tensor | None) -> tuple[Tensor, Memory]:
        """(B, N, d) -> (B, N, d), and what later tokens may read of them."""
        read, own = self.attention(self.norm1(x), before, kept)
        x = x + read
        return x + self.mlp(self.norm2(x)), own


class Encoder(nn.Module):
    """A stack of blocks over tokens of any scale."""

    def __init__(self, dim: int, layers: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(EncoderBlock(dim, heads, mlp_ratio) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)

    def forward(
        self, x: Tensor, before: list[Memory] | None = None, valid: Tensor | None = None
    ) -> tuple[Tensor, list[Memory]]:
        """Encode (B, N, d) tokens that read ``before`` (one entry a layer) and each other.

        Tokens that are not ``valid`` (B, N) leave as zeros; what they hold, NaN included, reaches no other token.
        """
        kept = None
        if valid is not None:
            x = torch.where(valid[..., None], x, torch.zeros((), dtype=x.dtype, device=x.device))
            there = x.new_ones(x.shape[0], 0 if before is None else before[0][0].shape[2], dtype=torch.bool)
            kept = torch.cat([there, valid], dim=1)
        memory: list[Memory] = []
        for layer, block in enumerate(self.blocks):
            x, own = block(x, None if before is None else before[layer], kept)
            memory.append(own)
        x = self.norm(x)
        if valid is not None:
            x = torch.where(valid[..., None], x, torch.zeros((), dtype=x.dtype, device=x.device))
        return x, memory

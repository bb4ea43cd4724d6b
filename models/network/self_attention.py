"""The encoder's own attention as a policy: how much of what coarse tokens read of each other each of them gives.

The last layer counts: what is read there goes into the map. Softmax rows sum to 1 however many tokens there are, so a
token that is read as much as the others has a fraction of 1 / N.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor


MOST_WEIGHTS = 2**20  # softmax weights in memory at once
LAST_QUERIES: ContextVar[list[Tensor] | None] = ContextVar("LAST_QUERIES", default=None)


@dataclass(frozen=True)
class TokenReading:
    """What the coarse tokens of one scene ask of each other in the last layer, and what answers."""

    queries: NDArray[np.float32]  # (head, token, width), tokens patch by patch, row by row inside each
    keys: NDArray[np.float32]  # (head, token, width)
    side: int  # tokens a side of a patch
    living: NDArray[np.bool_] | None = None  # which of all tokens these are; None: all


@contextmanager
def queries_kept() -> Iterator[list[Tensor]]:
    """Keep the queries of the last layer, (B, head, N, width), of the last reading that this thread makes inside."""

    kept: list[Tensor] = []
    before = LAST_QUERIES.set(kept)
    try:
        yield kept
    finally:
        LAST_QUERIES.reset(before)


def received_attention(
    queries: NDArray[np.floating], keys: NDArray[np.floating], *, most: int = MOST_WEIGHTS
) -> NDArray[np.float64]:
    """Fraction of all attention that each token receives, (token,), summing to 1: the mean over heads and queries.

    ``queries`` and ``keys`` are (head, token, width). At most ``most`` weights are held at once, queries in so many
    blocks as that needs; the result does not depend on it.
    """
    heads, tokens, width = keys.shape
    rows = max(1, most // tokens)
    received = np.zeros(tokens)
    for asked, answering in zip(queries.astype(np.float32), keys.astype(np.float32), strict=True):
        for first in range(0, tokens, rows):
            weight = asked[first : first + rows] @ answering.T / np.float32(np.sqrt(width))
            weight = np.exp(weight - weight.max(axis=1, keepdims=True))
            received += (weight / weight.sum(axis=1, keepdims=True)).sum(axis=0, dtype=np.float64)
    received /= heads * tokens
    return received


def token_image(values: NDArray[np.floating], cells: tuple[int, int], side: int) -> NDArray[np.float64]:
    """Lay out (token,) values of (y, x) patches of ``side`` x ``side`` tokens each as an image of tokens."""
    y, x = cells
    return np.asarray(values, np.float64).reshape(y, x, side, side).swapaxes(1, 2).reshape(y * side, x * side)


def attention_of_patches(read: TokenReading, patch_index: tuple[int, int], factor: int) -> NDArray[np.float64]:
    """How often each patch of a (y, x) grid is read, beside the mean token: 1 is as often as the others.

    Between the centres of tokens it is interpolated bilinearly; a patch that holds several tokens gets their mean.
    """
    y, x = (size // factor for size in patch_index)
    living = np.ones(y * x * read.side**2, bool) if read.living is None else read.living
    fraction = np.zeros(len(living))  # nobody reads a dead token
    if living.any():
        fraction[living] = received_attention(read.queries, read.keys) * np.count_nonzero(living)
    image = token_image(fraction, (y, x), read.side)
    down, across = (_spread(size * read.side, wanted) for size, wanted in zip((y, x), patch_index, strict=True))
    found: NDArray[np.float64] = down @ image @ across.T
    return found


def _spread(tokens: int, patch_index: int) -> NDArray[np.float64]:
    """(patch, token) weights along one axis, each row summing to 1: linear between centres, level beyond the ends."""
    parts = -(-tokens // patch_index)  # points of one patch: as many as it has tokens
    place = (np.arange(patch_index * parts) + 0.5) * tokens / (patch_index * parts) - 0.5
    reach = np.clip(place, 0, tokens - 1)[:, None] - np.arange(tokens)
    weight: NDArray[np.float64] = np.maximum(1 - np.abs(reach), 0).reshape(patch_index, parts, tokens).mean(axis=1)
    return weight

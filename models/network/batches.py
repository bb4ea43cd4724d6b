"""Many scenes of different sizes read together: their patches packed, attention inside each scene, nothing padded.

Patches of all scenes go through stems and heads in chunks that fit the caches. So do tokens through everything of the
encoder but attention itself, which runs scene by scene: no token waits for the longest scene, none is masked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor

from models.network.encoder import Encoder, Memory
from models.network.segmenter import CoarseReading, Segmenter
from models.network.sizes import PATCHES_AT_ONCE

PATCHES_A_PACK = 256  # scenes are read together up to so many patches; one with more is read alone

Features = list[Tensor]  # of each level, finest first


@dataclass(frozen=True)
class FineScene:
    """Captured patches of one scene, and the reading that they go on from."""

    reading: CoarseReading
    patches: NDArray[np.floating]  # (K, p, p, J); what is not finite counts as 0, the median
    seats: Tensor  # (K,) int64
    origin: Tensor | None


def read_coarse_packed(
    segmenter: Segmenter, images: Sequence[Tensor], origins: Sequence[Tensor | None], living: Sequence[Tensor | None]
) -> list[CoarseReading]:
    """Read coarse images, (1, J, H/s, W/s) each, as ``Segmenter.read_coarse`` reads one.

    Tokens that are not ``living``, (tokens,) bool, are left out: nothing reads them, and they tell nothing.
    """
    if not images:
        return []
    p = segmenter.config.patch
    sizes = [(image.shape[2] // p, image.shape[3] // p) for image in images]
    counts = [rows * columns for rows, columns in sizes]
    patches = torch.cat([segmenter.coarse_patches(image) for image in images])
    described = [segmenter.coarse_stem(chunk) for chunk in torch.split(patches, PATCHES_AT_ONCE)]
    tokens = torch.split(torch.cat([token for _, token in described]), counts)
    coded = [
        segmenter.code_coarse(token, *size, origin)[0][slice(None) if alive is None else alive]
        for token, size, origin, alive in zip(tokens, sizes, origins, living, strict=True)
    ]
    read, memories = encode_packed(segmenter.encoder, coded)
    read = [
        part if alive is None else part.new_zeros(len(alive), part.shape[1]).index_put((alive,), part)
        for part, alive in zip(read, living, strict=True)
    ]
    drawn = torch.cat(
        [segmenter.coarse_head(features, token) for features, token in _with_tokens(described, torch.cat(read))]
    )
    return [
        segmenter.reading_of(features, memory, *size)
        for features, memory, size in zip(torch.split(drawn, counts), memories, sizes, strict=True)
    ]


def read_fine_packed(segmenter: Segmenter, scenes: Sequence[FineScene]) -> Iterator[Tensor]:
    """Logits of the fine patches of all scenes, one after the other, (some, classes, p, p) at a time."""
    described = [segmenter.fine_stem(chunk) for chunk in _chunks([scene.patches for scene in scenes])]
    if not described:
        return
    tokens = torch.split(torch.cat([token for _, token in described]), [len(scene.seats) for scene in scenes])
    coded = [
        segmenter.code_fine(token[None], scene.seats[None], scene.reading.columns, scene.origin)[0]
        for token, scene in zip(tokens, scenes, strict=True)
    ]
    read, _ = encode_packed(segmenter.encoder, coded, [scene.reading.memory for scene in scenes])
    under = torch.cat([segmenter.around_seats(scene.reading.canvas, scene.seats[None]) for scene in scenes])
    chunks = torch.split(under, PATCHES_AT_ONCE)
    for (features, token), window in zip(_with_tokens(described, torch.cat(read)), chunks, strict=True):
        yield segmenter.decode_fine(features, token, segmenter.bring_up(segmenter.under(window)))


def _chunks(patches: Sequence[NDArray[np.floating]]) -> Iterator[Tensor]:
    """Patches of all scenes, so many at a time whichever scene they are of, (some, J, p, p) channels last."""
    starts = np.cumsum([0, *map(len, patches)])
    for first in range(0, int(starts[-1]), PATCHES_AT_ONCE):
        parts = [
            own[max(first - start, 0) : max(first + PATCHES_AT_ONCE - start, 0)]
            for own, start in zip(patches, starts, strict=False)
        ]
        chunk = torch.from_numpy(np.concatenate(parts, dtype=np.float32))
        yield chunk.nan_to_num_(0.0, 0.0, 0.0).permute(0, 3, 1, 2)


def _with_tokens(described: Sequence[tuple[Features, Tensor]], read: Tensor) -> Iterator[tuple[Features, Tensor]]:
    """Chunks of features with their part of the tokens read, (all tokens, d) -> (patches, m^2, d) each."""
    parts = torch.split(read, [before.shape[0] * before.shape[1] for _, before in described])
    for (features, before), part in zip(described, parts, strict=True):
        yield features, part.view(before.shape)


def encode_packed(
    encoder: Encoder, scenes: Sequence[Tensor], before: Sequence[list[Memory]] | None = None
) -> tuple[list[Tensor], list[list[Memory]]]:
    """Encode the tokens of each scene, (N, d), as ``Encoder`` does a scene alone, and give each scene's memory.

    ``before`` holds what each scene's tokens read beside each other.
    """
    lengths = [len(tokens) for tokens in scenes]
    x, memories = torch.cat(list(scenes))[None], [[] for _ in scenes]  # type: ignore[var-annotated]
    for layer, block in enumerate(encoder.blocks):
        q, own = block.attention.ask(block.norm1(x))  # type: ignore[operator, union-attr]
        asked, keys, values = (torch.split(part, lengths, dim=2) for part in (q, *own))
        mixed = []
        for scene, (query, key, value) in enumerate(zip(asked, keys, values, strict=True)):
            memories[scene].append((key, value))
            if before is not None:
                key, value = (torch.cat(pair, dim=2) for pair in zip(before[scene][layer], (key, value), strict=True))
            mixed.append(F.scaled_dot_product_attention(query, key, value))
        x = x + block.attention.out(torch.cat(mixed, dim=2).transpose(1, 2).flatten(2))  # type: ignore[operator, union-attr]
        x = x + block.mlp(block.norm2(x))  # type: ignore[operator]
    return list(torch.split(encoder.norm(x)[0], lengths)), memories


def packs(counts: Sequence[int], most: int = PATCHES_A_PACK) -> list[slice]:
    """Parts of a row of scenes that are read together: up to ``most`` patches each, or one scene."""
    starts, filled = [0], 0
    for number, count in enumerate(counts):
        if number > starts[-1] and filled + count > most:
            starts.append(number)
            filled = 0
        filled += count
    return [slice(start, end) for start, end in zip(starts, [*starts[1:], len(counts)], strict=True)] if counts else []

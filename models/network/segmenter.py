"""The two-scale segmenter: coarse patches everywhere, fine patches where captured, one class map.

Shapes: B scenes of H x W fine px, padded to whole cells of p * s px; coarse image H/s x W/s; patches (H/p) x (W/p);
coarse patches (H/ps) x (W/ps), each p x p coarse px. J spectral columns, d token width, K fine patches a scene, m
tokens a side of a patch.

Outside of training patches go through stems and heads in chunks that fit the caches. Nothing is padded, none is masked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor, nn

from models.network.layers import ChannelNorm, Encoder, Memory, PatchHead, PatchStem, Residual, code_2d, cut, joined
from models.network.sizes import PATCHES_AT_ONCE, SCORER_WIDTH, level_widths, scorer_inputs
from models.network.sizes import SegmenterConfig as SegmenterConfig

Features = list[Tensor]  # of each level, finest first


@dataclass(frozen=True)
class CoarseReading:
    """What the coarse pass alone says; fine patches read it and change nothing of it."""

    canvas: Tensor  # (B, c, H/s, W/s) features of every coarse pixel
    logits: Tensor  # (B, classes, H/s, W/s)
    memory: list[Memory]  # of the coarse tokens, one entry a layer
    columns: int  # of coarse patches


class Segmenter(nn.Module):
    """See the module. ``read_coarse`` is the coarse prediction, ``read_fine`` the second pass."""

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.config = config
        side, dim = config.token_side, config.dim
        fine, coarse = (level_widths(width, config.patch) for width in (config.width, config.coarse_width))
        self.coarse_stem = PatchStem(config.columns, coarse, dim, side)
        self.fine_stem = PatchStem(config.columns, fine, dim, side)
        self.scale_code = nn.Parameter(torch.zeros(2, dim))
        self.encoder = Encoder(dim, config.layers, config.heads, config.mlp_ratio)
        self.coarse_head = PatchHead(coarse, dim, side)
        self.fine_head = PatchHead(fine, dim, side)
        self.coarse_mix = Residual(config.coarse_width)
        self.coarse_classes = nn.Conv2d(config.coarse_width, config.classes, 1)
        self.under = nn.Conv2d(config.coarse_width, config.width, 1)
        self.pixel_gate = nn.Conv2d(2 * config.width, config.width, 1)
        self.fine_mix = Residual(config.width)
        self.fine_classes = nn.Conv2d(config.width, config.classes, 1)
        self.scorer = PatchScorer(config)

    @property
    def device(self) -> torch.device:
        """Where its numbers lie, and it computes."""
        return self.scale_code.device

    def forward(
        self, coarse: Tensor, fine: Tensor, patch_index: Tensor, origin: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Logits of the coarse image (B, classes, H/s, W/s) and of the fine patches (B, K, classes, p, p).

        ``coarse`` (B, J, H/s, W/s) and ``fine`` (B, K, J, p, p) are normalised columns, ``patch_index`` (B, K) int64
        patch numbers, unique within a scene, ``origin`` (B, 2) patch units added to the places, for crops of larger
        scenes.
        """
        reading = self.read_coarse(coarse, origin)
        return reading.logits, self.read_fine(reading, fine, patch_index, origin)

    def read_coarse(self, coarse: Tensor, origin: Tensor | None = None) -> CoarseReading:
        """Read the coarse image alone."""
        rows, columns = (size // self.config.patch for size in coarse.shape[2:])
        features, tokens = self.coarse_stem(cut(coarse, self.config.patch).flatten(0, 1))
        read, memory = self.encoder(self.code_coarse(tokens, rows, columns, origin))
        return self.reading_of(self.coarse_head(features, read.view(tokens.shape)), memory, rows, columns)

    def code_coarse(self, tokens: Tensor, rows: int, columns: int, origin: Tensor | None = None) -> Tensor:
        """Tokens of ``rows`` x ``columns`` coarse patches a scene, (B * P, m^2, d), with codes, (B, P m^2, d)."""
        cells = torch.cartesian_prod(torch.arange(rows), torch.arange(columns))
        patches = tokens.view(-1, rows * columns, *tokens.shape[1:])
        return self._coded(patches, cells.expand(len(patches), -1, -1), origin, fine=False)

    def reading_of(self, features: Tensor, memory: list[Memory], rows: int, columns: int) -> CoarseReading:
        """Put the features of coarse patches, (B * P, c, p, p), together to what is known of the images."""
        p, width = self.config.patch, self.config.coarse_width
        cells = features.view(-1, rows, columns, width, p, p).permute(0, 1, 4, 2, 5, 3)
        image = cells.reshape(-1, rows * p, columns * p, width).permute(0, 3, 1, 2)  # channels last, as convolved
        canvas = self.coarse_mix(image)
        return CoarseReading(canvas, self.coarse_classes(F.gelu(canvas)), memory, columns)

    def score(self, reading: CoarseReading) -> Tensor:
        """Tell what a fine look at each patch would gain, (B, H/p, W/p) [nat per px]."""
        gain: Tensor = self.scorer(reading.canvas, reading.logits)
        return gain

    def read_fine(
        self, reading: CoarseReading, fine: Tensor, patch_index: Tensor, origin: Tensor | None = None
    ) -> Tensor:
        """Return logits of the fine patches, (B, K, classes, p, p), from their pixels and the coarse prediction."""
        b, k = patch_index.shape
        p = self.config.patch
        if k == 0:  # convolutions take an empty batch forward but not backward
            return fine.new_zeros(b, 0, self.config.classes, p, p)
        features, tokens = self.fine_stem(fine.flatten(0, 1))
        coded = self.code_fine(tokens.view(b, k, *tokens.shape[1:]), patch_index, reading.columns, origin)
        read = self.encoder(coded, reading.memory)[0].view(tokens.shape)
        logits = self.decode_fine(features, read, self.canvas_windows(reading.canvas, patch_index))
        return logits.view(b, k, *logits.shape[1:])

    def read_coarse_in_chunks(self, image: Tensor, origin: Tensor | None, living: Tensor | None) -> CoarseReading:
        """Read one coarse image (1, J, H/s, W/s) as ``read_coarse`` does, some patches at a time.

        Tokens that are not ``living``, (tokens,) bool, are left out: nothing reads them, and they tell nothing.
        """
        p, image = self.config.patch, image.to(self.device)
        rows, columns = image.shape[2] // p, image.shape[3] // p
        described = [self.coarse_stem(chunk) for chunk in torch.split(cut(image, p)[0], PATCHES_AT_ONCE)]
        coded = self.code_coarse(torch.cat([token for _, token in described]), rows, columns, origin)
        if living is None:
            read, memory = self.encoder(coded)
        else:
            living = living.to(self.device)
            some, memory = self.encoder(coded[:, living])
            read = torch.zeros_like(coded)
            read[:, living] = some
        drawn = [self.coarse_head(features, token) for features, token in _with_tokens(described, read[0])]
        return self.reading_of(torch.cat(drawn), memory, rows, columns)

    def read_fine_in_chunks(
        self, reading: CoarseReading, patches: NDArray[np.floating], patch_index: Tensor, origin: Tensor | None
    ) -> Iterator[Tensor]:
        """Logits of fine patches of one scene, (some, classes, p, p) at a time.

        ``patches`` are (K, p, p, J), in which what is not finite counts as 0, the median; ``patch_index`` (K,) their
        int64 numbers.
        """
        if not len(patches):
            return
        described = []
        for first in range(0, len(patches), PATCHES_AT_ONCE):
            chunk = torch.from_numpy(np.array(patches[first : first + PATCHES_AT_ONCE], np.float32))
            chunk = chunk.nan_to_num_(0.0, 0.0, 0.0).permute(0, 3, 1, 2)
            described.append(self.fine_stem(chunk.to(self.device)))
        own = patch_index.to(self.device)[None]
        coded = self.code_fine(torch.cat([token for _, token in described])[None], own, reading.columns, origin)
        read, _ = self.encoder(coded, reading.memory)
        windows = torch.split(self.around_patches(reading.canvas, own), PATCHES_AT_ONCE)
        for (features, token), window in zip(_with_tokens(described, read[0]), windows, strict=True):
            yield self.decode_fine(features, token, self.bring_up(self.under(window)))

    def code_fine(self, tokens: Tensor, patch_index: Tensor, columns: int, origin: Tensor | None = None) -> Tensor:
        """Tokens of fine patches, (B, K, m^2, d), with their codes, (B, K m^2, d)."""
        across = columns * self.config.factor
        places = torch.stack([patch_index // across, patch_index % across], dim=-1)
        return self._coded(tokens, places, origin, fine=True)

    def _coded(self, tokens: Tensor, places: Tensor, origin: Tensor | None, *, fine: bool) -> Tensor:
        """Tokens with the codes of their scale and place, (B, P, m^2, d) -> (B, P m^2, d).

        ``places`` (B, P, 2) are rows and columns of patches: of patches where ``fine``, else of coarse patches.
        """
        side, step = self.config.token_side, 1 if fine else self.config.factor
        exact = torch.device("cpu") if tokens.device.type == "mps" else tokens.device  # that knows no float64
        places, origin = places.to(exact), None if origin is None else origin.to(exact)
        within = (torch.arange(side, device=exact).double() + 0.5) / side
        inside = torch.cartesian_prod(within, within).view(-1, 2)
        yx = (places.double()[:, :, None] + inside) * step  # centres in patch units, (B, P, m^2, 2)
        code = code_2d(yx if origin is None else yx + origin[:, None, None].double(), self.config.dim)
        coded: Tensor = tokens + code.to(tokens.device) + self.scale_code[int(fine)]
        return coded.flatten(1, 2)

    def canvas_windows(self, canvas: Tensor, patch_index: Tensor) -> Tensor:
        """The coarse features under each patch at the width of the fine ones, (B * K, width, p, p)."""
        return self.bring_up(self.under(self.around_patches(canvas, patch_index)))

    def around_patches(self, image: Tensor, patch_index: Tensor) -> Tensor:
        """The pixels under each patch of a coarse image (B, c, H/s, W/s) and one more on every side.

        Given as (B * K, c, p/s + 2, p/s + 2): ``bring_up`` makes of them the window of each patch, equal to that of the
        whole image brought up bilinearly.
        """
        p, s = self.config.patch, self.config.factor
        cells = p // s
        padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
        columns = image.shape[-1] // cells
        reach = torch.arange(cells + 2, device=image.device)
        y = (patch_index // columns * cells)[..., None] + reach  # (B, K, cells + 2)
        x = (patch_index % columns * cells)[..., None] + reach
        scene = torch.arange(patch_index.shape[0], device=image.device)[:, None, None, None]
        windows = padded.permute(0, 2, 3, 1)[scene, y[..., :, None], x[..., None, :]]
        return windows.flatten(0, 1).permute(0, 3, 1, 2)

    def bring_up(self, windows: Tensor) -> Tensor:
        """Bring windows of ``around_patches`` up to fine pixels, (P, c, p/s + 2, p/s + 2) -> (P, c, p, p)."""
        p, s = self.config.patch, self.config.factor
        return F.interpolate(windows, scale_factor=s, mode="bilinear", align_corners=False)[..., s : s + p, s : s + p]

    def decode_fine(self, features: list[Tensor], tokens: Tensor, under: Tensor) -> Tensor:
        """Class logits of fine patches from their own pixels, their tokens and the coarse features under them."""
        own = self.fine_head(features, tokens)
        gate = torch.sigmoid(self.pixel_gate(torch.cat([own, under], dim=1)))
        logits: Tensor = self.fine_classes(F.gelu(self.fine_mix(torch.lerp(under, own, gate))))
        return logits

    def composite(self, coarse_logits: Tensor, fine_logits: Tensor, patch_index: Tensor) -> Tensor:
        """Coarse logits brought up to the fine grid, overwritten where a fine patch is, (B, classes, H, W) float32."""
        p, s = self.config.patch, self.config.factor
        full = F.interpolate(coarse_logits.float(), scale_factor=s, mode="bilinear", align_corners=False)
        cells = cut(full, p)
        index = patch_index[:, :, None, None, None].expand(-1, -1, *cells.shape[2:])
        return joined(cells.scatter(1, index, fine_logits.float()), full.shape[-1] // p)


class PatchScorer(nn.Module):
    """A few convolutions on the grid of patches. Nothing is learned through it by the segmenter that it judges."""

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.cells = config.patch // config.factor
        inputs = scorer_inputs(config)
        self.norm = ChannelNorm(inputs)
        self.enter = nn.Conv2d(inputs, SCORER_WIDTH, 1)
        self.around = nn.Conv2d(SCORER_WIDTH, SCORER_WIDTH, 3, padding=1, padding_mode="replicate", groups=SCORER_WIDTH)
        self.mix = nn.Conv2d(SCORER_WIDTH, SCORER_WIDTH, 1)
        self.leave = nn.Conv2d(SCORER_WIDTH, 1, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]
        self.of_entropy = nn.Parameter(torch.tensor(0.2))  # what is learned is added to a fraction of the entropy

    def forward(self, canvas: Tensor, logits: Tensor) -> Tensor:
        """Features and logits of the coarse pixels, (B, c, H/s, W/s) -> gain of each patch, (B, H/p, W/p) [nat per px].

        No gradient goes back into either.
        """
        canvas, logits = canvas.detach(), logits.detach()
        probability = logits.float().softmax(dim=1).to(canvas.dtype)
        entropy = torch.special.entr(probability).sum(dim=1, keepdim=True)
        images = (canvas, probability, entropy)  # pooled one by one: each as it lies in memory
        mean = torch.cat([F.avg_pool2d(image, self.cells) for image in images], dim=1)
        most = torch.cat([F.max_pool2d(image, self.cells) for image in (canvas, entropy)], dim=1)
        x = self.enter(self.norm(torch.cat([mean, most], dim=1)))
        x = x + self.mix(self.around(F.gelu(x)))
        gain: Tensor = self.of_entropy * mean[:, -1] + self.leave(F.gelu(x))[:, 0]
        return gain


def _with_tokens(described: Sequence[tuple[Features, Tensor]], read: Tensor) -> Iterator[tuple[Features, Tensor]]:
    """Chunks of features with their part of the tokens read, (all tokens, d) -> (patches, m^2, d) each."""
    parts = torch.split(read, [before.shape[0] * before.shape[1] for _, before in described])
    for (features, before), part in zip(described, parts, strict=True):
        yield features, part.view(before.shape)

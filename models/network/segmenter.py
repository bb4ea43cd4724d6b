"""The segmenter: an overview of every pixel, and a full network for chosen patches.

The overview is a linear classifier of mean spectra, which a small U-Net corrects. A transformer works on the lowest
level of this U-Net; a token covers ``TOKEN_PX`` pixels a side. The full network is a wider U-Net: it reads a patch and
the features of the overview there, and corrects the logits of the overview.

Shapes: B scenes of H x W px, J spectral features, K patches a scene of p x p px. An input image has J + ``PLANES``
channels; the last ones describe the capture (`models.network.spectral.LineSpec`).
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from spectralzoom.models.network.layers import mean_around, pointwise
from spectralzoom.models.network.mixture import Mixture
from spectralzoom.models.network.photo_stem import PhotoStem
from spectralzoom.models.network.sizes import BOTTOM, PLANES, TOKEN_PX, SegmenterConfig, level_widths
from spectralzoom.pipeline.errors import ShapeError

LONGEST_PERIOD = 128.0  # cells of a token; the shortest is 2


def code_2d(yx: Tensor, dim: int) -> Tensor:
    """Return sines and cosines of both coordinates, (..., 2) cells -> (..., dim) float32.

    Periods run geometrically from 2 to 128 cells. Angles are float64 and cast once: the error stays below 1e-6 at
    1e7 px, where float32 angles would be wrong by half a turn. Raises ShapeError for places in half precision.
    """
    if yx.dtype in (torch.float16, torch.bfloat16):  # exact up to 2048 and 256 only
        raise ShapeError(f"places of tokens must be float32, float64 or whole numbers, got {yx.dtype}")
    periods = torch.linspace(math.log(2.0), math.log(LONGEST_PERIOD), dim // 4, dtype=torch.float64).exp()
    turns = yx.to(torch.float64)[..., None] / periods.to(yx.device)
    angle = 2 * math.pi * (turns - turns.round())
    return torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2).to(torch.float32)


class TokenAttention(nn.Module):
    """Multi-head attention with normalised queries and keys: bounded logits, safe in half precision."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.out = nn.Linear(dim, dim)
        self.query_norm = nn.RMSNorm(dim // heads, eps=1e-6)
        self.key_norm = nn.RMSNorm(dim // heads, eps=1e-6)

    def forward(self, x: Tensor) -> Tensor:
        """Let tokens (B, N, d) attend to each other -> (B, N, d)."""
        b, n, d = x.shape
        q, k, v = self.qkv(x).view(b, n, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(self.query_norm(q), self.key_norm(k), v)
        return cast(Tensor, self.out(mixed.transpose(1, 2).reshape(b, n, d)))


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
        return cast(Tensor, x + self.mlp(self.norm2(x)))


class Encoder(nn.Sequential):
    """Stack of transformer blocks, (B, N, d) -> (B, N, d)."""

    def __init__(self, dim: int, layers: int, heads: int, mlp_ratio: int) -> None:
        blocks = nn.Sequential(*(EncoderBlock(dim, heads, mlp_ratio) for _ in range(layers)))
        super().__init__(OrderedDict(blocks=blocks, norm=nn.LayerNorm(dim)))


def cut(image: Tensor, patch: int) -> Tensor:
    """Cut an image into patches, row by row: (B, c, y, x) -> (B, N, c, p, p)."""
    b, c, y, x = image.shape
    cells = image.view(b, c, y // patch, patch, x // patch, patch).permute(0, 2, 4, 1, 3, 5)
    return cells.reshape(b, y // patch * (x // patch), c, patch, patch)


def joined(patches: Tensor, columns: int) -> Tensor:
    """Undo ``cut``: patches in rows of ``columns``, (B, N, c, p, p) -> (B, c, y, x)."""
    b, n, c, p, _ = patches.shape
    cells = patches.view(b, n // columns, columns, c, p, p).permute(0, 3, 1, 4, 2, 5)
    return cells.reshape(b, c, n // columns * p, columns * p)


class ChannelNorm(nn.Module):
    """Root-mean-square norm over the channels of each pixel, (P, c, y, x)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        exact = torch.promote_types(x.dtype, torch.float32)
        scale = torch.rsqrt(x.to(exact).square().mean(dim=1, keepdim=True) + 1e-6)
        return x * scale * self.weight[None, :, None, None]


class Residual(nn.Module):
    """Residual block of one 3 x 3 convolution, (P, c, y, x)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = ChannelNorm(channels)
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return cast(Tensor, x + self.conv(F.gelu(self.norm(x))))


class Stem(nn.Module):
    """Encoder of a U-Net: an image to features at every level, each half as large as the last."""

    def __init__(self, inputs: int, widths: list[int]) -> None:
        super().__init__()
        self.enter = pointwise(inputs, widths[0])
        self.blocks = nn.ModuleList(map(Residual, widths))
        self.down = nn.ModuleList(nn.Conv2d(upper, lower, 2, stride=2) for upper, lower in pairwise(widths))

    def forward(self, image: Tensor) -> list[Tensor]:
        """Compute the features of each level, finest first, from (B, inputs, y, x)."""
        x = self.enter(image.contiguous(memory_format=torch.channels_last))  # up to 3 times as fast
        features = []
        for level, block in enumerate(self.blocks):
            if level:
                x = self.down[level - 1](x)
            x = block(x)
            features.append(x)
        return features


class Head(nn.Module):
    """Decoder of a U-Net: features of each level to features of each pixel."""

    def __init__(self, widths: list[int], deep: bool = False) -> None:
        super().__init__()
        self.up = nn.ModuleList(pointwise(lower, 4 * upper) for upper, lower in pairwise(widths))
        self.blocks = nn.ModuleList(
            nn.Identity() if deep and not level else Residual(width) for level, width in enumerate(widths[:-1])
        )

    def forward(self, features: list[Tensor]) -> Tensor:
        """Combine the features of each level, finest first, (B, c, y, x) -> (B, width, y, x) of the finest."""
        x = features[-1]
        for level in range(len(features) - 2, -1, -1):
            x = features[level] + F.pixel_shuffle(self.up[level](F.gelu(x)), 2)
            x = self.blocks[level](x)
        return x


@dataclass(frozen=True)
class Overview:
    """Features and logits of the overview, which the full network corrects."""

    features: Tensor  # (B, c, H, W)
    logits: Tensor  # (B, classes, H, W), minus infinity for untaught classes


class Segmenter(nn.Module):
    """Segment a scene: `read_overview` classifies every pixel, `read_patches` corrects chosen patches."""

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.config = config
        if config.corrected:
            self._add_overview(config)
        if config.parts:
            self.mixture = Mixture(config)
        else:
            self.spectral = nn.Conv2d(config.columns, config.classes, 1)  # linear classifier of mean spectra
            nn.init.zeros_(self.spectral.weight)
            nn.init.zeros_(self.spectral.bias)  # type: ignore[arg-type]
        if config.corrected:
            self._add_full(config)

    def _add_overview(self, config: SegmenterConfig) -> None:
        """Add the network of every pixel."""
        inputs = config.columns + PLANES
        widths = level_widths(config.overview_width, TOKEN_PX, config.deep)
        self.overview_stem = PhotoStem(inputs, widths) if config.deep else Stem(inputs, widths)
        self.to_token = nn.Conv2d(widths[-1], config.dim, BOTTOM, stride=BOTTOM)
        self.encoder = Encoder(config.dim, config.layers, config.heads, config.mlp_ratio)
        self.from_token = nn.Conv2d(config.dim, widths[-1] * BOTTOM**2, 1)
        self.overview_head = Head(widths, config.deep)
        self.overview_classes = pointwise(config.overview_width, config.classes)

    def _add_full(self, config: SegmenterConfig) -> None:
        """Add the network of chosen patches; both correct nothing before they are trained."""
        inputs = config.columns + PLANES
        widths = level_widths(config.width, config.patch)
        self.full_stem = Stem(inputs + config.overview_width, widths)
        self.full_head = Head(widths)
        self.full_classes = nn.Conv2d(config.width, config.classes, 1)
        with torch.no_grad():
            for stem in (self.overview_stem, self.full_stem):  # planes of the capture have no effect unless trained
                stem.enter.weight[:, config.columns : inputs] = 0
            for last in (self.overview_classes, self.full_classes):
                last.weight.zero_()
                last.bias.zero_()  # type: ignore[union-attr]

    @property
    def device(self) -> torch.device:
        """Return the device of the parameters."""
        return next(self.parameters()).device

    def base(self, image: Tensor) -> Tensor:
        """Return logits (B, class, H, W) of an image (B, J + PLANES, H, W) by the classifiers of pixels."""
        if self.config.parts:
            logits: Tensor = self.mixture(image[:, : self.config.columns])
        else:
            spectral = F.pad(self.spectral.weight, (0, 0, 0, 0, 0, PLANES))
            # the mean of the logits is that of the mean spectrum
            logits = mean_around(F.conv2d(image, spectral, self.spectral.bias, dilation=2))
        if self.config.untaught:  # networks add finite numbers to these logits, which stay minus infinity
            logits = logits.index_fill(1, torch.tensor(self.config.untaught, device=logits.device), -torch.inf)
        return logits

    def read_overview(self, image: Tensor, origin: Tensor | None = None, valid: Tensor | None = None) -> Overview:
        """Compute the overview of an image (B, J + PLANES, H, W).

        ``origin`` (B, 2) are the tokens above and left of a crop. Tokens that are not ``valid``, (tokens,) bool of a
        single scene, take no part in the attention.
        """
        if not self.config.corrected:
            alone = self.base(image)
            return Overview(alone[:, :0], alone)
        height, width = image.shape[2:]
        gap = -width % TOKEN_PX, -height % TOKEN_PX
        if any(gap):
            image = F.pad(image, (0, gap[0], 0, gap[1]), mode="replicate")
        features = self.overview_stem(image)
        # In bfloat16, channels last, a kernel that covers its whole input gives wrong sums (torch 2.13, CPU).
        grid = self.to_token(features[-1].contiguous())
        places = torch.cartesian_prod(*(torch.arange(size) for size in grid.shape[2:])).double() + 0.5
        if origin is not None:
            places = places + origin.cpu().double()[:, None]
        tokens = grid.flatten(2).transpose(1, 2) + code_2d(places, self.config.dim).to(grid.device)
        if valid is None:
            read = self.encoder(tokens)
        else:
            read = torch.zeros_like(tokens)
            read[:, valid] = self.encoder(tokens[:, valid])
        features[-1] = features[-1] + F.pixel_shuffle(self.from_token(read.transpose(1, 2).reshape(grid.shape)), BOTTOM)
        drawn = self.overview_head(features)[:, :, :height, :width]
        alone = self.base(image)[:, :, :height, :width]
        return Overview(drawn, self.overview_classes(F.gelu(drawn)).add_(alone))

    def read_patches(self, overview: Overview, patches: Tensor, patch_index: Tensor) -> Tensor:
        """Return logits (B, K, classes, p, p) of patches (B, K, J + PLANES, p, p) at ``patch_index`` (B, K)."""
        b, k = patch_index.shape
        p = self.config.patch
        if k == 0:  # convolutions have no backward pass of an empty batch
            return overview.logits.new_zeros(b, 0, self.config.classes, p, p)
        across = overview.logits.shape[-1] // p
        within = torch.arange(p, device=patch_index.device)
        y = (patch_index // across * p)[..., None] + within  # (B, K, p)
        x = (patch_index % across * p)[..., None] + within
        scene = torch.arange(b, device=patch_index.device)[:, None, None, None]

        def under(image: Tensor) -> Tensor:
            """Return the part of an image under the patches, (B * K, c, p, p)."""
            return image.permute(0, 2, 3, 1)[scene, y[..., :, None], x[..., None, :]].flatten(0, 1).permute(0, 3, 1, 2)

        if not self.config.corrected:
            return under(overview.logits).view(b, k, -1, p, p)
        features = self.full_head(self.full_stem(torch.cat([patches.flatten(0, 1), under(overview.features)], dim=1)))
        logits: Tensor = under(overview.logits) + self.full_classes(F.gelu(features))
        return logits.view(b, k, *logits.shape[1:])

    def composite(self, logits: Tensor, patches: Tensor, patch_index: Tensor) -> Tensor:
        """Insert the logits of patches into those of the overview, (B, classes, H, W) float32."""
        cells = cut(logits.float(), self.config.patch)
        index = patch_index[:, :, None, None, None].expand(-1, -1, *cells.shape[2:])
        return joined(cells.scatter(1, index, patches.float()), logits.shape[-1] // self.config.patch)

"""The segmenter: an overview of every pixel, and a full reading of the patches where it is likely to change the map.

The overview is a linear classifier of mean spectra, which a small U-Net corrects. A transformer reads that one's lowest
level: each token stands for ``TOKEN_PX`` pixels a side.
The full network is a wider U-Net that reads a patch beside what the overview found there, and corrects its logits.

Shapes: B scenes of H x W px, J spectral features, K patches a scene of p x p px. An input image has J + ``PLANES``
channels; the last ones are those of `models.network.spectral.LineSpec`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.network.layers import ChannelNorm, Encoder, Head, Stem, code_2d, cut, joined
from models.network.sizes import AROUND_PX, BOTTOM, PLANES, SCORER_WIDTH, TOKEN_PX, level_widths, scorer_inputs
from models.network.sizes import SegmenterConfig as SegmenterConfig


@dataclass(frozen=True)
class Overview:
    """The overview of a scene, which the full network corrects."""

    features: Tensor  # (B, c, H, W)
    logits: Tensor  # (B, classes, H, W)


class Segmenter(nn.Module):
    """Read a scene: `read_overview` every pixel, `read_patches` those patches that are chosen."""

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.config = config
        inputs, dim = config.columns + PLANES, config.dim
        widths = level_widths(config.overview_width, TOKEN_PX)
        self.overview_stem = Stem(inputs, widths)
        self.to_token = nn.Conv2d(widths[-1], dim, BOTTOM, stride=BOTTOM)
        self.encoder = Encoder(dim, config.layers, config.heads, config.mlp_ratio)
        self.from_token = nn.Conv2d(dim, widths[-1] * BOTTOM**2, 1)
        self.overview_head = Head(widths)
        self.overview_classes = nn.Conv2d(config.overview_width, config.classes, 1)
        self.spectral = nn.Conv2d(config.columns, config.classes, 1)  # a linear classifier that the rest corrects
        widths = level_widths(config.width, config.patch)
        self.full_stem = Stem(inputs + config.overview_width, widths)
        self.full_head = Head(widths)
        self.full_classes = nn.Conv2d(config.width, config.classes, 1)
        self.scorer = PatchScorer(config)
        with torch.no_grad():
            for stem in (self.overview_stem, self.full_stem):  # without other exposures training leaves planes so
                stem.enter.weight[:, config.columns : inputs] = 0
            for last in (self.spectral, self.overview_classes, self.full_classes):
                last.weight.zero_()
                last.bias.zero_()  # type: ignore[union-attr]

    @property
    def device(self) -> torch.device:
        """Device on which its numbers lie and it computes."""
        return self.full_classes.weight.device

    def forward(self, image: Tensor, detail: Tensor, patch_index: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of the overview (B, classes, H, W) and of the patches (B, K, classes, p, p).

        ``image`` is what the overview reads, ``detail`` what the full network does: the same, but for two passes.
        ``patch_index`` (B, K) are int64 patch numbers, ``origin`` (B, 2) the tokens above and left of a crop.
        """
        overview = self.read_overview(image, origin)
        cells = cut(detail, self.config.patch)
        index = patch_index[:, :, None, None, None].expand(-1, -1, *cells.shape[2:])
        return overview.logits, self.read_patches(overview, cells.gather(1, index), patch_index)

    def read_overview(self, image: Tensor, origin: Tensor | None = None, living: Tensor | None = None) -> Overview:
        """Read (B, J + PLANES, H, W).

        Tokens that are not ``living``, (tokens,) bool of the one scene, are left out: no other token reads them.
        """
        image = image.contiguous()  # two layers read it
        height, width = image.shape[2:]
        gap = -width % TOKEN_PX, -height % TOKEN_PX
        if any(gap):
            image = F.pad(image, (0, gap[0], 0, gap[1]), mode="replicate")
        features = self.overview_stem(image)
        # In bfloat16, channels last, a kernel that covers its whole input gives wrong sums (torch 2.13, CPU).
        grid = self.to_token(features[-1].contiguous())
        tokens = self._coded(grid, origin)
        if living is None:
            read = self.encoder(tokens)
        else:
            read = torch.zeros_like(tokens)
            read[:, living] = self.encoder(tokens[:, living])
        context = self.from_token(read.transpose(1, 2).reshape(grid.shape))
        features[-1] = features[-1] + F.pixel_shuffle(context, BOTTOM)
        drawn = self.overview_head(features)[:, :, :height, :width]
        alone = self.spectral(image[:, : self.config.columns])  # the logits' mean is that of the mean spectrum
        for size in ((AROUND_PX, 1), (1, AROUND_PX)):
            alone = F.avg_pool2d(alone, size, 1, (size[0] // 2, size[1] // 2), count_include_pad=False)
        logits = self.overview_classes(F.gelu(drawn)) + alone[:, :, :height, :width]
        return Overview(drawn, logits)

    def _coded(self, grid: Tensor, origin: Tensor | None) -> Tensor:
        """Tokens (B, d, rows, columns) with the codes of their places, (B, rows * columns, d)."""
        rows, columns = grid.shape[2:]
        places = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).double() + 0.5
        if origin is not None:
            places = places + origin.cpu().double()[:, None]
        coded: Tensor = grid.flatten(2).transpose(1, 2) + code_2d(places, self.config.dim).to(grid.device)
        return coded

    def score(self, overview: Overview) -> Tensor:
        """Return the gain that is expected of reading each patch in full, (B, H/p, W/p) [nat per px]."""
        gain: Tensor = self.scorer(overview.features, overview.logits)
        return gain

    def read_patches(self, overview: Overview, patches: Tensor, patch_index: Tensor) -> Tensor:
        """Logits (B, K, classes, p, p) of the patches (B, K, J + PLANES, p, p), numbered by ``patch_index`` (B, K)."""
        b, k = patch_index.shape
        p = self.config.patch
        if k == 0:  # convolutions take an empty batch forward but not backward
            return overview.logits.new_zeros(b, 0, self.config.classes, p, p)
        across = overview.logits.shape[-1] // p
        within = torch.arange(p, device=patch_index.device)
        y = (patch_index // across * p)[..., None] + within  # (B, K, p)
        x = (patch_index % across * p)[..., None] + within
        scene = torch.arange(b, device=patch_index.device)[:, None, None, None]

        def under(image: Tensor) -> Tensor:
            """Return the part of an image under the patches, (B * K, c, p, p)."""
            return image.permute(0, 2, 3, 1)[scene, y[..., :, None], x[..., None, :]].flatten(0, 1).permute(0, 3, 1, 2)

        features = self.full_head(self.full_stem(torch.cat([patches.flatten(0, 1), under(overview.features)], dim=1)))
        logits: Tensor = under(overview.logits) + self.full_classes(F.gelu(features))
        return logits.view(b, k, *logits.shape[1:])

    def composite(self, logits: Tensor, patches: Tensor, patch_index: Tensor) -> Tensor:
        """Logits of the overview with those of the patches in their places, (B, classes, H, W) float32."""
        cells = cut(logits.float(), self.config.patch)
        index = patch_index[:, :, None, None, None].expand(-1, -1, *cells.shape[2:])
        return joined(cells.scatter(1, index, patches.float()), logits.shape[-1] // self.config.patch)


class PatchScorer(nn.Module):
    """A few convolutions on the grid of patches. Nothing is learned through it by the segmenter that it judges."""

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.patch = config.patch
        inputs = scorer_inputs(config)
        self.norm = ChannelNorm(inputs)
        self.enter = nn.Conv2d(inputs, SCORER_WIDTH, 1)
        self.around = nn.Conv2d(SCORER_WIDTH, SCORER_WIDTH, 3, padding=1, padding_mode="replicate", groups=SCORER_WIDTH)
        self.mix = nn.Conv2d(SCORER_WIDTH, SCORER_WIDTH, 1)
        self.leave = nn.Conv2d(SCORER_WIDTH, 1, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]
        self.of_entropy = nn.Parameter(torch.tensor(0.2))  # what is learned is added to a fraction of the entropy

    def forward(self, features: Tensor, logits: Tensor) -> Tensor:
        """Features and logits of the overview, (B, c, H, W) -> gain of each patch, (B, H/p, W/p) [nat per px].

        No gradient goes back into either.
        """
        features, logits = features.detach(), logits.detach()
        probability = logits.float().softmax(dim=1).to(features.dtype)
        entropy = torch.special.entr(probability).sum(dim=1, keepdim=True)
        images = (features, probability, entropy)  # pooled one by one: each as it lies in memory
        mean = torch.cat([F.avg_pool2d(image, self.patch) for image in images], dim=1)
        most = torch.cat([F.max_pool2d(image, self.patch) for image in (features, entropy)], dim=1)
        x = self.enter(self.norm(torch.cat([mean, most], dim=1)))
        x = x + self.mix(self.around(F.gelu(x)))
        gain: Tensor = self.of_entropy * mean[:, -1] + self.leave(F.gelu(x))[:, 0]
        return gain

"""The two-scale segmenter: coarse patches everywhere, fine patches where captured, one class map.

Shapes: B scenes of H x W fine px, padded to whole cells of p * s px; coarse image H/s x W/s; seats (H/p) x (W/p);
coarse patches (H/ps) x (W/ps), each p x p coarse px. J spectral columns, d token width, K fine patches a scene, m
tokens a side of a patch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.network.encoder import Encoder, Memory
from models.network.pixel_side import PatchHead, PatchStem, Residual
from models.network.scorer import SeatScorer
from models.network.sizes import SegmenterConfig as SegmenterConfig
from models.network.sizes import level_widths
from models.network.tokens import code_1d, code_2d, paper_numbers


@dataclass(frozen=True)
class CoarseReading:
    """What the coarse pass alone says; fine patches read it and change nothing of it."""

    canvas: Tensor  # (B, c, H/s, W/s) features of every coarse pixel
    logits: Tensor  # (B, classes, H/s, W/s)
    memory: list[Memory]  # of the coarse tokens, one entry a layer
    columns: int  # of coarse patches


class Segmenter(nn.Module):
    """See the module. ``read_coarse`` is the glance, ``read_fine`` the second look."""

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.config = config
        side, dim = config.token_side, config.dim
        fine, coarse = (level_widths(width, config.patch) for width in (config.width, config.coarse_width))
        kernel = config.patch // side if config.patch_kernel else 0
        self.coarse_stem = PatchStem(config.columns, coarse, dim, side, kernel)
        self.fine_stem = PatchStem(config.columns, fine, dim, side, kernel)
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
        self.scorer = SeatScorer(config)

    def forward(
        self, coarse: Tensor, fine: Tensor, seats: Tensor, origin: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Classify a batch of scenes.

        Parameters
        ----------
        coarse
            (B, J, H/s, W/s) normalised columns.
        fine
            (B, K, J, p, p) normalised columns of the captured seats.
        seats
            (B, K) int64 seat numbers, unique within a scene.
        origin
            (B, 2) seat units added to the places, for crops of larger scenes.

        Returns
        -------
        Logits of the coarse image (B, classes, H/s, W/s) and of the fine patches (B, K, classes, p, p).
        """
        reading = self.read_coarse(coarse, origin)
        return reading.logits, self.read_fine(reading, fine, seats, origin)

    def read_coarse(self, coarse: Tensor, origin: Tensor | None = None) -> CoarseReading:
        """Read the coarse image alone."""
        rows, columns = (size // self.config.patch for size in coarse.shape[2:])
        features, tokens = self.coarse_stem(self.coarse_patches(coarse))
        read, memory = self.encoder(self.code_coarse(tokens, rows, columns, origin))
        image = self.coarse_head(features, read.view(tokens.shape))
        return self.reading_of(image, memory, rows, columns)

    def coarse_patches(self, coarse: Tensor) -> Tensor:
        """Cut coarse images into patches, (B, J, H/s, W/s) -> (B * patches, J, p, p), row by row."""
        p = self.config.patch
        b, j, y, x = coarse.shape
        return coarse.view(b, j, y // p, p, x // p, p).permute(0, 2, 4, 1, 3, 5).reshape(-1, j, p, p)

    def code_coarse(self, tokens: Tensor, rows: int, columns: int, origin: Tensor | None = None) -> Tensor:
        """Tokens of ``rows`` x ``columns`` coarse patches a scene, (B * P, m^2, d), with codes, (B, P m^2, d)."""
        cells = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).to(tokens.device)
        patches = tokens.view(-1, rows * columns, *tokens.shape[1:])
        return self._coded(patches, cells.expand(len(patches), -1, -1), columns, origin, fine=False)

    def reading_of(self, features: Tensor, memory: list[Memory], rows: int, columns: int) -> CoarseReading:
        """Put the features of coarse patches, (B * P, c, p, p), together to what is known of the images."""
        p, width = self.config.patch, self.config.coarse_width
        cells = features.view(-1, rows, columns, width, p, p).permute(0, 1, 4, 2, 5, 3)
        image = cells.reshape(-1, rows * p, columns * p, width).permute(0, 3, 1, 2)  # channels last, as convolved
        canvas = self.coarse_mix(image)
        return CoarseReading(canvas, self.coarse_classes(F.gelu(canvas)), memory, columns)

    def score(self, reading: CoarseReading) -> Tensor:
        """Tell what a fine look at each seat would gain, (B, H/p, W/p) [nat per px]."""
        gain: Tensor = self.scorer(reading.canvas, reading.logits)
        return gain

    def read_fine(self, reading: CoarseReading, fine: Tensor, seats: Tensor, origin: Tensor | None = None) -> Tensor:
        """Logits of the fine patches, (B, K, classes, p, p), from their own pixels and what the glance saw."""
        b, k = seats.shape
        p = self.config.patch
        if k == 0:  # convolutions take an empty batch forward but not backward
            return fine.new_zeros(b, 0, self.config.classes, p, p)
        features, tokens = self.fine_stem(fine.flatten(0, 1))
        read = self.encode_fine(reading, tokens.view(b, k, *tokens.shape[1:]), seats, origin)
        logits = self.decode_fine(features, read.flatten(0, 1), self.canvas_windows(reading.canvas, seats))
        return logits.view(b, k, *logits.shape[1:])

    def encode_fine(
        self, reading: CoarseReading, tokens: Tensor, seats: Tensor, origin: Tensor | None = None
    ) -> Tensor:
        """Let the tokens of fine patches, (B, K, m^2, d), read the coarse ones and each other."""
        coded = self.code_fine(tokens, seats, reading.columns, origin)
        read: Tensor = self.encoder(coded, reading.memory)[0]
        return read.view(tokens.shape)

    def code_fine(self, tokens: Tensor, seats: Tensor, columns: int, origin: Tensor | None = None) -> Tensor:
        """Tokens of fine patches, (B, K, m^2, d), with their codes, (B, K m^2, d)."""
        across = columns * self.config.factor
        places = torch.stack([seats // across, seats % across], dim=-1)
        return self._coded(tokens, places, columns, origin, fine=True)

    def _coded(self, tokens: Tensor, places: Tensor, columns: int, origin: Tensor | None, *, fine: bool) -> Tensor:
        """Tokens with the codes of their scale and place, (B, P, m^2, d) -> (B, P m^2, d).

        ``places`` (B, P, 2) are rows and columns of patches: of seats where ``fine``, else of coarse patches.
        """
        side, step = self.config.token_side, 1 if fine else self.config.factor
        within = (torch.arange(side, device=places.device).double() + 0.5) / side
        inside = torch.cartesian_prod(within, within).view(-1, 2)
        yx = (places.double()[:, :, None] + inside) * step  # centres in seat units, (B, P, m^2, 2)
        if self.config.positions == "paper":
            scale = torch.full(yx.shape[:-1], 0.0 if fine else 1.0, device=yx.device)
            code = code_1d(paper_numbers(yx, scale, columns, self.config.factor), self.config.dim)
        else:
            code = code_2d(yx if origin is None else yx + origin[:, None, None].double(), self.config.dim)
        coded: Tensor = tokens + code + self.scale_code[int(fine)]
        return coded.flatten(1, 2)

    def canvas_windows(self, canvas: Tensor, seats: Tensor) -> Tensor:
        """The coarse features under each seat at the width of the fine ones, (B * K, width, p, p)."""
        return self.bring_up(self.under(self.around_seats(canvas, seats)))

    def seat_windows(self, image: Tensor, seats: Tensor) -> Tensor:
        """The window of each seat of a coarse image, (B, c, H/s, W/s) -> (B * K, c, p, p).

        Equal to the window of the whole image brought up bilinearly, without making that.
        """
        return self.bring_up(self.around_seats(image, seats))

    def around_seats(self, image: Tensor, seats: Tensor) -> Tensor:
        """The coarse pixels under each seat and one more on every side, (B * K, c, p/s + 2, p/s + 2)."""
        p, s = self.config.patch, self.config.factor
        cells = p // s
        padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
        columns = image.shape[-1] // cells
        reach = torch.arange(cells + 2, device=image.device)
        y = (seats // columns * cells)[..., None] + reach  # (B, K, cells + 2)
        x = (seats % columns * cells)[..., None] + reach
        scene = torch.arange(seats.shape[0], device=image.device)[:, None, None, None]
        windows = padded.permute(0, 2, 3, 1)[scene, y[..., :, None], x[..., None, :]]
        return windows.flatten(0, 1).permute(0, 3, 1, 2)

    def bring_up(self, windows: Tensor) -> Tensor:
        """Bring windows of ``around_seats`` up to fine pixels, (P, c, p/s + 2, p/s + 2) -> (P, c, p, p)."""
        p, s = self.config.patch, self.config.factor
        return F.interpolate(windows, scale_factor=s, mode="bilinear", align_corners=False)[..., s : s + p, s : s + p]

    def decode_fine(self, features: list[Tensor], tokens: Tensor, under: Tensor) -> Tensor:
        """Class logits of fine patches from their own pixels, their tokens and the coarse features under them."""
        own = self.fine_head(features, tokens)
        gate = torch.sigmoid(self.pixel_gate(torch.cat([own, under], dim=1)))
        logits: Tensor = self.fine_classes(F.gelu(self.fine_mix(torch.lerp(under, own, gate))))
        return logits

    def composite(self, coarse_logits: Tensor, fine_logits: Tensor, seats: Tensor) -> Tensor:
        """Coarse logits brought up to the fine grid, overwritten where a fine patch is, (B, classes, H, W) float32."""
        p, s = self.config.patch, self.config.factor
        full = F.interpolate(coarse_logits.float(), scale_factor=s, mode="bilinear", align_corners=False)
        b, c, y, x = full.shape
        cells = full.view(b, c, y // p, p, x // p, p).permute(0, 2, 4, 1, 3, 5).flatten(1, 2)
        index = seats[:, :, None, None, None].expand(-1, -1, c, p, p)
        cells = cells.scatter(1, index, fine_logits.float())
        return cells.view(b, y // p, x // p, c, p, p).permute(0, 3, 1, 4, 2, 5).reshape(b, c, y, x)

"""The two-scale segmenter: coarse patches everywhere, fine patches where captured, one class map.

Shapes: B scenes of H x W fine px, padded to whole cells of p * s px; coarse image H/s x W/s; seats (H/p) x (W/p);
coarse patches (H/ps) x (W/ps), each p x p coarse px. J spectral columns, d token width, K fine patches a scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.encoder import Encoder
from models.patches import PatchHead, PatchStem, Residual
from models.sizes import SegmenterConfig as SegmenterConfig
from models.sizes import level_widths
from models.tokens import TokenSet, code_1d, code_2d, paper_numbers


@dataclass(frozen=True)
class CoarseView:
    """What the coarse patches alone say: features of each level, and tokens with their places."""

    features: list[Tensor]  # (B * coarse patches, c, y, x), finest first
    tokens: TokenSet
    rows: int  # of coarse patches
    columns: int


class Segmenter(nn.Module):
    """See the module. ``forward`` is for training; inference calls the steps (models.inference)."""

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.config = config
        widths = level_widths(config.width, config.patch)
        self.stem = PatchStem(config.columns, widths, config.dim)
        self.scale_code = nn.Parameter(torch.zeros(2, config.dim))
        self.encoder = Encoder(config.dim, config.layers, config.heads, config.mlp_ratio)
        self.token_gate = nn.Linear(2 * config.dim, config.dim)
        self.seat_mix = nn.Conv2d(config.dim, config.dim, 3, padding=1, groups=config.dim)
        self.coarse_head = PatchHead(widths, config.dim)
        self.fine_head = PatchHead(widths, config.dim)
        self.coarse_mix = Residual(config.width)
        self.pixel_gate = nn.Conv2d(2 * config.width, config.width, 1)
        self.fine_mix = Residual(config.width)
        self.coarse_classes = nn.Conv2d(config.width, config.classes, 1)
        self.fine_classes = nn.Conv2d(config.width, config.classes, 1)

    def forward(
        self, view: CoarseView, fine: Tensor, seats: Tensor, origin: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Classify a batch of scenes whose coarse patches are described already.

        Parameters
        ----------
        view
            ``self.view(coarse, origin)``.
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
        b, k = seats.shape
        p, dim = self.config.patch, self.config.dim
        if k == 0:  # the glance; convolutions take an empty batch forward but not backward
            canvas = self.coarse_canvas(view, self.encode(view, fine.new_zeros(b, 0, dim), seats, origin))
            return self.coarse_logits(canvas), fine.new_zeros(b, 0, self.config.classes, p, p)
        features, tokens = self.stem(fine.flatten(0, 1), coarse=False)
        grid = self.encode(view, tokens.view(b, k, dim), seats, origin)
        canvas = self.coarse_canvas(view, grid)
        context = self.seat_context(grid, seats)
        patches = self.decode_fine(features, context.flatten(0, 1), self.canvas_windows(canvas, seats))
        return self.coarse_logits(canvas), patches.view(b, k, *patches.shape[1:])

    def view(self, coarse: Tensor, origin: Tensor | None = None) -> CoarseView:
        """Cut the coarse image into patches and describe each one."""
        p, s = self.config.patch, self.config.factor
        b, j, y, x = coarse.shape
        rows, columns = y // p, x // p
        patches = coarse.view(b, j, rows, p, columns, p).permute(0, 2, 4, 1, 3, 5).reshape(-1, j, p, p)
        features, tokens = self.stem(patches, coarse=True)
        cells = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).to(coarse.device).double()
        yx = ((cells + 0.5) * s).expand(b, -1, -1)
        placed = self._token_set(tokens.view(b, rows * columns, self.config.dim), yx, 0, columns, origin)
        return CoarseView(features, placed, rows, columns)

    def _token_set(self, x: Tensor, yx: Tensor, fine: int, columns: int, origin: Tensor | None) -> TokenSet:
        s = self.config.factor
        level = torch.full(x.shape[:2], 0.0 if fine else math.log2(s), device=x.device)
        placed = yx if origin is None else yx + origin[:, None, :].double()
        if self.config.positions == "paper":
            coarse = torch.full(x.shape[:2], 1.0 - fine, device=x.device)
            code = code_1d(paper_numbers(yx, coarse, columns, s), self.config.dim)
        else:
            code = code_2d(placed, self.config.dim)
        coded = x + code.to(x.dtype) + self.scale_code[fine]
        return TokenSet(coded, placed, level, torch.ones(x.shape[:2], dtype=torch.bool, device=x.device))

    def encode(self, view: CoarseView, fine: Tensor, seats: Tensor, origin: Tensor | None = None) -> Tensor:
        """Read coarse and fine tokens together; give the seat grid (B, d, rows, columns).

        The grid is the coarse tokens brought up bilinearly; each fine token enters at its seat through a gate.
        """
        s = self.config.factor
        rows, columns = view.rows * s, view.columns * s
        yx = torch.stack([seats // columns, seats % columns], dim=-1).double() + 0.5
        tokens = view.tokens.joined(self._token_set(fine, yx, 1, view.columns, origin))
        mixed = self.encoder(tokens.x, tokens.scale, tokens.valid)
        b, count = seats.shape[0], view.rows * view.columns
        low = mixed[:, :count].transpose(1, 2).reshape(b, self.config.dim, view.rows, view.columns)
        grid = F.interpolate(low, scale_factor=s, mode="bilinear", align_corners=False)
        flat = grid.flatten(2).transpose(1, 2)
        index = seats[..., None].expand(-1, -1, flat.shape[-1])
        here, token = flat.gather(1, index), mixed[:, count:]
        gate = torch.sigmoid(self.token_gate(torch.cat([here, token], dim=-1)))
        flat = flat.scatter(1, index, (here + gate * (token - here)).to(flat.dtype))
        grid = flat.transpose(1, 2).reshape(b, self.config.dim, rows, columns)
        mixed_seats: Tensor = grid + self.seat_mix(grid)
        return mixed_seats

    def seat_context(self, grid: Tensor, seats: Tensor) -> Tensor:
        """Read the seat grid at the given seats, (B, K, d)."""
        flat = grid.flatten(2).transpose(1, 2)
        return flat.gather(1, seats[..., None].expand(-1, -1, flat.shape[-1]))

    def coarse_canvas(self, view: CoarseView, grid: Tensor) -> Tensor:
        """Features of every coarse pixel, mixed across patch borders, (B, c, H/s, W/s)."""
        p, s = self.config.patch, self.config.factor
        context = F.avg_pool2d(grid, s).flatten(2).transpose(1, 2).flatten(0, 1)
        patches = self.coarse_head(view.features, context)
        b, c = grid.shape[0], patches.shape[1]
        image = patches.view(b, view.rows, view.columns, c, p, p).permute(0, 3, 1, 4, 2, 5)
        canvas: Tensor = self.coarse_mix(image.reshape(b, c, view.rows * p, view.columns * p))
        return canvas

    def coarse_logits(self, canvas: Tensor) -> Tensor:
        """Class logits of every coarse pixel."""
        logits: Tensor = self.coarse_classes(F.gelu(canvas))
        return logits

    def canvas_windows(self, canvas: Tensor, seats: Tensor) -> Tensor:
        """The coarse features under each seat, brought up to fine pixels, (B * K, c, p, p).

        Equal to the window of the whole canvas brought up bilinearly, without making that.
        """
        p, s = self.config.patch, self.config.factor
        cells = p // s
        padded = F.pad(canvas, (1, 1, 1, 1), mode="replicate")
        columns = canvas.shape[-1] // cells
        reach = torch.arange(cells + 2, device=canvas.device)
        y = (seats // columns * cells)[..., None] + reach  # (B, K, cells + 2)
        x = (seats % columns * cells)[..., None] + reach
        scene = torch.arange(seats.shape[0], device=canvas.device)[:, None, None, None]
        windows = padded.permute(0, 2, 3, 1)[scene, y[..., :, None], x[..., None, :]]
        windows = windows.flatten(0, 1).permute(0, 3, 1, 2)
        return F.interpolate(windows, scale_factor=s, mode="bilinear", align_corners=False)[..., s : s + p, s : s + p]

    def decode_fine(self, features: list[Tensor], context: Tensor, under: Tensor) -> Tensor:
        """Class logits of fine patches from their own pixels, their context and the coarse features under them."""
        own = self.fine_head(features, context)
        gate = torch.sigmoid(self.pixel_gate(torch.cat([own, under], dim=1)))
        logits: Tensor = self.fine_classes(F.gelu(self.fine_mix(under + gate * (own - under))))
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

"""The network of the paper, as a control: one linear projection, one attention, a map of coarse tokens.

A patch is one token, whatever its scale: its pixels through one shared linear map. Places are the paper's
one-dimensional numbers, P = n (m + 1) + 1 for coarse patch n and P + 1 ... P + m for its seats. Coarse tokens are all
kept, K fine ones are added, and each reads each. The paper does not say where fine tokens are decoded; its counts say
that the coarse grid is what is there, so classes are read from the coarse tokens alone and brought up bilinearly.
Widths, depth and norms are those of the two-scale segmenter: the paper does not state its own.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.baselines.dense import cut
from models.network.encoder import Encoder
from models.network.sizes import SegmenterConfig
from models.network.tokens import code_1d, paper_numbers


class PaperNetwork(nn.Module):
    """See the module. Shapes: B scenes, C coarse patches, K fine ones, J columns, p px a patch, d token width."""

    uses_seats = True

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.config = config
        self.project = nn.Linear(config.columns * config.patch**2, config.dim)
        self.encoder = Encoder(config.dim, config.layers, config.heads, config.mlp_ratio)
        self.classes = nn.Linear(config.dim, config.classes)

    def draw(self, coarse: Tensor, fine: Tensor, seats: Tensor, origin: Tensor | None = None) -> Tensor:
        """Class logits of every fine px, (B, classes, H, W); shapes as in ``token_logits``."""
        logits = self.token_logits(coarse, fine, seats)
        span = self.config.patch * self.config.factor
        return F.interpolate(logits, scale_factor=span, mode="bilinear", align_corners=False)

    def token_logits(self, coarse: Tensor, fine: Tensor, seats: Tensor) -> Tensor:
        """Class logits of each coarse patch, (B, classes, H/ps, W/ps).

        Parameters
        ----------
        coarse
            (B, J, H/s, W/s) normalised columns.
        fine
            (B, K, J, p, p) normalised columns of the captured seats.
        seats
            (B, K) seat numbers, unique within a scene; K may be 0.
        """
        rows, columns = (size // self.config.patch for size in coarse.shape[-2:])
        tokens = self.tokens(coarse, fine, seats)
        read = self.encoder(tokens)[0][:, : rows * columns]
        logits: Tensor = self.classes(read).transpose(1, 2).reshape(-1, self.config.classes, rows, columns)
        return logits

    def tokens(self, coarse: Tensor, fine: Tensor, seats: Tensor) -> Tensor:
        """Coarse tokens, row by row, and after them those of the seats, with their numbers' codes, (B, C + K, d)."""
        patches = torch.cat([cut(coarse, self.config.patch), fine], dim=1)
        scale = torch.zeros(patches.shape[:2], device=coarse.device)
        columns, s = coarse.shape[-1] // self.config.patch, self.config.factor
        cells = torch.arange(patches.shape[1] - seats.shape[1], device=seats.device)
        scale[:, : len(cells)] = 1.0
        corners = torch.stack([cells // columns, cells % columns], dim=-1).expand(len(seats), -1, -1)
        places = torch.stack([seats // (columns * s), seats % (columns * s)], dim=-1)
        yx = torch.cat([(corners + 0.5) * s, places + 0.5], dim=1).double()
        code = code_1d(paper_numbers(yx, scale, columns, s), self.config.dim)
        coded: Tensor = self.project(patches.flatten(2)) + code.to(coarse.dtype)
        return coded

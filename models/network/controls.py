"""Networks that the two-scale segmenter is compared with, and which network a config stands for.

``DenseNetwork`` has one scale: every patch of a scene is read alike, nothing is looked at twice. Its parts and widths
are those of the segmenter's fine side; what it reads is part of its config: the fine image (``fine``: the dense twin),
the coarse image brought up to the fine grid (``coarse``: as many tokens, but nothing that the coarse look did not see),
or means of 2 x 2 fine px (``halved``: a uniform grid with a quarter of the tokens; the camera is kinder to it than to a
coarse pass, it loses no light to smear).

``PaperNetwork`` is that of the paper. A patch is one token, whatever its scale: its pixels through one shared linear
map. Places are the paper's one-dimensional numbers, P = n (m + 1) + 1 for coarse patch n and P + 1 ... P + m for its
seats. Coarse tokens are all kept, K fine ones are added, and each reads each. The paper does not say where fine tokens
are decoded; its counts say that the coarse grid is what is there, so classes are read from the coarse tokens alone and
brought up bilinearly. Widths, depth and norms are those of the segmenter: the paper does not state its own.

Shapes: B scenes, N patches read, C coarse patches, K fine ones, J spectral columns, p px a patch, m tokens a side of
it, d token width.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.network.layers import Encoder, PatchHead, PatchStem, Residual, code_1d, code_2d, cut, joined, paper_numbers
from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig, level_widths
from pipeline.errors import ShapeError


class DenseNetwork(nn.Module):
    """``draw`` makes the map of whole scenes; the other parts are for reading them some at a time."""

    uses_seats = False

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.config = config
        widths = level_widths(config.width, config.patch)
        self.stem = PatchStem(config.columns, widths, config.dim, config.token_side)
        self.encoder = Encoder(config.dim, config.layers, config.heads, config.mlp_ratio)
        self.head = PatchHead(widths, config.dim, config.token_side)
        self.mix = Residual(config.width)
        self.classes = nn.Conv2d(config.width, config.classes, 1)

    @property
    def step(self) -> int:
        """Seats a side of what one patch covers."""
        return 2 if self.config.sight == "halved" else 1

    def draw(self, coarse: Tensor, fine: Tensor, seats: Tensor, origin: Tensor | None = None) -> Tensor:
        """Class logits of every fine px, (B, classes, H, W).

        ``coarse`` (B, J, H/s, W/s) are normalised columns, read where the config's ``sight`` is ``coarse``, else for
        their size; ``fine`` (B, K, J, p, p) those of the seats, not read there. ``seats`` (B, K) are their numbers: but
        for ``coarse`` each seat must be there, in order, or ShapeError is raised. ``origin`` (B, 2) are seat units
        added to the places, for crops of larger scenes.
        """
        patches, across = self._patches(coarse, fine, seats)
        features, tokens = self.stem(patches.flatten(0, 1))
        read = self.encode(tokens.view(*patches.shape[:2], *tokens.shape[1:]), across, origin)
        logits = self.decode(features, read.flatten(0, 1))
        drawn = joined(logits.view(*patches.shape[:2], *logits.shape[1:]), across)
        return F.interpolate(drawn, scale_factor=2, mode="bilinear", align_corners=False) if self.step > 1 else drawn

    def _patches(self, coarse: Tensor, fine: Tensor, seats: Tensor) -> tuple[Tensor, int]:
        """What is read, (B, N, J, p, p), in rows of so many patches."""
        p, s = self.config.patch, self.config.factor
        rows, columns = (size * s // p for size in coarse.shape[-2:])
        if self.config.sight == "coarse":
            return cut(F.interpolate(coarse, scale_factor=s, mode="bilinear", align_corners=False), p), columns
        every = torch.arange(rows * columns, device=seats.device)
        if seats.shape[1] != len(every) or not (seats == every).all():
            raise ShapeError(f"a dense network reads all {len(every)} seats in order, got {seats.shape[1]}")
        if self.config.sight == "fine":
            return fine, columns
        return cut(F.avg_pool2d(joined(fine, columns), 2), p), columns // 2

    def encode(self, tokens: Tensor, columns: int, origin: Tensor | None = None) -> Tensor:
        """Let the tokens of patches in rows of ``columns``, (B, N, m^2, d), read each other."""
        side, number = self.config.token_side, torch.arange(tokens.shape[1], device=tokens.device)
        within = (torch.arange(side, device=tokens.device).double() + 0.5) / side
        places = torch.stack([number // columns, number % columns], dim=-1).double()
        yx = (places[:, None] + torch.cartesian_prod(within, within).view(-1, 2)) * self.step  # seat units, (N, m^2, 2)
        at = yx[None] if origin is None else yx + origin[:, None, None].double()
        coded = tokens + code_2d(at, self.config.dim).to(tokens.dtype)
        read: Tensor = self.encoder(coded.flatten(1, 2))[0]
        return read.view(tokens.shape)

    def decode(self, features: list[Tensor], tokens: Tensor) -> Tensor:
        """Class logits of patches, (N, classes, p, p), from their own pixels and their tokens."""
        logits: Tensor = self.classes(F.gelu(self.mix(self.head(features, tokens))))
        return logits


class PaperNetwork(nn.Module):
    """Shapes as in the module."""

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

        ``coarse`` (B, J, H/s, W/s) and ``fine`` (B, K, J, p, p) are normalised columns, ``seats`` (B, K) the numbers of
        the captured seats, unique within a scene; K may be 0.
        """
        rows, columns = (size // self.config.patch for size in coarse.shape[-2:])
        read = self.encoder(self.tokens(coarse, fine, seats))[0][:, : rows * columns]
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


# Controls have ``draw(coarse, fine, seats, origin)``, logits of whole scenes, and say whether it asks for seats
# (``uses_seats``: some of them, otherwise each one or none); the two-scale segmenter reads a scene in two steps.
Control = DenseNetwork | PaperNetwork
Network = Segmenter | Control


def build_network(config: SegmenterConfig) -> Network:
    """Build the network that ``config.design`` names, with weights drawn from torch's stream."""
    if config.design == "dense":
        return DenseNetwork(config)
    if config.design == "paper":
        return PaperNetwork(config)
    return Segmenter(config)

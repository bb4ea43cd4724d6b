"""A network of one scale, as a control: every patch of a scene is read alike, nothing is looked at twice.

Its parts are those of the two-scale segmenter's fine side, with the same widths; what it reads is part of its
config: the fine image (``fine``: the dense twin), the coarse image brought up to the fine grid (``coarse``: as many
tokens, but nothing that the coarse look did not see), or means of 2 x 2 fine px (``halved``: a uniform grid with a
quarter of the tokens; the camera is kinder to it than to a coarse pass, it loses no light to smear).

Shapes: B scenes, N patches read, J spectral columns, p px a patch, m tokens a side of it, d token width.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.network.encoder import Encoder
from models.network.pixel_side import PatchHead, PatchStem, Residual
from models.network.sizes import SegmenterConfig, level_widths
from models.network.tokens import code_2d
from pipeline.errors import ShapeError


class DenseNetwork(nn.Module):
    """See the module. ``draw`` makes the map of whole scenes; the other parts are for reading them some at a time."""

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
        """Class logits of every fine px.

        Parameters
        ----------
        coarse
            (B, J, H/s, W/s) normalised columns; read where the config's ``sight`` is ``coarse``, else for its size.
        fine
            (B, K, J, p, p) normalised columns of the seats; not read where the sight is ``coarse``.
        seats
            (B, K) their numbers; unless the sight is ``coarse`` each seat must be there, in order.
        origin
            (B, 2) seat units added to the places, for crops of larger scenes.

        Returns
        -------
        (B, classes, H, W).

        Raises
        ------
        ShapeError : a seat is missing that the network reads.
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


def cut(image: Tensor, patch: int) -> Tensor:
    """An image as patches, row by row: (B, c, y, x) -> (B, N, c, p, p)."""
    b, c, y, x = image.shape
    cells = image.view(b, c, y // patch, patch, x // patch, patch).permute(0, 2, 4, 1, 3, 5)
    return cells.reshape(b, -1, c, patch, patch)


def joined(patches: Tensor, columns: int) -> Tensor:
    """Undo ``cut``: patches in rows of ``columns``, (B, N, c, p, p) -> (B, c, y, x)."""
    b, n, c, p, _ = patches.shape
    cells = patches.view(b, n // columns, columns, c, p, p).permute(0, 3, 1, 4, 2, 5)
    return cells.reshape(b, c, n // columns * p, columns * p)

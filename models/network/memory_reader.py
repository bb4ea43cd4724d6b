"""The network that reads a field's memory beside today's look: an update of class probabilities, pixel by pixel.

A Bayes filter would take two looks for independent witnesses; they err at the same edges, and classes change where
spectra do. This network sees both, how long ago the memory is, how the new look was taken, and both coarse looks.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

FAINT = 10.0  # logarithms of probabilities are read down to minus this
GATE = 0.6  # of either witness, before anything is learned


@dataclass(frozen=True)
class MemorySizes:
    """All that is needed to build the network again."""

    classes: int
    columns: int
    factor: int = 4  # fine pixels a side of a coarse one
    width: int = 32
    coarse_width: int = 16

    def as_dict(self) -> dict[str, int]:
        """Plain numbers for a file."""
        return asdict(self)

    def multiply_adds(self, pixels: int) -> int:
        """Multiply-adds of reading so many fine pixels."""
        entered = 2 * self.classes + 4 + self.coarse_width
        fine = 9 * self.width * (entered + self.width + self.classes + 2)
        coarse = 9 * self.width * (2 * self.columns + 1 + self.coarse_width)
        return pixels * fine + pixels // self.factor**2 * coarse


class MemoryReader(nn.Module):
    """Log-probabilities of classes today, from remembered ones and those of today's look."""

    def __init__(self, sizes: MemorySizes) -> None:
        super().__init__()
        self.sizes = sizes
        width, classes = sizes.width, sizes.classes
        self.coarse_enter = nn.Conv2d(2 * sizes.columns + 1, width, 3, padding=1)
        self.coarse_leave = nn.Conv2d(width, sizes.coarse_width, 3, padding=1)
        self.enter = nn.Conv2d(2 * classes + 4 + sizes.coarse_width, width, 3, padding=1)
        self.middle = nn.Conv2d(width, width, 3, padding=2, dilation=2)
        self.leave = nn.Conv2d(width, classes + 2, 3, padding=1)
        for start in self.leave.parameters():
            nn.init.zeros_(start)
        self.gates = nn.Parameter(torch.full((2,), GATE).logit())

    def forward(
        self,
        remembered: Tensor,
        looked: Tensor,
        seen: Tensor,
        age: Tensor,
        light: Tensor,
        step: Tensor,
        coarse_before: Tensor,
        coarse_now: Tensor,
        comparable: Tensor,
    ) -> Tensor:
        """Give log-probabilities (B, class, y, x).

        ``remembered`` and ``looked`` are such; ``seen`` (B, 1, y, x) is 1 where there was a look today, ``age`` (B, 1,
        y, x) days since the memory's last look there. ``light`` (B,) is today's exposure as a share of the reference,
        ``step`` (B,) pixels between its lines. The coarse looks are normalised columns (B, J, y / s, x / s),
        ``comparable`` (B, 1, y / s, x / s) is 1 where they may be compared.
        """
        size = remembered.shape[-2:]
        change = (coarse_now - coarse_before) * comparable
        below = F.gelu(self.coarse_enter(torch.cat([coarse_now * comparable, change, comparable], dim=1)))
        below = F.gelu(self.coarse_leave(below))
        below = F.interpolate(below, scale_factor=float(self.sizes.factor), mode="nearest")
        today = looked * seen
        taken = torch.stack([light.log(), step.log2()], dim=1)[:, :, None, None].expand(-1, 2, *size)
        scaled = [(part / 4).clamp(-FAINT / 4, 0) for part in (remembered, today)]
        features = F.gelu(self.enter(torch.cat([*scaled, seen, torch.log1p(age) / 2, taken, below], dim=1)))
        features = features + F.gelu(self.middle(features))
        added, gates = self.leave(features).split([self.sizes.classes, 2], dim=1)
        trust = torch.sigmoid(gates + self.gates[None, :, None, None])
        logits = trust[:, :1] * remembered + trust[:, 1:] * today + added
        return F.log_softmax(logits, dim=1)

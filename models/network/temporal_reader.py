"""The temporal reader: a network that fuses a prior map with the current visit, pixel by pixel.

A Bayes filter assumes independent observations, but visits err at the same edges. The network reads both class
probabilities, the age of the prior map, exposure and line spacing of the visit, and the spectral features of both.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.network.sizes import CELL_PX, GATES, OTHERS, TemporalSizes

FAINT = 10.0  # least log-probability of the inputs, negated
STARTS = (2.2, 0.0, -1.0)  # of the gates, before training
LEAST_LIGHT = 1e-4  # of a prior map, in reference exposures


class TemporalReader(nn.Module):
    """Compute log-probabilities of today from those of a prior map and of the current visit."""

    def __init__(self, sizes: TemporalSizes) -> None:
        super().__init__()
        self.sizes = sizes
        width, classes = sizes.width, sizes.classes
        self.coarse_enter = nn.Conv2d(2 * sizes.columns + 1, width, 3, padding=1)
        self.coarse_leave = nn.Conv2d(width, sizes.coarse_width, 3, padding=1)
        self.enter = nn.Conv2d(2 * classes + OTHERS + sizes.coarse_width, width, 3, padding=1)
        self.middle = nn.Conv2d(width, width, 3, padding=2, dilation=2)
        self.leave = nn.Conv2d(width, classes + GATES, 3, padding=1)
        for start in self.leave.parameters():
            nn.init.zeros_(start)
        self.gates = nn.Parameter(torch.tensor(STARTS))

    def forward(
        self,
        prior_map: Tensor,
        observation: Tensor,
        seen: Tensor,
        age: Tensor,
        rests_on: Tensor,
        light: Tensor,
        step: Tensor,
        coarse_before: Tensor,
        coarse_now: Tensor,
        comparable: Tensor,
    ) -> Tensor:
        """Return log-probabilities (B, class, y, x) of today.

        ``prior_map`` and ``observation`` are log-probabilities too. ``seen`` (B, 1, y, x) is 1 where the visit captured
        a pixel. ``age`` (B, 1, y, x) is the time since the last capture before it [days]. ``rests_on`` (B, 1, y, x) is
        the exposure of the prior map, in reference exposures a pixel. ``light`` (B,) is the visit's exposure as a
        fraction of the reference, ``step`` (B,) its line spacing [px]. ``coarse_before`` and ``coarse_now`` (B, column,
        y / s, x / s) are spectral features. ``comparable`` (B, 1, y / s, x / s) is 1 where both may be compared.
        """
        size = prior_map.shape[-2:]
        change = (coarse_now - coarse_before) * comparable
        below = F.gelu(self.coarse_enter(torch.cat([coarse_now * comparable, change, comparable], dim=1)))
        below = F.gelu(self.coarse_leave(below))
        below = F.interpolate(below, scale_factor=float(CELL_PX), mode="nearest")
        today = observation * seen
        taken = torch.stack([light.log(), step.log2()], dim=1)[:, :, None, None].expand(-1, 2, *size)
        scaled = [(part / 4).clamp(-FAINT / 4, 0) for part in (prior_map, today)]
        known = rests_on.clamp(min=LEAST_LIGHT).log() / 2
        features = F.gelu(self.enter(torch.cat([*scaled, seen, torch.log1p(age) / 2, known, taken, below], dim=1)))
        features = features + F.gelu(self.middle(features))
        added, gates = self.leave(features).split([self.sizes.classes, GATES], dim=1)
        old, new, replaced = (gates + self.gates[None, :, None, None]).split(1, dim=1)
        both = F.log_softmax(torch.sigmoid(old) * prior_map + torch.sigmoid(new) * today + added, dim=1)
        return torch.logaddexp(F.logsigmoid(-replaced) + prior_map, F.logsigmoid(replaced) + both)

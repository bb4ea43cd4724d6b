"""The temporal reader: a network that fuses a prior map with the current visit, pixel by pixel.

A Bayes filter assumes independent observations, but visits err at the same edges. The network reads both class
probabilities, the age of the prior map, exposure and line spacing of the visit, and the spectral features of both.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from spectralzoom.models.network.layers import pointwise
from spectralzoom.models.network.sizes import CELL_PX, GATES, OTHERS, TemporalSizes

FAINT = 10.0  # least log-probability of the inputs, negated
STARTS = (2.2, 0.0, -1.0)  # of the gates, before training
LEAST_LIGHT = 1e-4  # of a prior map, in reference exposures


class Separable(nn.Sequential):
    """A separable convolution: 1 x 1 across channels, then 3 x 3 within each (Howard et al., MobileNets, 2017)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(pointwise(inputs, outputs), nn.Conv2d(outputs, outputs, 3, padding=1, groups=outputs))


class TemporalReader(nn.Module):
    """Compute log-probabilities of today from those of a prior map and of the current visit."""

    def __init__(self, sizes: TemporalSizes) -> None:
        super().__init__()
        self.sizes = sizes
        width = sizes.width
        self.coarse_enter = Separable(2 * sizes.columns + 1, width)
        self.coarse_leave = Separable(width, sizes.coarse_width)
        self.enter = Separable(2 * sizes.classes + OTHERS + sizes.coarse_width, width)
        self.middle = Separable(width, width)
        self.leave = pointwise(width, sizes.classes + GATES)
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
        season: Tensor,
        coarse_before: Tensor,
        coarse_now: Tensor,
        comparable: Tensor,
    ) -> Tensor:
        """Return log-probabilities (B, class, y, x) of today.

        ``prior_map`` and ``observation`` are log-probabilities too. ``seen`` (B, 1, y, x) is 1 where the visit captured
        a pixel. ``age`` (B, 1, y, x) is the time since the last capture before it [days]. ``rests_on`` (B, 1, y, x) is
        the exposure of the prior map, in reference exposures a pixel. ``light`` (B,) is the visit's exposure as a
        fraction of the reference, ``step`` (B,) its line spacing [px]. ``season`` (B, 2) is the day of the year as
        `models.reading.prior_map.season_of` returns it. ``coarse_before`` and ``coarse_now`` (B, column, y / s, x / s)
        are spectral features. ``comparable`` (B, 1, y / s, x / s) is 1 where both may be compared.
        """
        change = (coarse_now - coarse_before) * comparable
        below = F.gelu(self.coarse_enter(torch.cat([coarse_now * comparable, change, comparable], dim=1)))
        below = F.gelu(self.coarse_leave(below))
        below = F.interpolate(below, scale_factor=float(CELL_PX), mode="nearest")
        today = observation * seen
        taken = torch.cat([torch.stack([light.log(), step.log2()], dim=1), season], dim=1)[:, :, None, None]
        scaled = [(part / 4).clamp(-FAINT / 4, 0) for part in (prior_map, today)]
        known = rests_on.clamp(min=LEAST_LIGHT).log() / 2
        inputs = [*scaled, seen, torch.log1p(age) / 2, known, taken.expand(-1, -1, *prior_map.shape[-2:]), below]
        features = F.gelu(self.enter(torch.cat(inputs, dim=1).contiguous(memory_format=torch.channels_last)))
        wider = self.middle(F.avg_pool2d(features, CELL_PX))
        features = F.gelu(features + F.interpolate(wider, scale_factor=float(CELL_PX), mode="nearest"))
        added, gates = self.leave(features).split([self.sizes.classes, GATES], dim=1)
        old, new, replaced = (gates + self.gates[None, :, None, None]).split(1, dim=1)
        both = F.log_softmax(torch.sigmoid(old) * prior_map + torch.sigmoid(new) * today + added, dim=1)
        return torch.logaddexp(F.logsigmoid(-replaced) + prior_map, F.logsigmoid(replaced) + both)

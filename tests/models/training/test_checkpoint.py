"""Checkpoints: killed training resumes, and checkpoints of other runs and damaged ones are not used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from spectralzoom.models.network.sizes import SegmenterConfig
from spectralzoom.models.training.examples import Example
from spectralzoom.models.training.train import TrainingSettings, run_identity, train
from spectralzoom.models.weights.checksummed_files import load_checkpoint, save_checkpoint
from spectralzoom.pipeline.errors import WeightsError
from tests.models.conftest import killed_after

CONFIG = SegmenterConfig(classes=2, columns=2, patch=8, width=8, dim=16, layers=1, heads=2)
SETTINGS = TrainingSettings(steps=6, batch=2, crop=16)
SHIFT = np.zeros(2, np.float32)


def example(seed: int = 1) -> Example:
    """Return a small scene of noise with labels by its sign."""
    columns = np.random.default_rng(seed).normal(0, 1, (32, 32, 2))
    return Example("e", columns.astype(np.float16), (columns[..., 0] > 0).astype(np.uint8), (32, 32))


@pytest.mark.parametrize("deep", [False, True])
def test_killed_training_resumes_to_the_same_weights(tmp_path: Path, deep: bool) -> None:
    """Started again after it was killed at step 5, training takes steps 5 and 6 and ends with the same weights."""
    file = tmp_path / "c"
    steps = []
    scenes = replace(CONFIG, deep=deep), [example()], SHIFT, SETTINGS
    undisturbed, _ = train(*scenes)
    with pytest.raises(KeyboardInterrupt):
        train(*scenes, killed_after(5), checkpoint=file, keep_every_s=0)
    again, summary = train(*scenes, lambda now: steps.append(now.step), checkpoint=file, keep_every_s=99)
    assert steps == [5, 6]
    assert summary["steps"] == 6
    for name, tensor in undisturbed.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], tensor, atol=1e-4, rtol=1e-3, msg=name)


def test_another_run_starts_from_the_beginning(tmp_path: Path) -> None:
    """A checkpoint of other settings, or of other scenes, is not used."""
    file = tmp_path / "c"
    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, [example()], SHIFT, SETTINGS, killed_after(3), checkpoint=file, keep_every_s=0)
    one, other = (run_identity(config, [example()], SETTINGS, None) for config in (CONFIG, replace(CONFIG, width=16)))
    assert one != other
    for settings, scene in ((replace(SETTINGS, seed=7), example()), (SETTINGS, example(2))):
        with pytest.raises(KeyboardInterrupt):  # it takes step 1
            train(CONFIG, [scene], SHIFT, settings, killed_after(1), checkpoint=file)


@pytest.mark.parametrize("damage", ["cut", "tensor", "description", "other", "empty", "earlier"])
def test_a_damaged_checkpoint_is_refused(tmp_path: Path, damage: str) -> None:
    """The checkpoint is neither used nor overwritten; the error names the file and what to do."""
    file = tmp_path / "c"
    save_checkpoint(file, "x", {"course": {"step": 4}}, {"a": torch.ones(100)})
    raw = file.read_bytes()
    changed = {
        "cut": raw[:60],
        "tensor": raw[:-1] + bytes([raw[-1] ^ 1]),
        "description": raw.replace(b'"step\\": 4', b'"step\\": 5'),
        "other": b"hello",
        "empty": b"",
        "earlier": raw.replace(b"checkpoint/2", b"checkpoint/1"),
    }[damage]
    assert changed != raw
    file.write_bytes(changed)
    for identity in ("x", "another"):
        with pytest.raises(WeightsError, match=r"cannot read .*/c: .*; restore a copy of it, name another file, or"):
            load_checkpoint(file, identity)
    assert file.read_bytes() == changed

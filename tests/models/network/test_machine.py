"""Devices of networks: their choice, refusals, and the transfer of all inputs to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from spectralzoom.models.network.machine import choose_device
from spectralzoom.models.network.segmenter import ChannelNorm, cut
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.reading.inference import overview_of, patch_logits
from spectralzoom.models.training.examples import Batch
from spectralzoom.models.training.objective import PHASES, draw_patches
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.errors import SettingsError
from tests.models.conftest import make_weights, scene_columns


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Return the names of the accelerators that torch reports: none, until a test adds some."""
    there: set[str] = set()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: "cuda" in there)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: "mps" in there)
    return there


@pytest.mark.parametrize(
    ("there", "chosen"), [([], "cpu"), (["mps"], "mps"), (["cuda"], "cuda"), (["mps", "cuda"], "cuda")]
)
def test_auto_prefers_an_accelerator(machine: set[str], there: list[str], chosen: str) -> None:
    """Without one it takes the processor, which can always be chosen by its name."""
    machine.update(there)
    assert choose_device("auto") == chosen
    assert choose_device("cpu") == "cpu"


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("cuda", "--device cuda: torch can use none on this machine; there is mps, cpu: give that, or auto"),
        ("tpu", "--device tpu: it is one of auto, cpu, cuda, mps"),
    ],
)
def test_a_missing_device_is_refused(machine: set[str], asked: str, words: str) -> None:
    """The error names the devices that are there."""
    machine.add("mps")
    with pytest.raises(SettingsError, match=words):
        choose_device(asked)


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Weights:
    """Return weights on a device of which torch keeps only shapes, and which it does not mix with the processor."""
    for kind in (ChannelNorm, torch.nn.RMSNorm):  # for their shapes torch would import its compiler
        monkeypatch.setattr(kind, "forward", lambda norm, x: x)
    return make_weights().on("meta")


@torch.inference_mode()
def test_inputs_of_a_map_are_moved_to_the_device(elsewhere: Weights) -> None:
    """Images, patches and their numbers come from the processor; the logits of patches are copied back to it."""
    coarse_pass, patches = scene_columns(elsewhere, 16, 16)
    overview = overview_of(elsewhere, replace(coarse_pass, origin=(2, 3)))
    assert overview.logits.device.type == "meta"
    with pytest.raises(NotImplementedError, match="copy out of meta tensor"):
        next(patch_logits(elsewhere, overview, patches[:2], np.array([0, 3]), LineSpec()))


def test_a_training_step_stays_on_the_device_of_its_crops(elsewhere: Weights) -> None:
    """The drawn patches are on that device too, though the random numbers come from the processor."""

    def crops(*shape: int) -> Tensor:
        return torch.zeros(2, *shape, device="meta")

    network = elsewhere.segmenter
    batch = Batch(crops(7, 64, 64), crops(7, 64, 64), crops(64, 64).long(), crops(2).long())
    overview = network.read_overview(batch.image, torch.zeros(2, 2))  # places are computed on the processor
    patch_index = draw_patches(overview.logits, network.config, np.random.default_rng(0), PHASES[1])
    cells = cut(batch.detail, network.config.patch)
    chosen = cells.gather(1, patch_index[:, :, None, None, None].expand(-1, -1, *cells.shape[2:]))
    assert network.read_patches(overview, chosen, patch_index).device.type == "meta"

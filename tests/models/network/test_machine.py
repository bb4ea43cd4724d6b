"""Where networks compute: which device is chosen, what is refused, and that everything is brought there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from models.network.machine import choose_device
from models.network.segmenter import ChannelNorm, cut
from models.network.spectral import LineSpec
from models.reading.inference import overview_of, patch_logits
from models.training.examples import Batch
from models.training.objective import PHASES, draw_patches
from models.weights.files import Weights
from pipeline.errors import SettingsError
from tests.models.conftest import make_weights, scene_columns


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of the accelerators that torch believes to be there: none, until a test adds some."""
    there: set[str] = set()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: "cuda" in there)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: "mps" in there)
    return there


@pytest.mark.parametrize(
    ("there", "chosen"), [([], "cpu"), (["mps"], "mps"), (["cuda"], "cuda"), (["mps", "cuda"], "cuda")]
)
def test_auto_takes_an_accelerator_where_there_is_one(machine: set[str], there: list[str], chosen: str) -> None:
    """Else the processor, which can always be asked for by its name."""
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
def test_a_device_that_is_not_there_is_refused_in_a_sentence(machine: set[str], asked: str, words: str) -> None:
    """The message names those that are."""
    machine.add("mps")
    with pytest.raises(SettingsError, match=words):
        choose_device(asked)


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Weights:
    """A network on a device of which torch keeps shapes alone, and which it refuses to mix with the processor."""
    for kind in (ChannelNorm, torch.nn.RMSNorm):  # for their shapes torch would import its compiler
        monkeypatch.setattr(kind, "forward", lambda norm, x: x)
    return make_weights().on("meta")


@torch.inference_mode()
def test_what_a_map_is_drawn_from_is_brought_to_the_network(elsewhere: Weights) -> None:
    """Images, patches and their numbers come from the processor; the logits of patches are asked back from there."""
    coarse_pass, patches = scene_columns(elsewhere, 16, 16)
    overview = overview_of(elsewhere, replace(coarse_pass, origin=(2, 3)))
    assert overview.logits.device.type == "meta"
    with pytest.raises(NotImplementedError, match="copy out of meta tensor"):
        next(patch_logits(elsewhere, overview, patches[:2], np.array([0, 3]), LineSpec()))


def test_a_step_learns_on_the_device_of_its_crops(elsewhere: Weights) -> None:
    """The patches drawn of a batch are on its device too, though chance on the processor has a part in them."""

    def crops(*shape: int) -> Tensor:
        return torch.zeros(2, *shape, device="meta")

    network = elsewhere.segmenter
    batch = Batch(crops(7, 64, 64), crops(7, 64, 64), crops(64, 64).long(), crops(2).long())
    overview = network.read_overview(batch.image, torch.zeros(2, 2))  # places are reckoned on the processor
    patch_index = draw_patches(overview.logits, network.config, np.random.default_rng(0), PHASES[1])
    cells = cut(batch.detail, network.config.patch)
    chosen = cells.gather(1, patch_index[:, :, None, None, None].expand(-1, -1, *cells.shape[2:]))
    assert network.read_patches(overview, chosen, patch_index).device.type == "meta"

"""Where networks compute: which device is chosen, what is refused, and that everything is brought there."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from models.network.machine import choose_device
from models.network.segmenter import Segmenter, SegmenterConfig
from models.training.examples import Batch
from models.training.objective import PHASES, draw_patches
from pipeline.errors import SettingsError

CONFIG = SegmenterConfig(classes=3, columns=6, patch=8, width=8, coarse_width=8, dim=16, layers=2, heads=2)


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
def elsewhere() -> Segmenter:
    """A network on a device of which torch keeps shapes alone, and which it refuses to mix with the processor."""
    return Segmenter(CONFIG).to("meta").eval()


@torch.inference_mode()
def test_what_a_map_is_drawn_from_is_brought_to_the_network(elsewhere: Segmenter) -> None:
    """Images, patches, patches and origins come from the processor; what is read lies with the network."""
    reading = elsewhere.read_coarse_in_chunks(torch.zeros(1, 6, 16, 16), torch.tensor([[2, 3]]), None)
    assert reading.logits.device.type == elsewhere.score(reading).device.type == "meta"
    patches, patch_index = np.zeros((2, 8, 8, 6), np.float32), torch.tensor([0, 5])
    (read,) = elsewhere.read_fine_in_chunks(reading, patches, patch_index, torch.tensor([[2, 3]]))
    assert read.device.type == "meta"


def test_what_a_step_learns_from_is_brought_to_the_network(elsewhere: Segmenter) -> None:
    """A batch of crops and the patches drawn of it, which chance on the processor has a part in."""

    def crops(*shape: int) -> Tensor:
        return torch.zeros(2, *shape, device="cpu")

    batch = Batch(crops(6, 16, 16), crops(64, 6, 8, 8), crops(64, 64).long(), crops(2).long()).on("meta")
    assert {one.device.type for one in vars(batch).values()} == {"meta"}
    reading = elsewhere.read_coarse(batch.coarse, batch.origin)
    score = elsewhere.score(reading).flatten(1)
    patch_index = draw_patches(reading.logits, score, CONFIG, np.random.default_rng(0), PHASES[1])
    fine = batch.fine.gather(1, patch_index[:, :, None, None, None].expand(-1, -1, *batch.fine.shape[2:]))
    assert elsewhere.read_fine(reading, fine, patch_index, batch.origin).device.type == "meta"

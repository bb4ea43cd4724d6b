"""Files of readers of memories: what is written is read, what is damaged or for other weights is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from models.network.memory_reader import MemoryReader
from models.network.sizes import MemorySizes
from models.weights.files import Description, describe_weights, save_weights
from models.weights.memory_files import (
    MemoryWeights,
    describe_reader,
    load_memory,
    memory_key,
    memory_path,
    save_memory,
)
from pipeline.errors import WeightsError
from tests.models.conftest import make_weights


def beside(folder: Path, **changed: int) -> tuple[Path, Description]:
    """Weights and a reader beside them."""
    weights, path = make_weights(), folder / "own.safetensors"
    save_weights(weights, path)
    config = weights.config
    sizes = {
        "classes": config.classes,
        "columns": config.columns,
        "factor": config.factor,
        "width": 8,
        "coarse_width": 4,
    }
    reader = MemoryReader(MemorySizes(**{**sizes, **changed}))
    made = MemoryWeights(reader, "0123", weights.class_names[: reader.sizes.classes], {"seed": 1})
    save_memory(made, memory_path(path))
    return path, describe_weights(path)


def test_a_reader_lies_beside_its_weights(tmp_path: Path) -> None:
    """By their name; nothing there is no reader."""
    assert memory_path(Path("a/farm.safetensors")) == Path("a/farm.memory.safetensors")
    path, described = beside(tmp_path)
    found = describe_reader(path, described)
    assert found is not None
    assert found.key == memory_key(memory_path(path))
    memory_path(path).unlink()
    assert describe_reader(path, described) is None


def test_what_is_written_is_read(tmp_path: Path) -> None:
    """Tensors, names, record; saved again it has the same key."""
    path, described = beside(tmp_path)
    found = load_memory(memory_path(path), described)
    key = memory_key(memory_path(path))
    save_memory(found, memory_path(path))
    assert memory_key(memory_path(path)) == key
    assert found.record == {"seed": 1}
    again = load_memory(memory_path(path), described)
    for name, tensor in found.reader.state_dict().items():
        torch.testing.assert_close(again.reader.state_dict()[name], tensor, rtol=0, atol=0)


def test_every_flipped_bit_is_told(tmp_path: Path) -> None:
    """Of the tensors' bytes and of the header alike, in a message that names the file."""
    path, described = beside(tmp_path)
    file = memory_path(path)
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 120):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        with pytest.raises(WeightsError, match=r"own\.memory\.safetensors"):
            load_memory(file, described)


@pytest.mark.parametrize(
    ("changed", "why"),
    [({"columns": 5}, "the weights have"), ({"factor": 8}, "the weights have"), ({"width": 2048}, "anybody builds")],
)
def test_a_reader_for_others_is_refused(tmp_path: Path, changed: dict[str, int], why: str) -> None:
    """Other columns or another factor than the weights have; and what nobody builds."""
    path, described = beside(tmp_path, **changed)
    with pytest.raises(WeightsError, match=why):
        load_memory(memory_path(path), described)


def test_numbers_that_are_none_are_refused(tmp_path: Path) -> None:
    """A NaN among the tensors."""
    path, described = beside(tmp_path)
    found = load_memory(memory_path(path), described)
    with torch.no_grad():
        found.reader.gates[0] = torch.nan
    save_memory(found, memory_path(path))
    with pytest.raises(WeightsError, match="not finite"):
        load_memory(memory_path(path), described)


def test_weights_are_no_reader(tmp_path: Path) -> None:
    """The file of the weights in its place says what it holds, text says that it is nothing of the kind."""
    path, described = beside(tmp_path)
    with pytest.raises(WeightsError, match=r"spectralzoom-weights/2, expected spectralzoom-memory/1"):
        load_memory(path, described)
    memory_path(path).write_text("hello")
    with pytest.raises(WeightsError, match="no readable file"):
        load_memory(memory_path(path), described)

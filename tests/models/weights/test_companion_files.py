"""Files beside weights, familiar and readers: what is written is read, what is damaged or for other weights refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from models.network.memory_reader import MemoryReader
from models.network.sizes import MemorySizes
from models.reading.familiar import Familiar
from models.weights.companion_files import (
    FamiliarWeights,
    MemoryWeights,
    TrainedOn,
    describe_familiar,
    describe_reader,
    familiar_key,
    familiar_path,
    load_familiar,
    load_memory,
    memory_key,
    memory_path,
    save_familiar,
    save_memory,
)
from models.weights.files import Description, content_key, describe_weights, load_weights, save_weights
from pipeline.errors import WeightsError
from tests.models.conftest import make_weights
from tests.models.reading.test_familiar import some_limits

SEEN = TrainedOn(10, (400.0, 1000.0), (3.0, 100.0), 48, ("a", "b"), (96, 300), (15.0, 60.0), 0.12)


def familiar(folder: Path) -> tuple[Path, Description]:
    """Weights with what is familiar to them beside them."""
    weights, path = make_weights(), folder / "own.safetensors"
    save_weights(weights, path)
    columns = weights.config.columns
    one = np.eye(columns)
    measured = Familiar(np.zeros((1, columns)), one[None], 0.1 * one[None], 0.1 * one, some_limits(), 10)
    save_familiar(FamiliarWeights(measured, content_key(path), SEEN, {"scenes": 48}), familiar_path(path))
    return path, describe_weights(path)


def test_what_is_familiar_is_read_as_it_was_written(tmp_path: Path) -> None:
    """Components, limits, what training saw and the record; saved again the file has the same key."""
    path, described = familiar(tmp_path)
    found, told = load_familiar(path, described), describe_familiar(path, described, content_key(path))
    assert told is not None
    assert (told.key, told.trained_on) == (familiar_key(familiar_path(path)), SEEN)
    assert found.trained_on == SEEN
    assert found.record == {"scenes": 48}
    assert found.familiar.limits.steps == (1, 2)
    save_familiar(found, familiar_path(path))
    assert familiar_key(familiar_path(path)) == told.key


def test_weights_without_such_a_file_have_none(tmp_path: Path) -> None:
    """And are what they were."""
    path, described = familiar(tmp_path)
    familiar_path(path).unlink()
    assert describe_familiar(path, described, content_key(path)) is None


def test_a_file_of_other_weights_is_refused(tmp_path: Path) -> None:
    """By their keys: weights of the same sizes, trained otherwise, see other columns."""
    path, _ = familiar(tmp_path)
    save_weights(make_weights(seed=5), path)
    with pytest.raises(WeightsError, match=r"familiar to other weights.*--familiar WEIGHTS"):
        load_familiar(path, describe_weights(path))


def test_what_training_saw_is_read_as_it_was_told() -> None:
    """With and without what nobody knows."""
    bare = TrainedOn(3, (460.0, 640.0), (100.0, 100.0), 2, ("a", "b"))
    assert [TrainedOn.read(one.as_dict()) for one in (SEEN, bare)] == [SEEN, bare]


def small_reader(described: Description, **changed: int) -> MemoryWeights:
    """A reader for weights so described."""
    config = described.config
    sizes = {
        "classes": config.classes,
        "columns": config.columns,
        "factor": config.factor,
        "width": 8,
        "coarse_width": 4,
    }
    built = MemoryReader(MemorySizes(**{**sizes, **changed}))
    return MemoryWeights(built, "0123", described.class_names[: built.sizes.classes], {"seed": 1})


def reader(folder: Path, **changed: int) -> tuple[Path, Description]:
    """Weights and a reader beside them."""
    weights, path = make_weights(), folder / "own.safetensors"
    save_weights(weights, path)
    described = describe_weights(path)
    save_memory(small_reader(described, **changed), memory_path(path))
    return path, described


def test_a_reader_lies_beside_its_weights(tmp_path: Path) -> None:
    """By their name; nothing there is no reader."""
    assert memory_path(Path("a/farm.safetensors")) == Path("a/farm.memory.safetensors")
    path, described = reader(tmp_path)
    found = describe_reader(path, described)
    assert found is not None
    assert found.key == memory_key(memory_path(path))
    memory_path(path).unlink()
    assert describe_reader(path, described) is None


def test_a_reader_is_read_as_it_was_written(tmp_path: Path) -> None:
    """Tensors, names, record; saved again it has the same key."""
    path, described = reader(tmp_path)
    found = load_memory(memory_path(path), described)
    key = memory_key(memory_path(path))
    save_memory(found, memory_path(path))
    assert memory_key(memory_path(path)) == key
    assert found.record == {"seed": 1}
    again = load_memory(memory_path(path), described)
    for name, tensor in found.reader.state_dict().items():
        torch.testing.assert_close(again.reader.state_dict()[name], tensor, rtol=0, atol=0)


FAMILIAR = (familiar, familiar_path, load_familiar, r"own\.familiar\.safetensors.*(?:make it again|measure it)")
READER = (reader, memory_path, lambda path, described: load_memory(memory_path(path), described), r"own\.memory\.safe")


@pytest.mark.parametrize(("beside", "named", "load", "told"), [FAMILIAR, READER])
def test_every_flipped_bit_is_told(
    tmp_path: Path,
    beside: Callable[[Path], tuple[Path, Description]],
    named: Callable[[Path], Path],
    load: Callable[[Path, Description], object],
    told: str,
) -> None:
    """Of the tensors' bytes and of the header alike, in a message that names the file and says what to do."""
    path, described = beside(tmp_path)
    file = named(path)
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 100):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        with pytest.raises(WeightsError, match=told):
            load(path, described)


@pytest.mark.parametrize(
    ("changed", "why"),
    [({"columns": 5}, "the weights have"), ({"factor": 8}, "the weights have"), ({"width": 2048}, "anybody builds")],
)
def test_a_reader_for_others_is_refused(tmp_path: Path, changed: dict[str, int], why: str) -> None:
    """Other columns or another factor than the weights have; and what nobody builds."""
    path, described = reader(tmp_path, **changed)
    with pytest.raises(WeightsError, match=why):
        load_memory(memory_path(path), described)


def test_numbers_that_are_none_are_refused(tmp_path: Path) -> None:
    """A NaN among the tensors."""
    path, described = reader(tmp_path)
    found = load_memory(memory_path(path), described)
    with torch.no_grad():
        found.reader.gates[0] = torch.nan
    save_memory(found, memory_path(path))
    with pytest.raises(WeightsError, match="not finite"):
        load_memory(memory_path(path), described)


def test_weights_are_no_reader(tmp_path: Path) -> None:
    """The file of the weights in its place says what it holds, text says that it is nothing of the kind."""
    path, described = reader(tmp_path)
    with pytest.raises(WeightsError, match=r"spectralzoom-weights/2, expected spectralzoom-memory/1"):
        load_memory(path, described)
    memory_path(path).write_text("hello")
    with pytest.raises(WeightsError, match="no readable file"):
        load_memory(memory_path(path), described)


def test_what_was_read_stays_where_the_file_is_written_over(tmp_path: Path) -> None:
    """Copied onto while a survey reads with them, weights, reader and limits are still those that were checked."""
    path, described = familiar(tmp_path)
    save_memory(small_reader(described), memory_path(path))
    weights, told = load_weights(path), load_familiar(path, described).familiar
    numbers = load_memory(memory_path(path), described).reader.state_dict()
    kept = [
        told.read.copy(),
        weights.normalisation.whitening.copy(),
        {name: one.clone() for name, one in numbers.items()},
    ]
    for file in (path, memory_path(path), familiar_path(path)):
        with file.open("r+b") as opened:
            opened.write(bytes(file.stat().st_size))
    np.testing.assert_array_equal(told.read, kept[0])
    np.testing.assert_array_equal(weights.normalisation.whitening, kept[1])
    assert all(torch.equal(numbers[name], one) for name, one in kept[2].items())

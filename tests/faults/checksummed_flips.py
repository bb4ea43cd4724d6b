"""Flip one bit in a checksummed file: ``python tests/faults checksummed_flips``.

A reader of weights or of a training checkpoint must refuse the file in one message, or return the written values bit by
bit. `tests/storage/maintenance/test_verification.py` flips bits in an archive.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import torch

from spectralzoom.models.weights.checksummed_files import load_checkpoint, save_checkpoint
from spectralzoom.models.weights.files import describe_weights, load_weights, save_weights
from spectralzoom.pipeline.errors import WeightsError
from tests.conftest import RGB_NM, random_weights
from tests.faults.fault_table import Row, reported_wrong

RUN = "the run's identity"
Content = tuple[Any, Mapping[str, torch.Tensor]]  # everything except the tensors, and the tensors
Read = Callable[[Path], Content]


def _weights(path: Path) -> Content:
    found = load_weights(path)
    normal = {name: torch.from_numpy(value) for name, value in vars(found.normalisation).items()}
    tensors = {**found.segmenter.state_dict(), **normal, "colours": torch.from_numpy(found.class_colours)}
    return (found.config, found.basis, found.class_names, found.record, describe_weights(path).key), tensors


def _state(path: Path) -> Content:
    found = load_checkpoint(path, RUN)
    assert found is not None, "a checkpoint that is there counts as none"
    return found


READERS: dict[str, Read] = {"weights": _weights, "checkpoint": _state}


@dataclass
class Flips:
    """Count the results of reading files with a flipped bit."""

    tried: int = 0
    refused: int = 0
    same: int = 0  # the written values: the flip changed a space, or a byte that is not read
    wrong: list[str] = field(default_factory=list)


def flip_bits(count: int, folder: Path, seed: int = 0) -> Flips:
    """Flip ``count`` single bits, half of them in the tensors, each in a fresh copy of a file, and read it."""
    folder.mkdir(parents=True, exist_ok=True)
    written = _written(folder)
    rng = Random(seed)
    found = Flips()
    before = {name: read(written[name]) for name, read in READERS.items()}
    for number in range(count):
        name = list(READERS)[number % len(READERS)]
        raw = bytearray(written[name].read_bytes())
        data = 8 + int.from_bytes(raw[:8], "little")
        first, stop = rng.choice(((0, data), (data, len(raw)))) if number % 50 else (0, 8)  # the header's size as well
        place, bit = rng.randrange(first, stop), rng.randrange(8)
        raw[place] ^= 1 << bit
        path = folder / "flipped.safetensors"
        path.write_bytes(raw)
        _try(name, path, before[name], f"{name}, byte {place}, bit {bit}", found)
    return found


def _try(name: str, path: Path, before: Content, called: str, found: Flips) -> None:
    found.tried += 1
    try:
        after = READERS[name](path)
    except WeightsError as error:
        found.refused += 1
        if str(path) not in str(error) or "\n" in str(error):
            found.wrong.append(f"{called}: refused with {str(error)[:200]!r}")
    except Exception as error:  # any other exception is the defect that this test searches for
        found.wrong.append(f"{called}: {type(error).__name__}: {str(error)[:200]}")
    else:
        found.same += 1
        if not _alike(before, after):
            found.wrong.append(f"{called}: other numbers, without a word")


def _alike(one: Content, other: Content) -> bool:
    if one[0] != other[0] or one[1].keys() != other[1].keys():
        return False
    bits = lambda tensor: (tensor.dtype, tensor.shape, tensor.detach().contiguous().numpy().tobytes())  # noqa: E731
    return all(bits(value) == bits(other[1][name]) for name, value in one[1].items())


def _written(folder: Path) -> dict[str, Path]:
    weights, state = folder / "weights.safetensors", folder / "weights.safetensors.checkpoint"
    save_weights(random_weights(RGB_NM), weights)
    numbers = torch.Generator().manual_seed(0)
    tensors = {f"model.{name}": torch.randn(7, 5, generator=numbers) for name in "abc"}
    tensors["optimiser.0.step"] = torch.tensor(12.0)
    save_checkpoint(state, RUN, {"course": {"step": 12, "seconds": 3.5}, "rng": {"state": 2**100}}, tensors)
    return {"weights": weights, "checkpoint": state}


def rows(quick: bool) -> Sequence[Row]:
    count = 60 if quick else 2000
    with tempfile.TemporaryDirectory() as place:
        found = flip_bits(count, Path(place))
    words = f"{found.refused} refused in one message, {found.same} as written, {reported_wrong(found.wrong)}"
    injected = "one bit of weights or of a training run's state"
    demanded = "refused in one message, or the numbers that were written"
    met = not found.wrong and found.tried == count
    return [Row("a bit flips in weights", injected, count, demanded, words, met)]

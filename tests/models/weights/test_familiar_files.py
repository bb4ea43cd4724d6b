"""Files of what is familiar: what is written is read, what is damaged or for other weights is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from models.reading.familiar import Familiar
from models.weights.familiar_files import (
    FamiliarWeights,
    describe_familiar,
    familiar_key,
    familiar_path,
    load_familiar,
    save_familiar,
)
from models.weights.files import Description, content_key, describe_weights, save_weights
from models.weights.trained_on import TrainedOn
from pipeline.errors import WeightsError
from tests.models.conftest import make_weights
from tests.models.reading.test_familiar import some_limits

SEEN = TrainedOn(10, (400.0, 1000.0), (3.0, 100.0), 48, ("a", "b"), (96, 300), (15.0, 60.0), 0.12)


def beside(folder: Path) -> tuple[Path, Description]:
    """Weights with what is familiar to them beside them."""
    weights, path = make_weights(), folder / "own.safetensors"
    save_weights(weights, path)
    columns = weights.config.columns
    one = np.eye(columns)
    familiar = Familiar(np.zeros((1, columns)), one[None], 0.1 * one[None], 0.1 * one, some_limits(), 10)
    save_familiar(FamiliarWeights(familiar, content_key(path), SEEN, {"scenes": 48}), familiar_path(path))
    return path, describe_weights(path)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    """Components, limits, what training saw and the record; saved again the file has the same key."""
    path, described = beside(tmp_path)
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
    path, described = beside(tmp_path)
    familiar_path(path).unlink()
    assert describe_familiar(path, described, content_key(path)) is None


def test_every_flipped_bit_is_told(tmp_path: Path) -> None:
    """Of the tensors' bytes and of the header alike, in a message that names the file and says what to do."""
    path, described = beside(tmp_path)
    file = familiar_path(path)
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 80):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        with pytest.raises(WeightsError, match=r"own\.familiar\.safetensors.*(?:make it again|measure it)"):
            load_familiar(path, described)


def test_a_file_of_other_weights_is_refused(tmp_path: Path) -> None:
    """By their keys: weights of the same sizes, trained otherwise, see other columns."""
    path, _ = beside(tmp_path)
    save_weights(make_weights(seed=5), path)
    with pytest.raises(WeightsError, match=r"familiar to other weights.*--familiar WEIGHTS"):
        load_familiar(path, describe_weights(path))


def test_what_training_saw_is_read_as_it_was_told() -> None:
    """With and without what nobody knows."""
    bare = TrainedOn(3, (460.0, 640.0), (100.0, 100.0), 2, ("a", "b"))
    assert [TrainedOn.read(one.as_dict()) for one in (SEEN, bare)] == [SEEN, bare]

"""Parts of a weights file, reader and calibration: added parts are read; damaged or unfit ones are refused."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from spectralzoom.models.evaluation.expected_scores import MapScores
from spectralzoom.models.evaluation.unlike_scenes import TrainingSpectra
from spectralzoom.models.network.sizes import TemporalSizes
from spectralzoom.models.network.temporal_reader import TemporalReader
from spectralzoom.models.weights import files
from spectralzoom.pipeline.errors import WeightsError
from tests.models.conftest import make_weights

SEEN = files.TrainedOn(10, (400.0, 1000.0), (3.0, 100.0), 48, ("a", "b"), (96, 300), (15.0, 60.0), 0.12)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return the path of a file of small weights."""
    files.save_weights(make_weights(), tmp_path / "own.safetensors")
    return tmp_path / "own.safetensors"


def with_reader(path: Path, **changed: int) -> None:
    """Add a temporal reader to the weights."""
    config = files.describe_weights(path).config
    sizes = {"classes": config.classes, "columns": config.columns, "width": 8}
    files.add_reader(path, path, TemporalReader(TemporalSizes(**{**sizes, "coarse_width": 4, **changed})), {"seed": 1})


def test_added_parts_leave_the_weights_unchanged(path: Path) -> None:
    """All parts are read in any order; each has a key of its own, which adding it again does not change."""
    bare = files.describe_weights(path)
    weights = files.load_weights(path)
    assert (bare.map_scores, bare.reader, bare.spectra) == (None, None, None)
    scores = MapScores((1,), (100.0,), np.zeros((1, 1, 3)), np.zeros((1, 1)), 4)
    files.add_map_scores(path, scores)
    with_reader(path)
    files.add_map_scores(path, scores)
    files.add_spectra(path, TrainingSpectra(np.ones((bare.config.columns, 2)), np.zeros(2), np.ones(2), (3.0, 1.5)))
    told = files.describe_weights(path)
    assert told.key == bare.key
    assert told.map_scores.as_dict() == scores.as_dict()
    assert told.reader.record == {"seed": 1}
    assert told.spectra.limits == (3.0, 1.5)
    files.add_reader(path, path, files.load_reader(path), {"seed": 1})
    again = files.describe_weights(path)
    assert again.reader.key == told.reader.key
    for name, tensor in files.load_weights(path).segmenter.state_dict().items():
        torch.testing.assert_close(weights.segmenter.state_dict()[name], tensor, rtol=0, atol=0)


def test_training_description_round_trips() -> None:
    """Optional values may be missing."""
    bare = files.TrainedOn(3, (460.0, 640.0), (100.0, 100.0), 2, ("a", "b"))
    assert [files.TrainedOn.read(json.loads(json.dumps(asdict(one)))) for one in (SEEN, bare)] == [SEEN, bare]


def test_a_missing_reader_names_the_command(path: Path) -> None:
    """The error names the file and the command that makes the reader."""
    with pytest.raises(WeightsError, match=r"own\.safetensors.*spectralzoom train DATASET --train-temporal"):
        files.load_reader(path)


def test_every_flipped_bit_is_found(path: Path) -> None:
    """The bits are drawn from the part's own tensors and from the description; the error names the file."""
    with_reader(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    size = 8 + int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8:size])
    told = header.pop("__metadata__")["about"]
    own = [one["data_offsets"] for name, one in header.items() if name.startswith("memory.")]
    start = whole.index(b'{\\"')
    places = [*(size + rng.integers(*ends) for ends in own * 3), *(start + rng.integers(0, len(told), 40))]
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(WeightsError, match=r"cannot read .*own\.safetensors"):
            files.load_reader(path)


@pytest.mark.parametrize(
    ("changed", "why"),
    [({"columns": 5}, "for another network"), ({"classes": 8}, "for another network"), ({"width": 2048}, "4 wide")],
)
def test_a_reader_that_does_not_fit_is_refused(path: Path, changed: dict[str, int], why: str) -> None:
    """The reader has other columns or classes than the weights, or a width that can only be damage."""
    with_reader(path, **changed)
    with pytest.raises(WeightsError, match=why):
        files.load_reader(path)


def test_a_reader_with_nan_is_refused(path: Path) -> None:
    """One number of its tensors is NaN."""
    with_reader(path)
    found = files.load_reader(path)
    with torch.no_grad():
        found.gates[0] = torch.nan
    files.add_reader(path, path, found, {})
    with pytest.raises(WeightsError, match="not finite"):
        files.load_reader(path)


def test_loaded_weights_survive_overwriting_the_file(path: Path) -> None:
    """During a survey another file may be copied onto it: weights and reader stay those that were checked."""
    with_reader(path)
    weights = files.load_weights(path)
    numbers = files.load_reader(path).state_dict()
    kept = weights.normalisation.whitening.copy()
    before = {name: one.clone() for name, one in numbers.items()}
    with path.open("r+b") as opened:
        opened.write(bytes(path.stat().st_size))
    np.testing.assert_array_equal(weights.normalisation.whitening, kept)
    assert all(torch.equal(numbers[name], one) for name, one in before.items())

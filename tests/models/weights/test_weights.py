"""Files of weights are read as written, and damage is named."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from safetensors.torch import load_file, save_file

from spectralzoom.models.weights.checksummed_files import SEAL, TENSORS, _seal, hash_of
from spectralzoom.models.weights.files import FORMAT, describe_weights, load_weights, save_weights
from spectralzoom.pipeline.errors import WeightsError
from tests.models.conftest import make_weights


def _about(path: Path) -> dict[str, Any]:
    """Return the description in a file, without its hashes."""
    raw = path.read_bytes()
    (size,) = struct.unpack("<Q", raw[:8])
    about: dict[str, Any] = json.loads(json.loads(raw[8 : 8 + size])["__metadata__"]["about"])
    return {name: value for name, value in about.items() if name not in (TENSORS, SEAL)}


def _rewritten(path: Path, about: dict[str, Any], tensors: dict[str, torch.Tensor] | None = None) -> Path:
    tensors = load_file(path) if tensors is None else tensors
    about = {**about, TENSORS: {name: hash_of(tensor) for name, tensor in tensors.items()}}
    save_file(tensors, path, {"about": json.dumps({**about, SEAL: _seal(about)}, sort_keys=True)})
    return path


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """Return the path of a file of small weights."""
    save_weights(make_weights(), tmp_path / "w.safetensors")
    return tmp_path / "w.safetensors"


def test_weights_round_trip_bit_by_bit(saved: Path):
    """Parameters, basis, normalisation, classes, colours and record are those that were saved."""
    before = make_weights()
    after = load_weights(saved)
    old, new = before.segmenter.state_dict(), after.segmenter.state_dict()
    assert list(old) == list(new)
    assert all(torch.equal(old[name], new[name]) for name in old)
    for one in (after, describe_weights(saved)):
        told = (one.config, one.basis, one.class_names, one.record)
        assert told == (before.config, before.basis, before.class_names, before.record)
    for name in ("centre", "spread", "whitening"):
        assert (getattr(after.normalisation, name) == getattr(before.normalisation, name)).all()
    assert (after.class_colours == before.class_colours).all()
    assert not after.segmenter.training


def test_saving_twice_gives_equal_files(saved: Path, tmp_path: Path):
    """The same weights give the same bytes, and no other file is left in the folder."""
    save_weights(load_weights(saved), tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == saved.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.safetensors", "w.safetensors"]


def test_the_error_of_a_missing_file_says_how_to_make_one(tmp_path: Path):
    """The error names the path and the training command."""
    with pytest.raises(
        WeightsError,
        match=r"no weights at .*gone.safetensors; give others as --weights, or train some with: spectralzoom train",
    ):
        load_weights(tmp_path / "gone.safetensors")


@pytest.mark.parametrize("keep", [0, 5, 400, -100, None])
def test_truncated_and_pickled_files_are_refused(saved: Path, keep: int | None):
    """The error names the file, wherever it ends; a pickle of torch is not opened."""
    if keep is None:
        torch.save({"a": torch.zeros(1)}, saved)
    else:
        saved.write_bytes(saved.read_bytes()[:keep])
    with pytest.raises(WeightsError, match=r"cannot read .*w\.safetensors: .*; restore a copy"):
        load_weights(saved)


def test_another_format_is_refused(saved: Path):
    """The error names a newer or older format and a valid command; tensors alone have no format."""
    record = {"command": "spectralzoom train mine --old-option"}
    told = "; leave out --weights for .*, or train anew: spectralzoom train DATASET -o FILE"
    for other in ("spectralzoom-weights/9", "spectralzoom-weights/4"):
        _rewritten(saved, {**_about(saved), "record": record, "format": other})
        with pytest.raises(WeightsError, match=f"{other}, expected {FORMAT}{told}.safetensors$"):
            load_weights(saved)
    save_file({"a": torch.zeros(1)}, saved)
    with pytest.raises(WeightsError, match="holds no format mark"):
        load_weights(saved)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"classes": 1}, "2 to 255 classes, got 1"),
        ({"depth": 3}, "it is of another version; train anew: spectralzoom train"),
        ({"dim": 32}, "it is of another version"),
        ({"columns": 7}, "a basis of 4 columns from 400 to 1000 nm, expected 7"),
        ({"layers": 10_000_000}, "layers of a segmenter must be at least 1 and at most 256"),
        ({"dim": 2**40}, "dim of a segmenter must be at least 1 and at most 16384"),
        ({"layers": 1.0}, "layers of a segmenter must be a whole number, got 1.0"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(saved: Path, changes: dict[str, Any], words: str):
    """An impossible size is named; sizes that do not fit the tensors are called those of another version."""
    about = _about(saved)
    _rewritten(saved, {**about, "config": {**about["config"], **changes}})
    with pytest.raises(WeightsError, match=words):
        load_weights(saved)


@pytest.mark.parametrize(
    "damage",
    [
        {"parts": [["texture", 0, 1.0]]},
        {"parts": [["values", 0, 1.5]]},
        {"parts": [["values", 0, float("nan")]]},
        {"parts": [["values", 0, 0.0]]},
        {"parts": [["values", -1, 1.0]]},
        {"parts": [["values", 10**9, 1.0]]},
        {"parts": [["values", 3, 1.0]]},
        {"parts": [["values", 1.0]]},
        {"parts": [["values", 0, "much"]]},
        {"parts": [["relative", 0, 1.0]]},
        {"parts": 3},
        {"parts": []},
        {"components": [6, 3]},
        {"components": [2, -1]},
        {"components": [2]},
        {"components": None},
        {"corrected": True},
    ],
)
def test_damaged_mixtures_are_refused(tmp_path: Path, damage: dict[str, Any]):
    """Unknown features, weights that do not add up, and sizes that do not fit the tensors."""
    mixed = make_weights(parts=(("values", 0, 1.0),), components=(2, 3), corrected=False)
    save_weights(mixed, tmp_path / "w.safetensors")
    about = _about(tmp_path / "w.safetensors")
    _rewritten(tmp_path / "w.safetensors", {**about, "config": {**about["config"], **damage}})
    with pytest.raises(WeightsError, match=r"cannot read .*w\.safetensors: "):
        load_weights(tmp_path / "w.safetensors")


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("normalisation.centre", None, r"w\.safetensors: .*normalisation.centre"),
        ("class_colours", None, r"w\.safetensors: .*class_colours"),
        ("full_classes.bias", None, r"w\.safetensors: it is of another version"),
        ("full_classes.bias", lambda one: one * torch.nan, "bias has numbers that are not finite"),
        ("full_classes.bias", lambda one: one + torch.inf, "bias has numbers that are not finite"),
        ("full_classes.bias", torch.Tensor.half, "is of torch"),
        ("full_classes.bias", torch.Tensor.int, "is of torch"),
        ("normalisation.spread", torch.zeros_like, "spread has a value that is not above 0"),
    ],
)
def test_invalid_tensors_are_refused_by_name(saved: Path, name: str, change: Any, words: str):
    """Each tensor is required, in finite numbers of its own type, and columns are not divided by 0."""
    tensors = load_file(saved)
    tensor = tensors.pop(name)
    if change is not None:
        tensors[name] = change(tensor)
    _rewritten(saved, _about(saved), tensors)
    with pytest.raises(WeightsError, match=words):
        load_weights(saved)


def test_an_unreadable_file_is_not_called_missing(saved: Path, monkeypatch: pytest.MonkeyPatch):
    """Without permission to read it, the library for its format reports that there is no such file."""
    monkeypatch.setattr(Path, "open", Mock(side_effect=PermissionError(13, "Permission denied", str(saved))))
    with pytest.raises(WeightsError, match="Permission denied"):
        load_weights(saved)


def test_an_incomplete_description_is_refused(saved: Path):
    """The basis is missing, or there are too few class names."""
    about = _about(saved)
    _rewritten(saved, {key: value for key, value in about.items() if key != "basis"})
    with pytest.raises(WeightsError, match=r"w\.safetensors: 'basis'; restore a copy"):
        load_weights(saved)
    _rewritten(saved, {**about, "class_names": ["soil"]})
    with pytest.raises(WeightsError, match="names 1 classes, its segmenter has 3"):
        load_weights(saved)


def test_a_failed_write_keeps_the_old_file(saved: Path, monkeypatch: pytest.MonkeyPatch):
    """A full disk leaves the file that was there, and no part of the new one."""
    before = saved.read_bytes()

    def fill(path: Path, data: bytes) -> int:
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill)
    with pytest.raises(WeightsError, match="No space left on device"):
        save_weights(make_weights(1), saved)
    monkeypatch.undo()
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == ["w.safetensors"]


def test_a_flipped_bit_of_a_tensor_is_found(saved: Path):
    """The error names the tensor; the lowest bit of one number is enough."""
    raw = bytearray(saved.read_bytes())
    raw[-4] ^= 1
    saved.write_bytes(raw)
    with pytest.raises(
        WeightsError, match=r"is damaged, or changed while it was read: tensor \S+ is not what was written; restore"
    ):
        load_weights(saved)


def test_a_header_of_petabytes_is_refused(saved: Path):
    """A claimed tensor of 3.6 PB that the file lacks is refused before memory is allocated."""
    about = json.dumps(_about(saved))
    size = 900 * 10**12
    header = {"__metadata__": {"about": about}, "a": {"dtype": "F32", "shape": [size], "data_offsets": [0, 4 * size]}}
    text = json.dumps(header).encode()
    saved.write_bytes(len(text).to_bytes(8, "little") + text + bytes(64))
    with pytest.raises(WeightsError, match=r"cannot read .*w\.safetensors: .*; restore a copy"):
        load_weights(saved)


BEYOND: dict[str, dict[str, Any]] = {
    "temperature is 0,": {"calibration": {"temperature": 0}},
    "temperature is -1.0,": {"calibration": {"temperature": -1.0}},
    "temperature is nan,": {"calibration": {"temperature": float("nan")}},
    "temperature is 1e+30,": {"calibration": {"temperature": 1e30}},
    "temperature is 'warm',": {"calibration": {"temperature": "warm"}},
    "temperature is None,": {"calibration": {"temperature": None}},
    "temperature is True,": {"calibration": {"temperature": True}},
    "calibration is 3,": {"calibration": 3},
    "split is ": {"split": ["001"]},
    "class_values is 700,": {"class_values": [0, 700]},
    "plain classifier is 4,": {"plain": 4},
    "day is 0,": {"trained_on": {"day": [0, 20]}},
    "wavelength_nm is inf,": {"trained_on": {"wavelength_nm": [400.0, float("inf")]}},
    "exposures_ms is 0,": {"scans": {"exposures_ms": [0, 10.0]}},
    "exposures_ms is None,": {"scans": {"by_law": {"mine": {"exposures_ms": [None]}}}},
    "per_class_iou is 7.5,": {"scans": {"per_class_iou": {"day": [[0.5, 7.5]]}}},
    "least_gain is 0.0,": {"cascade": {"least_gain": [0.0, 0.1]}},
    "miou is -2,": {"validation": {"all": {"miou": -2}}},
}


@pytest.mark.parametrize("words", BEYOND)
def test_numbers_beyond_their_range_are_refused(saved: Path, words: str):
    """One message names the number, also where a description has its hash."""
    _rewritten(saved, {**_about(saved), "record": BEYOND[words]})
    with pytest.raises(WeightsError, match=rf"cannot read .*w\.safetensors: its {re.escape(words)}.*; restore a copy"):
        describe_weights(saved)


def test_corrections_of_scores_have_ranges(saved: Path):
    """A line spacing of 0 and a bias that is not finite are refused."""
    good = {"scenes": 2, "steps": [1], "exposures_ms": [3.0], "bias": [[[0.1] * 3]], "error": [[0.1]]}
    about = _about(saved)
    described = {**about, "keys": {**about["keys"], "map_scores": "0"}}
    for change in ({"steps": [0]}, {"bias": [[[0.1, float("nan"), 0.1]]]}, {"error": [[-1.0]]}):
        _rewritten(saved, {**described, "map_scores": good | change})
        with pytest.raises(WeightsError, match=f"its {next(iter(change))} is .*, expected a number from"):
            describe_weights(saved)
    _rewritten(saved, {**described, "map_scores": good})
    assert describe_weights(saved).map_scores is not None


def test_scores_without_a_pixel_are_read(saved: Path):
    """They are null or NaN; classes may have the names of other numbers."""
    scans = {"steps": [1], "miou": [[float("nan")]], "spread": None, "per_class_iou": {"day": [[0.9]], "bias": [[0.1]]}}
    record = {"scans": scans, "trained_on": {"day": None}, "validation": None, "split": {"train": {"day": "001"}}}
    _rewritten(saved, {**_about(saved), "record": record})
    assert describe_weights(saved).record["scans"]["steps"] == [1]

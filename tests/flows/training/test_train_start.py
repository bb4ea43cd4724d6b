"""Training begun from weights that exist: what is printed and recorded, refused first, and never forgotten."""

from __future__ import annotations

import base64
import hashlib
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from flows.training import train as flow
from flows.training.data import pack_mask, unpack_mask
from flows.training.train import TrainRequest, joined_split, train_weights
from models.training.start_weights import StartFile
from models.training.train import TrainingSettings
from models.weights.files import describe_weights, load_weights
from pipeline.errors import SettingsError
from tests.flows.small_fields import write_field

TOKENS = {"dim": 16, "layers": 1, "heads": 2, "mlp_ratio": 3}
FLAGS = ("--steps", 1, "--batch", 1, "--crop", 16, "--patch", 8, "--factor", 2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames of 16 x 16 px with two classes."""
    return write_field(tmp_path_factory.mktemp("frames") / "field", (16, 16), ("001", "002", "003", "004"))


def _request(folder: Path, out: Path, **choices: Any) -> TrainRequest:
    settings = TrainingSettings(steps=1, batch=1, crop=16)
    sizes = {"patch": 8, "factor": 2, "width": 4, "tokens": TOKENS, "validation": 0, "settings": settings, **choices}
    return TrainRequest(str(folder), out, **sizes)


def _transformer(path: Path) -> Path:
    """A file of one block and a norm, 64 wide: one head."""
    rng, dim = torch.Generator().manual_seed(0), 64
    sizes = {"attn.qkv": 3 * dim, "attn.proj": dim, "mlp.fc1": 4 * dim}
    state = {f"blocks.0.{name}.weight": torch.randn(rows, dim, generator=rng) for name, rows in sizes.items()}
    state |= {"pos_embed": torch.zeros(1, 5, dim), "norm.weight": torch.ones(dim)}
    torch.save({"model": state, "license": "Apache-2.0"}, path)
    return path


@pytest.fixture(scope="module")
def earlier(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights trained on three of the frames."""
    path = tmp_path_factory.mktemp("weights") / "first.safetensors"
    train_weights(_request(folder, path, hold_out=("004",)))
    return path


def test_weights_begun_from_others_say_so(folder: Path, earlier: Path, tmp_path: Path):
    """They record the file and its hash, and are as much trained on its frames as it was."""
    out = tmp_path / "second.safetensors"
    record = train_weights(_request(folder, out, hold_out=("001", "002", "003"), init=earlier))
    begun = record["begun_from"]
    assert (begun["file"], begun["kind"], begun["skipped"]) == ("first.safetensors", "spectralzoom", {})
    assert begun["sha256"] == hashlib.sha256(earlier.read_bytes()).hexdigest()
    split = load_weights(out).record["split"]
    assert list(split["train"]) == ["004", *(f"first.safetensors: {name}" for name in ("001", "002", "003"))]
    assert {*split["train"].values()} > {*describe_weights(earlier).record["split"]["train"].values()}


def test_training_goes_on_from_there(folder: Path, earlier: Path, tmp_path: Path):
    """After one step at a rate of nothing the weights are those that were begun from."""
    still = TrainingSettings(steps=1, batch=1, crop=16, learning_rate=0.0)
    out = tmp_path / "still.safetensors"
    train_weights(_request(folder, out, hold_out=("004",), init=earlier, settings=still))
    before, after = (load_weights(path).segmenter.state_dict() for path in (earlier, out))
    assert all(torch.allclose(after[name], value, atol=1e-7) for name, value in before.items())


def test_frames_that_the_start_has_seen_validate_nothing(folder: Path, earlier: Path, tmp_path: Path):
    """Figures on them would say nothing: refused before training."""
    with pytest.raises(SettingsError, match="was trained on the scene 001, which is kept for validation"):
        train_weights(_request(folder, tmp_path / "w.safetensors", validation=1, init=earlier))


def test_frames_that_the_start_has_seen_in_part_validate_nothing_either(
    folder: Path, earlier: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A mask kept some pixels from it, but validation counts all that are labelled."""
    split = describe_weights(earlier).record["split"]
    masks = {key: pack_mask(np.eye(16, dtype=bool)) for key in split["train"].values()}
    monkeypatch.setattr(StartFile, "earlier", property(lambda file: {"split": {**split, "pixels": masks}}))
    with pytest.raises(SettingsError, match="was trained on the scene 001, which is kept for validation"):
        train_weights(_request(folder, tmp_path / "w.safetensors", validation=1, init=earlier))


def test_tokens_of_another_width_are_refused_before_any_scene_is_opened(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The message says what to pass; so it is with another network, and with sizes that are none."""
    monkeypatch.setattr(flow, "open_training_data", lambda *args, **kwargs: pytest.fail("scenes were opened"))
    file, out = _transformer(tmp_path / "vit.pth"), tmp_path / "w.safetensors"
    with pytest.raises(SettingsError, match=r"has --dim 16 --heads 2 .* pass --dim 64 --heads 1 --mlp-ratio 4 \(and"):
        train_weights(_request(folder, out, init=file))
    with pytest.raises(SettingsError, match="--init is for the two-scale network, got --preset dense"):
        train_weights(_request(folder, out, init=file, preset="dense"))
    with pytest.raises(SettingsError, match=r"token width 18 .*choose another --dim or --heads"):
        train_weights(_request(folder, out, init=file, tokens={**TOKENS, "dim": 18}))


def test_the_command_prints_what_became_of_a_transformer(command_line: Any, folder: Path, tmp_path: Path):
    """Matched, resized and skipped with the reason, and the licence; a width that is another is a matter of usage."""
    file, out = _transformer(tmp_path / "vit.pth"), tmp_path / "w.safetensors"
    words = ("train", folder, "-o", out, "--validation", 0, "--init", file, *FLAGS)
    refused = command_line(*words)
    assert refused.code == 2
    assert "pass --dim 64 --heads 1 --mlp-ratio 4" in refused.errors[0]
    done = command_line(*words, "--dim", 64, "--heads", 1, "--mlp-ratio", 4, "--layers", 1)
    assert done.code == 0
    said = " ".join(done.err.split())
    assert "begun from vit.pth (vision transformer): 4 tensors matched, 0 resized, 1 skipped" in said
    assert "skipped pos_embed: positions on a grid of its own" in said
    assert "its licence: Apache-2.0" in said
    assert load_weights(out).config.dim == 64


def test_masks_of_what_was_seen_add_up(tmp_path: Path, earlier: Path, monkeypatch: pytest.MonkeyPatch):
    """Pixels seen by either are seen; a scene that one of both saw whole has no mask any more."""
    one, other = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    one[0], other[:, 0] = True, True
    start = StartFile(earlier)
    before = {"train": {"a": "A", "b": "B"}, "pixels": {"A": pack_mask(one), "B": pack_mask(one)}}
    monkeypatch.setattr(StartFile, "earlier", property(lambda file: {"split": before}))
    own = {"train": {"a": "A", "b": "B", "c": "C"}, "pixels": {"A": pack_mask(other), "C": pack_mask(other)}}
    joined = joined_split(own, start)
    assert (unpack_mask(joined["pixels"]["A"], (4, 4)) == one | other).all()
    assert set(joined["pixels"]) == {"A", "C"}
    assert joined["train"] == own["train"]
    assert zlib.decompress(base64.b64decode(joined["pixels"]["C"])) == np.packbits(other).tobytes()

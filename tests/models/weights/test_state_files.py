"""Files of other people's weights: wrappers opened, damage named, Python objects refused without running them."""

from __future__ import annotations

import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from models.weights.state_files import read_heads, read_state, unwrap_state
from pipeline.errors import WeightsError

STATE = {"blocks.0.weight": torch.arange(6.0).reshape(2, 3), "norm.bias": torch.ones(2)}
VARIANT = """
net_kwargs:
  backbone: vit_tiny_patch16_384
  patch_size: 16
  d_model: 192
  n_heads: 3
  n_layers: 12
  n_cls: 150
  decoder: {name: mask_transformer, n_layers: 2}
"""


class Trap:
    """Runs code when it is unpickled, unless nobody unpickles it."""

    def __init__(self, sign: Path) -> None:
        self.sign = sign

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.sign,))


@pytest.mark.parametrize(
    "content",
    [
        STATE,
        OrderedDict(STATE),
        {"model": STATE, "epoch": 3},
        {"state_dict": STATE, "optimizer": {"lr": 0.1}},
        {"model": {"state_dict": STATE}},
        {"model": {f"module.{name}": value for name, value in STATE.items()}},
    ],
)
def test_wrappers_are_opened(tmp_path: Path, content: dict[str, Any]):
    """The named tensors come out, whatever dictionaries and prefixes lie around them."""
    torch.save(content, tmp_path / "w.pth")
    found = read_state(tmp_path / "w.pth")
    assert found.keys() == STATE.keys()
    assert all(torch.equal(found[name], value) for name, value in STATE.items())


@pytest.mark.parametrize("how", ["torch", "pickle"])
def test_python_objects_are_refused_unread(tmp_path: Path, how: str):
    """A file with an object that would run code is refused, and the code does not run."""
    sign, path = tmp_path / "ran", tmp_path / "w.pth"
    content = {"model": STATE, "args": Trap(sign)}
    if how == "torch":
        torch.save(content, path)
    else:
        path.write_bytes(pickle.dumps({"args": Trap(sign)}))
    with pytest.raises(WeightsError, match=r"w\.pth .*(Python objects are never loaded|damaged)"):
        read_state(path)
    assert not sign.exists()


@pytest.mark.parametrize("name", ["w.pth", "w.safetensors"])
@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.5, 0.99])
def test_files_cut_short_are_refused(tmp_path: Path, name: str, fraction: float):
    """Wherever the file ends early the message names it and says what to do."""
    path = tmp_path / name
    save_file(STATE, path) if name.endswith("safetensors") else torch.save(STATE, path)
    path.write_bytes(path.read_bytes()[: int(fraction * path.stat().st_size)])
    with pytest.raises(WeightsError, match=name):
        read_state(path)


def test_files_without_tensors_are_refused(tmp_path: Path):
    """The message says what there is instead."""
    torch.save({"epoch": 3, "lr": 0.1}, tmp_path / "w.pth")
    with pytest.raises(WeightsError, match="has no named tensors, it has: epoch, lr"):
        read_state(tmp_path / "w.pth")
    with pytest.raises(WeightsError, match="it has: list"):
        unwrap_state([1, 2], "w.pth")
    with pytest.raises(WeightsError, match=r"no file of weights at .*none\.pth"):
        read_state(tmp_path / "none.pth")


def test_the_heads_of_a_segmenter_are_read(tmp_path: Path):
    """They come from variant.yml beside the checkpoint: no shape tells them."""
    (tmp_path / "variant.yml").write_text(VARIANT)
    assert read_heads(tmp_path / "checkpoint.pth") == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no variant.yml beside"),
        (VARIANT.replace("n_heads: 3", ""), "lacks 'n_heads'"),
        ("just text", "lacks 'n_heads'"),
        (VARIANT.replace("n_heads: 3", "n_heads: many"), "cannot use"),
        (VARIANT.replace("n_heads: 3", "n_heads: !!python/object/apply:os.getcwd []"), "cannot use"),
    ],
)
def test_a_variant_that_cannot_be_used_is_named(tmp_path: Path, text: str | None, said: str):
    """Missing, incomplete, damaged, or with an object in the place of a number."""
    if text is not None:
        (tmp_path / "variant.yml").write_text(text)
    with pytest.raises(WeightsError, match=said):
        read_heads(tmp_path / "checkpoint.pth")


def test_one_number_that_is_called_many_is_refused(tmp_path: Path):
    """Petabytes by a stride of 0: a file of a kilobyte that any use of its tensor would fill the memory for."""
    torch.save({"weight": torch.ones(1).expand(900 * 10**12)}, tmp_path / "w.pth")
    with pytest.raises(
        WeightsError, match=r"w.pth claims \(900000000000000,\) numbers for the tensor weight, more than"
    ):
        read_state(tmp_path / "w.pth")

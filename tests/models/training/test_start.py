"""Training begun from earlier weights: what is taken, what is refused and what to pass instead, what is recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models.network.spectral import Normalisation, SpectralBasis
from models.training.start import LabelledPixels, StartFile, column_change, linear_discriminants
from models.weights.files import Weights, save_weights
from pipeline.errors import SettingsError, WeightsError
from tests.models.conftest import Maker

BASIS = SpectralBasis(400.0, 1000.0, 4)


@pytest.mark.parametrize("sizes", [{"dim": 32}, {"heads": 4}, {"mlp_ratio": 4}])
def test_tokens_of_other_sizes_are_refused_with_what_to_pass(tmp_path: Path, tiny: Maker, sizes: dict[str, int]):
    """Width, heads and MLP have to be the file's, the number of layers need not."""
    weights = tiny()
    file = _kept(weights, tmp_path / "w.safetensors")
    file.check(replace(weights.config, layers=3))
    with pytest.raises(SettingsError, match=r"pass --dim 16 --heads 2 --mlp-ratio 3 \(and --layers 1 to take all"):
        file.check(replace(weights.config, **sizes))


def test_fewer_layers_and_other_widths_take_what_fits(tmp_path: Path, tiny: Maker):
    """Layers beyond the last have no place, tensors of another shape neither; both are said."""
    weights = tiny(layers=2)
    file = _kept(weights, tmp_path / "w.safetensors")
    config = replace(weights.config, layers=1, overview_width=12)
    start = file.begin(config, weights.basis, weights.normalisation, weights.class_names)
    beyond = start.record["skipped"].pop("layers beyond the last")
    assert {name.split(".")[2] for name in beyond} == {"1"}
    assert all("does not fit" in why for why in start.record["skipped"])
    assert any(name.startswith("encoder.blocks.0.") for name in start.state)
    assert not {"overview_stem.enter.weight", "full_stem.enter.weight"} & start.state.keys()  # both are as wide


def test_files_that_are_no_weights_are_refused(tmp_path: Path):
    """A file that is not there is a matter of usage; what is none of ours is named."""
    with pytest.raises(SettingsError, match=r"no file .*none\.safetensors; --init takes weights that"):
        StartFile(tmp_path / "none.safetensors")
    (tmp_path / "cut.safetensors").write_bytes(b"1234")
    with pytest.raises(WeightsError, match=r"cut\.safetensors is not a readable safetensors file"):
        StartFile(tmp_path / "cut.safetensors")


def _kept(weights: Weights, path: Path) -> StartFile:
    save_weights(weights, path)
    return StartFile(path)


def test_earlier_weights_of_the_same_data_are_taken_whole(tmp_path: Path, tiny: Maker):
    """Every tensor of the segmenter is copied exactly, the scorer's included, and nothing is missing."""
    weights = tiny(1)
    file = _kept(weights, tmp_path / "w.safetensors")
    start = file.begin(weights.config, weights.basis, weights.normalisation, weights.class_names)
    wanted = weights.segmenter.state_dict()
    assert start.state.keys() == wanted.keys()
    assert (start.record["matched"], start.record["resized"], start.record["skipped"]) == (len(wanted), {}, {})
    for name, value in wanted.items():
        assert torch.equal(start.state[name], value)
    assert file.earlier["seed"] == 1


def test_other_classes_leave_their_heads_fresh(tmp_path: Path, tiny: Maker):
    """Same number or not: what tells classes apart, and the scorer that reads it, begin anew."""
    weights = tiny(2)
    file = _kept(weights, tmp_path / "w.safetensors")
    for names in (("a", "b", "c"), ("a", "b")):
        config = replace(weights.config, classes=len(names))
        start = file.begin(config, weights.basis, weights.normalisation, names)
        fresh = {name.split(".")[0] for name in weights.segmenter.state_dict() if name not in start.state}
        assert fresh == {"overview_classes", "full_classes", "spectral", "scorer"}
        assert set(start.record["skipped"]) == {"other classes"}
        assert not any(name.split(".")[0] in fresh for name in start.state)


def test_other_columns_are_reached_by_wavelength(tmp_path: Path, tiny: Maker):
    """First kernels are brought to the new number of columns, no larger; what they read beside stays as it was."""
    weights = tiny(3)
    file = _kept(weights, tmp_path / "w.safetensors")
    new = Normalisation(np.full(7, 0.3, np.float32), np.full(7, 0.1, np.float32), 3 * np.eye(7, dtype=np.float32))
    config = replace(weights.config, columns=7)
    start = file.begin(config, SpectralBasis(450.0, 900.0, 7), new, weights.class_names)
    kernels = ("overview_stem.enter.weight", "full_stem.enter.weight", "spectral.weight")
    assert start.record["resized"] == dict.fromkeys(kernels, "4 to 7 spectral columns by wavelength")
    assert start.state.keys() == weights.segmenter.state_dict().keys()
    for stem in ("overview", "full"):
        (before, beside), (after, kept) = (
            state[f"{stem}_stem.enter.weight"].tensor_split([columns], dim=1)
            for state, columns in ((weights.segmenter.state_dict(), 4), (start.state, 7))
        )
        assert (after.flatten(1).norm(dim=1) <= before.flatten(1).norm(dim=1) * (1 + 1e-5)).all()
        assert torch.equal(beside, kept)  # planes of the capture, and what the overview found


def test_a_change_of_columns_is_exact_for_the_same_wavelengths():
    """Columns of the new whitening, changed, are those of the old one, for data of the same median and spread."""
    rng = np.random.default_rng(6)
    pixels = rng.normal(size=(500, 4)) @ rng.normal(size=(4, 4))
    one = Normalisation.measured(pixels.astype(np.float32))
    other = replace(one, whitening=(np.eye(4) + 0.1).astype(np.float32))
    every = np.ones(4, np.bool_)
    change = column_change(BASIS, one, BASIS, other)
    found = other.apply(pixels, every) @ change
    assert found == pytest.approx(one.apply(pixels, every), rel=1e-3, abs=1e-3)
    assert column_change(BASIS, one, BASIS, one) == pytest.approx(np.eye(4), abs=1e-5)


def test_kernels_for_the_same_data_say_what_they_said(tmp_path: Path, tiny):
    """Where whitening alone differs, by noise that it knows of, first kernels see what they saw, however large."""
    weights = tiny(3)
    file = _kept(weights, tmp_path / "w.safetensors")
    old = weights.normalisation
    new = replace(old, whitening=(0.1 * np.eye(4) + 0.02).astype(np.float32))
    start = file.begin(weights.config, weights.basis, new, weights.class_names)
    pixels = np.random.default_rng(1).normal(size=(50, 4)).astype(np.float32)
    kernel = "full_stem.enter.weight"
    before, after = (
        torch.einsum("pc,ocyx->poyx", torch.from_numpy(one.apply(pixels, np.ones(4, np.bool_))), state[kernel][:, :4])
        for one, state in ((old, weights.segmenter.state_dict()), (new, start.state))
    )
    np.testing.assert_allclose(after.numpy(), before.numpy(), rtol=1e-3, atol=1e-4)


def test_discriminants_of_absent_classes_are_out_of_reach():
    """Two of three classes have pixels: each is told by its own channel, and the third is never the likeliest."""
    rng, labels = np.random.default_rng(0), np.repeat(np.array([0, 2], np.uint8), 50)
    features = (rng.normal(0, 1, (100, 4)) + 5 * labels[:, None]).astype(np.float32)
    found = linear_discriminants(LabelledPixels(features, labels), 3)
    logits = features @ found["spectral.weight"][:, :, 0, 0].numpy().T + found["spectral.bias"].numpy()
    assert (logits.argmax(axis=1) == labels).all()
    assert (logits[:, 1] == -20).all()

"""Training begun from weights that exist: what is taken, what is refused and what to pass instead, what is recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig
from models.network.spectral import Normalisation, SpectralBasis
from models.training.pretrained import mixed_channels, rgb_response
from models.training.start_weights import StartFile, TokenSizes, column_change
from models.weights.files import Weights, save_weights, with_record
from pipeline.errors import SettingsError, WeightsError
from tests.models.conftest import Maker

DIM, HEADS = 128, 2
CONFIG = SegmenterConfig(
    3, columns=4, patch=8, factor=2, width=8, coarse_width=8, dim=DIM, layers=2, heads=HEADS, mlp_ratio=4
)
BASIS = SpectralBasis(400.0, 1000.0, 4)
PLAIN = Normalisation(np.zeros(4, np.float32), np.ones(4, np.float32), np.eye(4, dtype=np.float32))
NAMES = ("soil", "crop", "weed")
VARIANT = f"""
net_kwargs:
  backbone: vit_tiny
  patch_size: 16
  d_model: {DIM}
  n_heads: 4
  n_layers: 3
  n_cls: 150
  decoder: {{name: mask_transformer, n_layers: 2}}
"""


def transformer(layers: int = 3, dim: int = DIM) -> dict[str, Tensor]:
    """A vision transformer's tensors as timm names them."""
    rng = torch.Generator().manual_seed(0)
    sizes = {
        "norm1.weight": (dim,),
        "norm1.bias": (dim,),
        "norm2.weight": (dim,),
        "norm2.bias": (dim,),
        "attn.qkv.weight": (3 * dim, dim),
        "attn.qkv.bias": (3 * dim,),
        "attn.proj.weight": (dim, dim),
        "attn.proj.bias": (dim,),
        "mlp.fc1.weight": (4 * dim, dim),
        "mlp.fc1.bias": (4 * dim,),
        "mlp.fc2.weight": (dim, 4 * dim),
        "mlp.fc2.bias": (dim,),
    }
    state = {
        f"blocks.{layer}.{name}": torch.randn(*size, generator=rng)
        for layer in range(layers)
        for name, size in sizes.items()
    }
    return state | {
        "cls_token": torch.zeros(1, 1, dim),
        "pos_embed": torch.zeros(1, 5, dim),
        "patch_embed.proj.weight": torch.zeros(dim, 3, 4, 4),
        "patch_embed.proj.bias": torch.zeros(dim),
        "norm.weight": torch.randn(dim, generator=rng),
        "norm.bias": torch.randn(dim, generator=rng),
        "head.weight": torch.zeros(9, dim),
        "head.bias": torch.zeros(9),
    }


def saved(path: Path, content: object) -> Path:
    """The same path, with what torch wrote there."""
    torch.save(content, path)
    return path


def test_blocks_of_a_transformer_are_taken(tmp_path: Path):
    """Blocks and the last norm by their own names; the rest is skipped with the reason, deeper layers too."""
    state = transformer()
    file = StartFile(saved(tmp_path / "deit.pth", {"model": state, "license": "Apache-2.0"}))
    assert file.kind == "vision transformer"
    assert file.sizes == TokenSizes(DIM, HEADS, 4, 3)
    start = file.begin(CONFIG, BASIS, PLAIN, NAMES)
    assert len(start.report.matched) == 2 * 12 + 2
    for ours, theirs in {
        "encoder.blocks.1.attention.qkv.weight": "blocks.1.attn.qkv.weight",
        "encoder.blocks.0.attention.out.bias": "blocks.0.attn.proj.bias",
        "encoder.blocks.1.mlp.0.weight": "blocks.1.mlp.fc1.weight",
        "encoder.blocks.0.mlp.2.weight": "blocks.0.mlp.fc2.weight",
        "encoder.blocks.0.norm2.weight": "blocks.0.norm2.weight",
        "encoder.norm.bias": "norm.bias",
    }.items():
        assert torch.equal(start.state[ours], state[theirs])
    assert len(start.state) == 26
    assert start.record["skipped"] == {
        "layers beyond the last": [name for name in state if name.startswith("blocks.2.")],
        "a token of the whole image": ["cls_token"],
        "positions on a grid of its own": ["pos_embed"],
        "a kernel of whole patches of colours": ["patch_embed.proj.weight", "patch_embed.proj.bias"],
        "a classifier of photographs": ["head.weight", "head.bias"],
    }
    assert (start.record["file"], start.record["kind"]) == ("deit.pth", "vision transformer")
    assert (start.record["matched"], start.record["licence"]) == (26, "Apache-2.0")
    assert len(start.record["sha256"]) == 64


def test_blocks_compute_here_what_they_compute_there(tmp_path: Path):
    """But for the norms of queries and keys a block is the transformer's: with these left out both agree."""
    state = transformer(1)
    start = StartFile(saved(tmp_path / "v.pth", state)).begin(CONFIG, BASIS, PLAIN, NAMES)
    model = Segmenter(CONFIG).eval()
    model.load_state_dict(start.state, strict=False)
    block = model.encoder.blocks[0]
    block.attention.query_norm = block.attention.key_norm = torch.nn.Identity()
    x = torch.randn(1, 7, DIM, generator=torch.Generator().manual_seed(1))
    norm = [torch.nn.functional.layer_norm(x, (DIM,), *(state[f"blocks.0.norm1.{p}"] for p in ("weight", "bias")))]
    qkv = norm[0] @ state["blocks.0.attn.qkv.weight"].T + state["blocks.0.attn.qkv.bias"]
    q, k, v = qkv.reshape(1, 7, 3, HEADS, DIM // HEADS).permute(2, 0, 3, 1, 4)  # as timm lays them out
    mixed = ((q @ k.transpose(-2, -1)) * (DIM // HEADS) ** -0.5).softmax(dim=-1) @ v
    read = mixed.transpose(1, 2).reshape(1, 7, DIM) @ state["blocks.0.attn.proj.weight"].T
    with torch.inference_mode():
        found = block.attention(norm[0], None)[0]
    torch.testing.assert_close(found, read + state["blocks.0.attn.proj.bias"], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("patch", "size"), [(16, 16), (32, 16), (8, 16), (16, 4)])
def test_a_patch_kernel_of_colours_reads_columns(tmp_path: Path, patch: int, size: int):
    """Its tokens are those of the picture in colours, at its own size; at another it is resized; both stems have it."""
    rng = torch.Generator().manual_seed(2)
    state = transformer(1) | {
        "patch_embed.proj.weight": torch.randn(DIM, 3, size, size, generator=rng),
        "patch_embed.proj.bias": torch.randn(DIM, generator=rng),
    }
    file = StartFile(saved(tmp_path / "v.pth", state))
    assert file.patch_kernel
    config = replace(CONFIG, patch=patch, layers=1, patch_kernel=True)
    normal = replace(PLAIN, spread=np.linspace(0.5, 2, 4).astype(np.float32), whitening=PLAIN.whitening + 0.1)
    start = file.begin(config, BASIS, normal, NAMES)
    pixels = patch // config.token_side
    how = f"({DIM}, 3, {size}, {size}) to ({DIM}, 4, {pixels}, {pixels}), colours to spectral columns by wavelength"
    assert start.report.resized == {"patch_embed.proj.weight": how}
    assert len(start.report.matched) == 12 + 2 + 1
    assert "a kernel of whole patches of colours" not in start.record["skipped"]
    model = Segmenter(config).eval()
    model.load_state_dict(start.state, strict=False)
    columns = torch.randn(2, 4, patch, patch, generator=rng)
    if pixels == size:
        colours = mixed_channels(normal, rgb_response(BASIS))
        picture = torch.einsum("pjyx,jc->pcyx", columns, torch.from_numpy(colours))
        kernel = state["patch_embed.proj.weight"], state["patch_embed.proj.bias"]
        wanted = torch.nn.functional.conv2d(picture, *kernel, stride=size)
        for stem in (model.coarse_stem, model.fine_stem):
            torch.testing.assert_close(stem.embed(columns), wanted, rtol=1e-3, atol=1e-3)
    for stem in (model.coarse_stem, model.fine_stem):
        with_kernel = stem(columns)[1]
        kernel, stem.embed = stem.embed, None
        difference = with_kernel - stem(columns)[1]
        torch.testing.assert_close(difference, kernel(columns).flatten(2).transpose(1, 2), rtol=1e-3, atol=1e-3)


def test_a_patch_kernel_goes_on_in_weights_of_ours(tmp_path: Path, tiny: Maker):
    """Weights with one are taken whole again; those without one have none, and say nothing of it in their file."""
    weights = tiny(patch=16, patch_kernel=True)
    file = _kept(weights, tmp_path / "w.safetensors")
    assert file.patch_kernel
    start = file.begin(weights.config, weights.basis, weights.normalisation, weights.class_names)
    assert (start.report.missing, start.report.skipped) == ([], {})
    plain = tiny()
    assert not _kept(plain, tmp_path / "p.safetensors").patch_kernel
    assert "patch_kernel" not in plain.config.as_dict()


def test_a_segmenter_says_in_its_variant_how_many_heads_it_has(tmp_path: Path):
    """Its encoder is taken, its decoder is not; without variant.yml it is refused."""
    state = {f"encoder.{name}": value for name, value in transformer().items()}
    path = saved(tmp_path / "checkpoint.pth", {"model": state | {"decoder.cls_emb": torch.zeros(1, 150, DIM)}})
    with pytest.raises(WeightsError, match=r"no variant\.yml beside"):
        _ = StartFile(path).sizes
    (tmp_path / "variant.yml").write_text(VARIANT)
    file = StartFile(path)
    assert (file.kind, file.sizes) == ("Segmenter", TokenSizes(DIM, 4, 4, 3))
    start = file.begin(replace(CONFIG, heads=4), BASIS, PLAIN, NAMES)
    assert start.record["matched"] == 26
    assert start.record["skipped"]["a decoder for its own classes"] == ["decoder.cls_emb"]


@pytest.mark.parametrize("sizes", [(64, 2, 4), (DIM, 4, 4), (DIM, 2, 3)])
def test_tokens_of_other_sizes_are_refused_with_what_to_pass(tmp_path: Path, sizes: tuple[int, int, int]):
    """Width, heads and MLP have to be the file's, the number of layers need not."""
    file = StartFile(saved(tmp_path / "v.pth", transformer()))
    file.check(TokenSizes(DIM, 2, 4, 1))
    with pytest.raises(SettingsError, match=r"pass --dim 128 --heads 2 --mlp-ratio 4 \(and --layers 3 to take all"):
        file.check(TokenSizes(*sizes, 3))


def test_files_of_no_known_kind_are_refused(tmp_path: Path):
    """Nothing that fits is an error that names what was found; so is a file that is not there."""
    with pytest.raises(WeightsError, match=r"none of 1 tensors of .*v\.pth has a place .*features\.0\.weight \(2, 2\)"):
        StartFile(saved(tmp_path / "v.pth", {"features.0.weight": torch.zeros(2, 2)}))
    with pytest.raises(SettingsError, match=r"no file .*none\.pth; --init takes a vision transformer"):
        StartFile(tmp_path / "none.pth")
    (tmp_path / "cut.safetensors").write_bytes(b"1234")
    with pytest.raises(WeightsError, match=r"cut\.safetensors is damaged"):
        StartFile(tmp_path / "cut.safetensors")
    broken = {name: torch.full_like(value, torch.nan) for name, value in transformer().items()}
    with pytest.raises(WeightsError, match="values that are not finite"):
        StartFile(saved(tmp_path / "nan.pth", broken)).begin(CONFIG, BASIS, PLAIN, NAMES)


def _kept(weights: Weights, path: Path) -> StartFile:
    save_weights(weights, path)
    return StartFile(path)


def test_earlier_weights_of_the_same_data_are_taken_whole(tmp_path: Path, tiny: Maker):
    """Every tensor of the segmenter is copied exactly, the scorer's included, and nothing is missing."""
    weights = tiny(1)
    file = _kept(with_record(weights, licence="non-commercial"), tmp_path / "w.safetensors")
    assert file.kind == "spectralzoom"
    assert file.sizes == TokenSizes(16, 2, 3, 1)
    start = file.begin(weights.config, weights.basis, weights.normalisation, weights.class_names)
    assert (start.report.missing, start.report.skipped, start.report.resized) == ([], {}, {})
    for name, value in weights.segmenter.state_dict().items():
        assert torch.equal(start.state[name], value)
    assert start.record["licence"] == "non-commercial"
    assert file.earlier["seed"] == 1


def test_other_classes_leave_their_heads_fresh(tmp_path: Path, tiny: Maker):
    """Same number or not: what tells classes apart, and the scorer that reads it, begin anew."""
    weights = tiny(2)
    file = _kept(weights, tmp_path / "w.safetensors")
    for names in (("a", "b", "c"), ("a", "b")):
        config = replace(weights.config, classes=len(names))
        start = file.begin(config, weights.basis, weights.normalisation, names)
        fresh = {name.split(".")[0] for name in start.report.missing}
        assert fresh == {"coarse_classes", "fine_classes", "scorer"}
        assert set(start.report.skipped.values()) == {"other classes"}
        assert not any(name.split(".")[0] in fresh for name in start.state)


def test_other_columns_are_reached_by_wavelength(tmp_path: Path, tiny: Maker):
    """First kernels are brought to the new number of columns and are no larger; the report says so."""
    weights = tiny(3)
    file = _kept(weights, tmp_path / "w.safetensors")
    new = Normalisation(np.full(7, 0.3, np.float32), np.full(7, 0.1, np.float32), 3 * np.eye(7, dtype=np.float32))
    config = replace(weights.config, columns=7)
    start = file.begin(config, SpectralBasis(450.0, 900.0, 7), new, weights.class_names)
    assert start.report.resized == {
        f"{stem}_stem.enter.weight": "4 to 7 spectral columns by wavelength" for stem in ("coarse", "fine")
    }
    assert start.report.missing == []
    for stem in ("coarse", "fine"):
        before = weights.segmenter.state_dict()[f"{stem}_stem.enter.weight"].flatten(1).norm(dim=1)
        after = start.state[f"{stem}_stem.enter.weight"].flatten(1).norm(dim=1)
        assert (after <= before * (1 + 1e-5)).all()


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
    kernel = "fine_stem.enter.weight"
    before, after = (
        torch.einsum("pc,ocyx->poyx", torch.from_numpy(one.apply(pixels, np.ones(4, np.bool_))), state[kernel])
        for one, state in ((old, weights.segmenter.state_dict()), (new, start.state))
    )
    np.testing.assert_allclose(after.numpy(), before.numpy(), rtol=1e-3, atol=1e-4)

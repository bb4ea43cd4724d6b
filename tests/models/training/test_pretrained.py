"""Other people's weights into our modules: what matched, what was skipped and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from models.network.sizes import VggSizes
from models.policies.vgg import VggFeatures, load_vgg
from models.training.pretrained import load_into
from models.weights.state_files import read_state
from pipeline.errors import WeightsError

NARROW = VggSizes(widths=(4, 6, 8, 10, 10))


class Block(nn.Module):
    """One transformer block, named as timm does."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.attn = nn.ModuleDict({"qkv": nn.Linear(dim, 3 * dim), "proj": nn.Linear(dim, dim)})
        self.mlp = nn.ModuleDict({"fc1": nn.Linear(dim, 4 * dim), "fc2": nn.Linear(4 * dim, dim)})


class Transformer(nn.Module):
    """A vision transformer named as timm does, of any sizes."""

    def __init__(self, dim: int = 8, depth: int = 2, bands: int = 3, patch: int = 4, grid: int = 4) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.randn(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.randn(1, 1 + grid**2, dim))
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(bands, dim, patch, patch)})
        self.blocks = nn.ModuleList(Block(dim) for _ in range(depth))
        self.norm = nn.LayerNorm(dim)


def photographs(seed: int = 0, distilled: bool = False, **sizes: int) -> dict[str, Tensor]:
    """A transformer's file as timm and DeiT lay it out, classifier included."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        state = dict(Transformer(**sizes).state_dict())
    dim = state["cls_token"].shape[-1]
    state |= {"head.weight": torch.zeros(1000, dim), "head.bias": torch.zeros(1000)}
    if distilled:
        state["dist_token"] = torch.ones(1, 1, dim)
        state["pos_embed"] = torch.cat([state["pos_embed"][:, :1], torch.ones(1, 1, dim), state["pos_embed"][:, 1:]], 1)
        state |= {"head_dist.weight": torch.zeros(1000, dim)}
    return state


def test_a_transformer_of_the_same_sizes_is_taken_whole():
    """Every tensor but the classifier matches and is copied exactly."""
    state, module = photographs(), Transformer()
    report = load_into(module, state)
    assert (len(report.matched), report.resized, report.missing) == (len(state) - 2, {}, [])
    assert report.skipped == dict.fromkeys(["head.weight", "head.bias"], "a classifier of photographs")
    assert str(report) == f"{len(state) - 2} tensors matched, 0 resized, 2 skipped (a classifier of photographs)"
    for name, value in module.state_dict().items():
        assert torch.equal(value, state[name])


def test_distilled_transformers_lose_their_extra_token():
    """DeiT's distillation token has no place; a code of its own for each place fits no other number of them."""
    state, module = photographs(distilled=True), Transformer()
    report = load_into(module, state)
    assert report.skipped["dist_token"] == "a token of the whole image"
    assert report.skipped["pos_embed"] == "(1, 18, 8) does not fit (1, 17, 8)"
    assert report.missing == ["pos_embed"]
    assert torch.equal(module.cls_token, state["cls_token"])


def test_a_segmenter_checkpoint_gives_its_encoder():
    """Names below ``encoder.`` are the transformer's; the decoder for its own classes is skipped."""
    state = {f"encoder.{name}": value for name, value in photographs().items()}
    state |= {"decoder.cls_emb": torch.zeros(1, 150, 8), "decoder.proj_patch": torch.zeros(8, 8)}
    report = load_into(Transformer(), state)
    assert len(report.matched) == len(state) - 4
    assert report.skipped["decoder.proj_patch"] == "a decoder for its own classes"


def test_deeper_or_wider_files_give_what_fits():
    """Blocks beyond ours have no place; tensors of another width are skipped with both shapes."""
    report = load_into(Transformer(depth=1), photographs(depth=3))
    assert {name.split(".")[1] for name in report.skipped if name.startswith("blocks")} == {"1", "2"}
    state = photographs()
    state["blocks.0.mlp.fc1.weight"] = torch.zeros(16, 8)
    report = load_into(module := Transformer(), state)
    assert report.skipped["blocks.0.mlp.fc1.weight"] == "(16, 8) does not fit (32, 8)"
    assert report.missing == ["blocks.0.mlp.fc1.weight"]
    assert torch.equal(module.norm.weight, state["norm.weight"])


def test_names_may_be_others_in_the_module():
    """A table of beginnings, numbers carried over, says what a tensor is called here; whole words only."""
    module = nn.ModuleDict({"layers": nn.ModuleList(nn.ModuleDict({"mix": nn.Linear(8, 24)}) for _ in range(2))})
    state = photographs()
    report = load_into(module, state, names={"blocks.*.attn.qkv": "layers.*.mix", "blocks.*.attn.q": "layers.*.no"})
    assert len(report.matched) == 4
    assert torch.equal(module.state_dict()["layers.1.mix.weight"], state["blocks.1.attn.qkv.weight"])


def test_nothing_that_fits_is_an_error_and_changes_nothing():
    """The message names what was found; values that are not finite count as not fitting."""
    module = Transformer(dim=16)
    before = {name: value.clone() for name, value in module.state_dict().items()}
    with pytest.raises(WeightsError, match=r"none of 32 tensors fits the network: found cls_token \(1, 1, 8\)"):
        load_into(module, photographs())
    with pytest.raises(WeightsError, match="values that are not finite"):
        load_into(module, {"norm.weight": torch.full((16,), np.nan)})
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items())


def test_vgg_is_read_from_torch_files_and_safetensors(tmp_path):
    """Both give the same network, frozen, and the classifier is reported as skipped."""
    from safetensors.torch import save_file

    state = VggFeatures(NARROW).state_dict() | {"classifier.0.weight": torch.zeros(3, 3)}
    torch.save(state, tmp_path / "vgg.pth")
    save_file(state, tmp_path / "vgg.safetensors")
    for name in ("vgg.pth", "vgg.safetensors"):
        network, report = load_vgg(tmp_path / name, NARROW)
        assert (len(report.matched), list(report.skipped)) == (32, ["classifier.0.weight"])
        assert not any(value.requires_grad for value in network.parameters())
        assert all(torch.equal(value, state[key]) for key, value in network.state_dict().items())


def test_another_network_is_no_vgg19(tmp_path):
    """VGG16's file lacks convolutions, batch normalisation moves them, a transformer has none: each is refused."""
    sixteen = VggFeatures(VggSizes((2, 2, 3, 3, 3), NARROW.widths)).state_dict()
    torch.save(sixteen, tmp_path / "vgg16.pth")
    with pytest.raises(WeightsError, match=r"vgg16.pth lacks \d+ of 32 tensors of VGG19's convolutions"):
        load_vgg(tmp_path / "vgg16.pth", NARROW)
    torch.save(photographs(), tmp_path / "vit.pth")
    with pytest.raises(WeightsError, match="none of 32 tensors fits"):
        load_vgg(tmp_path / "vit.pth", NARROW)
    assert read_state(tmp_path / "vit.pth").keys() == photographs().keys()


def test_a_trained_vgg_may_read_other_channels(tmp_path):
    """As many as its first convolution has, at the wavelengths that its file names; one of photographs has three."""
    sizes = replace(NARROW, channels=5)
    state = VggFeatures(sizes).state_dict()
    torch.save(state, tmp_path / "five.pth")
    network, report = load_vgg(tmp_path / "five.pth", NARROW, trained=True)
    assert (network.sizes, network.wavelength_nm, len(report.matched)) == (sizes, None, 32)
    with pytest.raises(WeightsError, match=r"five\.pth reads 5 channels.* 3; .* is for the policy vgg-trained"):
        load_vgg(tmp_path / "five.pth", NARROW)
    bare = {name.removeprefix("features."): value for name, value in state.items()}
    torch.save(bare | {"wavelength_nm": torch.linspace(500, 900, 5)}, tmp_path / "named.pth")
    network, report = load_vgg(tmp_path / "named.pth", NARROW, trained=True)
    assert network.wavelength_nm == (500.0, 600.0, 700.0, 800.0, 900.0)
    assert report.skipped == {}


@pytest.mark.parametrize("named", [torch.ones(4), torch.tensor([0.5] * 5), torch.full((5,), np.nan), torch.tensor(3.0)])
def test_wavelengths_that_do_not_belong_to_the_channels_are_refused(tmp_path, named: Tensor):
    """Another number of them, micrometres, or none at all: the message names file and tensor."""
    state = VggFeatures(replace(NARROW, channels=5)).state_dict()
    torch.save(state | {"wavelength_nm": named}, tmp_path / "v.pth")
    with pytest.raises(WeightsError, match=r"v\.pth, tensor 'wavelength_nm': .*wavelength"):
        load_vgg(tmp_path / "v.pth", NARROW, trained=True)


@pytest.mark.parametrize("channels", [1, 4])
def test_a_mixing_convolution_of_other_channels_is_no_vgg19(tmp_path, channels: int):
    """The normalised variant begins with three colours; anything else there is refused, whoever trained it."""
    state = {"0.weight": torch.ones(3, channels, 1, 1), "0.bias": torch.ones(3)}
    for number, place in enumerate(NARROW.places):
        layer = VggFeatures(NARROW).features[place]
        state |= {f"{3 * number + 2}.weight": layer.weight, f"{3 * number + 2}.bias": layer.bias}
    torch.save(state, tmp_path / "v.pth")
    with pytest.raises(WeightsError, match=r"v\.pth (is no VGG19|lacks \d+ of 32)"):
        load_vgg(tmp_path / "v.pth", NARROW, trained=True)

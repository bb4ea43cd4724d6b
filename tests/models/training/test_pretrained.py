"""Other people's weights into our modules: what matched, what was skipped and why, kernels fitted to other bands."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor, nn

from models.network.spectral import SpectralBasis
from models.training.pretrained import load_into, map_rgb_kernel, resize_patch_kernel, rgb_response
from pipeline.errors import WeightsError
from tests.models.conftest import noise


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


def test_nothing_that_fits_is_an_error_and_changes_nothing():
    """The message names what was found; values that are not finite count as not fitting."""
    module = Transformer(dim=16)
    before = {name: value.clone() for name, value in module.state_dict().items()}
    with pytest.raises(WeightsError, match=r"none of 32 tensors fits the network: found cls_token \(1, 1, 8\)"):
        load_into(module, photographs())
    with pytest.raises(WeightsError, match="values that are not finite"):
        load_into(module, {"norm.weight": torch.full((16,), np.nan)})
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items())


def test_colours_look_at_their_wavelengths():
    """Each colour weighs most the column nearest to it, and the weights of a colour sum to 1."""
    response = rgb_response(SpectralBasis(400.0, 1000.0, 25))  # a column every 25 nm
    assert response.argmax(axis=1).tolist() == [10, 6, 2]
    assert response.sum(axis=1) == pytest.approx([1, 1, 1])


def test_a_mapped_kernel_sees_what_the_old_one_saw_of_the_mixed_colours():
    """Mixing columns to colours first and mapping the kernel are the same; grey stays grey."""
    response = rgb_response(SpectralBasis(400.0, 1000.0, 12))
    kernel, columns = noise(0, 5, 3, 3, 3), noise(1, 1, 12, 9, 9)
    mapped = map_rgb_kernel(kernel, response)
    colours = torch.einsum("bjyx,cj->bcyx", columns, torch.from_numpy(response))
    torch.testing.assert_close(F.conv2d(columns, mapped), F.conv2d(colours, kernel), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(mapped.sum(dim=1), kernel.sum(dim=1), rtol=1e-4, atol=1e-5)


def test_a_larger_patch_kernel_answers_enlarged_patches_alike():
    """The pseudo-inverse of bilinear enlarging: the answer to the enlarged patch is the old one."""
    kernel, patch = noise(2, 6, 3, 8, 8), noise(3, 1, 3, 8, 8)
    larger = F.interpolate(patch, size=(16, 16), mode="bilinear", align_corners=False)
    answer = F.conv2d(larger, resize_patch_kernel(kernel, (16, 16)))
    torch.testing.assert_close(answer, F.conv2d(patch, kernel), rtol=1e-3, atol=1e-3)
    assert resize_patch_kernel(kernel, (4, 4)).shape == (6, 3, 4, 4)

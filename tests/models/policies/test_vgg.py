"""VGG19: names, sizes, gradients, a ring without borders, files, and its saliency as a policy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from models.network import sizes
from models.network.sizes import VggSizes, saliency_multiply_adds
from models.policies.policies import score_patches
from models.policies.vgg import (
    PHOTO_MEAN,
    PHOTO_STD,
    VggFeatures,
    VggSaliency,
    channels_of,
    colours_of,
    common_names,
    input_gradient,
    load_vgg,
)
from models.policies.vgg_file import VggFile
from models.reading.inference import CoarsePass, CoarsePrediction
from models.training.pretrained import rgb_response
from models.weights.state_files import read_state
from pipeline.errors import SettingsError, WeightsError
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import Maker, noise

NARROW = VggSizes(widths=(4, 6, 8, 10, 10))
TRANSFORMER = {"cls_token": torch.zeros(1, 1, 8), "blocks.0.attn.qkv.weight": torch.zeros(24, 8)}


def narrow(seed: int = 0, sizes: VggSizes = NARROW) -> VggFeatures:
    """A narrow stack whose activations neither die nor explode."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = VggFeatures(sizes).eval().requires_grad_(False)
        for name, value in network.named_parameters():
            if name.endswith("weight"):
                torch.nn.init.kaiming_normal_(value)
            else:
                torch.nn.init.uniform_(value, 0.0, 0.3)
    return network


@pytest.fixture
def saliency(tiny: Maker) -> VggSaliency:
    """A narrow network on the columns of small weights."""
    return VggSaliency(narrow(), colours_of(tiny()))


def drawn(seed: int, *shape: int) -> NDArray[np.float32]:
    """Seeded normal columns."""
    return noise(seed, *shape).numpy()


def coarse_pass(columns: NDArray[np.float32], patch: int = 8, factor: int = 2) -> CoarsePrediction:
    """A scene just as large as its padded coarse grid."""
    y, x = columns.shape[:2]
    grid = SceneGrid(y * factor, x * factor, patch, factor)
    return CoarsePrediction(grid, columns, np.empty((0, 0, 0), np.float32))


def test_colours_are_those_of_the_scene(tiny: Maker):
    """Undoing the normalisation and mixing by wavelength gives the same colours, brought to one scale."""
    weights = tiny()
    scene = np.random.default_rng(3).uniform(0, 1, (20, 4)).astype(np.float32)
    response, normal = rgb_response(weights.basis), weights.normalisation
    wanted = (scene - normal.centre) @ response.T / (response @ normal.spread)
    found = normal.apply(scene, np.ones(4, np.bool_)) @ colours_of(weights)
    assert found == pytest.approx(wanted, abs=1e-4)


@pytest.mark.parametrize("size", [(16, 24), (37, 53), (4, 4)])
def test_a_flat_scene_scores_alike_everywhere(saliency: VggSaliency, size: tuple[int, int]):
    """Nothing to see anywhere, borders included: every patch is worth its fraction of the scene."""
    grid = SceneGrid(*size, 8, 2)
    y, x = (side // 2 for side in grid.padded_shape)
    seen = CoarsePrediction(grid, np.full((y, x, 4), 0.4, np.float32), np.empty((0, 0, 0), np.float32))
    scores = score_patches("vgg-static", seen, network=saliency)
    fraction = grid.valid_fraction().ravel()
    assert scores == pytest.approx(scores.max() / fraction.max() * fraction, rel=1e-3)
    assert scores.max() > 0


def test_a_moved_scene_has_moved_scores(saliency: VggSaliency):
    """Away from borders what stands out is found wherever it lies: by whole places of the last level."""
    here, there = (np.zeros((256, 256, 4), np.float32) for _ in range(2))
    detail = drawn(1, 24, 24, 4)
    here[112:136, 112:136] = detail
    there[128:152, 96:120] = detail
    before, after = saliency(coarse_pass(here)), saliency(coarse_pass(there))
    assert after[96:184, 64:152] == pytest.approx(before[80:168, 80:168], rel=1e-3, abs=1e-4 * before.max())


def test_the_score_is_the_greatest_on_the_scene():
    """A patch takes its greatest coarse pixel; what lies off the scene does not count, and a fraction is worth a fraction."""
    grid = SceneGrid(12, 16, 8, 2)
    y, x = (side // 2 for side in grid.padded_shape)
    seen = CoarsePrediction(grid, np.zeros((y, x, 4), np.float32), np.empty((0, 0, 0), np.float32))
    pixels = np.zeros((y, x))
    pixels[1, 2], pixels[5, 6], pixels[6:, :] = 5.0, 3.0, 99.0
    scores = score_patches("vgg-static", seen, network=lambda _: pixels)
    assert scores.reshape(grid.patch_shape)[:2, :2].tolist() == [[5.0, 0.0], [0.0, 1.5]]


def test_blocks_join(monkeypatch: pytest.MonkeyPatch):
    """Where all that bears on a pixel lies within a block's surroundings, reading in blocks changes nothing."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        shallow = VggFeatures(VggSizes((1, 1, 1), (4, 6, 8))).eval().requires_grad_(False)
    saliency = VggSaliency(shallow, np.eye(4, 3, dtype=np.float32))
    seen = coarse_pass(drawn(5, 96, 160, 4))
    whole = saliency(seen)
    monkeypatch.setattr(sizes, "BLOCK_PX", 64)
    parts = saliency(seen)
    inside = np.s_[28:-28, 28:-28]  # the ends of the scene are joined to each other
    assert parts[inside] == pytest.approx(whole[inside], rel=1e-4, abs=1e-6)
    assert (parts > 0).mean() > 0.9


def trained(channels: int, wavelength_nm: tuple[float, ...] | None = None) -> VggFeatures:
    """A narrow network that reads some channels, as one that learned from data of one's own."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(4)
        sizes = replace(NARROW, channels=channels)
        return VggFeatures(sizes, wavelength_nm).eval().requires_grad_(False)


@pytest.mark.parametrize("network", [trained(3), trained(4), trained(2, (500.0, 900.0)), trained(1, (650.0,))])
def test_channels_of_a_trained_network_are_brought_to_one_scale(tiny: Maker, network: VggFeatures):
    """Whatever they are, the training median becomes 0 and one spread more of every column 1."""
    weights = tiny()
    normal, count = weights.normalisation, network.sizes.channels
    pixels = np.stack([normal.centre, normal.centre + normal.spread])
    found = normal.apply(pixels, np.ones(4, np.bool_)) @ channels_of(weights, network)
    assert found == pytest.approx(np.repeat([[0.0], [1.0]], count, axis=1), abs=1e-4)


def test_which_channels_a_trained_network_reads(tiny: Maker):
    """Three are colours, as many as there are columns those in their order, named ones lie where they are named."""
    weights = tiny()
    normal = weights.normalisation
    scene = np.random.default_rng(5).uniform(0, 1, (20, 4)).astype(np.float32)
    columns = normal.apply(scene, np.ones(4, np.bool_))
    assert (channels_of(weights, trained(3)) == colours_of(weights)).all()
    own = columns @ channels_of(weights, trained(4))
    assert own == pytest.approx((scene - normal.centre) / normal.spread, abs=1e-4)
    named = channels_of(weights, trained(3, (450.0, 550.0, 650.0)))  # the other way round than red, green, blue
    assert named == pytest.approx(colours_of(weights)[:, ::-1], abs=1e-6)


def test_a_network_that_is_missing_is_asked_for(tmp_path, tiny: Maker):
    """The policy names its flag, a missing file what could stand there, a changed one that it changed."""
    seen: CoarsePass = coarse_pass(drawn(0, 8, 8, 4))
    with pytest.raises(SettingsError, match="needs --vgg FILE"):
        score_patches("vgg-static", seen)  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match=r"no file .*none\.pth; --vgg takes the weights of VGG19: torchvision"):
        VggFile.found(tmp_path / "none.pth")
    with pytest.raises(SettingsError, match=r"no file .*none\.pth; --vgg takes VGG19 trained on data of your own"):
        VggFile.found(tmp_path / "none.pth", trained=True)
    (tmp_path / "other.pth").write_bytes(b"no weights")
    with pytest.raises(WeightsError, match=r"other\.pth"):
        VggFile.found(tmp_path / "other.pth").saliency(tiny())


def test_vgg_is_read_from_torch_files_and_safetensors(tmp_path):
    """Both give the same network, frozen, and the classifier is reported as skipped."""
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
    torch.save(TRANSFORMER, tmp_path / "vit.pth")
    with pytest.raises(WeightsError, match="none of 2 tensors fits"):
        load_vgg(tmp_path / "vit.pth", NARROW)
    assert read_state(tmp_path / "vit.pth").keys() == TRANSFORMER.keys()


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


def test_it_computes_what_the_layers_say():
    """Away from borders the stack is convolutions, activations and 2 x 2 maxima, computed one after the other."""
    network, picture = narrow(), noise(1, 1, 3, 48, 32)
    x, places = picture, iter(NARROW.places)
    for level, depth in enumerate(NARROW.depths):
        x = F.max_pool2d(x, 2) if level else x
        for _ in range(depth):
            layer = network.features[next(places)]
            x = F.relu(F.conv2d(F.pad(x, (1, 1, 1, 1), mode="circular"), layer.weight, layer.bias))
    torch.testing.assert_close(network(picture), x)


def test_the_gradient_is_that_of_finite_differences():
    """In double precision the input gradient agrees with differences of the summed activation."""
    network, picture = narrow(3).double(), noise(2, 1, 3, 16, 16).double()
    gradient = input_gradient(network, picture)
    step = 1e-6
    for channel, y, x in ((0, 0, 0), (1, 7, 9), (2, 15, 15), (0, 8, 0)):
        moved = torch.zeros_like(picture)
        moved[0, channel, y, x] = step
        difference = (network(picture + moved).sum() - network(picture - moved).sum()) / (2 * step)
        assert float(gradient[0, channel, y, x]) == pytest.approx(float(difference), rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("channels", [1, 3, 24])
def test_multiply_adds_are_those_torch_counts(channels: int):
    """The closed form counts forward and input gradient, blocks with their surroundings and closing included."""
    sizes = VggSizes(channels=channels)
    with torch.device("meta"):
        network = VggFeatures(sizes).requires_grad_(False)
        picture = torch.zeros(1, channels, 64, 80, requires_grad=True)
        with FlopCounterMode(display=False) as counter:
            network(picture).sum().backward()
    assert counter.get_total_flops() / 2 == 2 * sizes.forward_multiply_adds * 64 * 80
    assert saliency_multiply_adds((32, 48), 7, channels) == counter.get_total_flops() / 2 + channels * 7 * 32 * 48


def normalised_variant(network: VggFeatures) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """The same network as a file that counts padding layers and begins with a 1 x 1 convolution, and that one's own."""
    mix, shift = noise(7, 3, 3, 1, 1) + 2 * torch.eye(3)[:, :, None, None], noise(8, 3)
    state, number = {"0.weight": mix, "0.bias": shift}, 0
    for level, depth in enumerate(network.sizes.depths):
        number += 1 if level else 0  # the pool
        for _ in range(depth):
            place = network.sizes.places[(len(state) - 2) // 2]
            number += 2  # activation of the one before (or the 1 x 1), padding
            state |= {f"{number}.{part}": getattr(network.features[place], part) for part in ("weight", "bias")}
            number += 1
    return state, mix, shift


def test_the_normalised_variant_is_joined():
    """Its 1 x 1 convolution on colours 0..1 is taken into the first kernel, the others are renamed."""
    inner = narrow(6)
    state, mix, shift = normalised_variant(inner)
    assert [name for name in state if name.endswith("weight")][1:4] == ["2.weight", "5.weight", "9.weight"]
    named = common_names(state, NARROW)
    joined = VggFeatures(NARROW).eval()
    joined.load_state_dict(named)
    picture = noise(9, 1, 3, 32, 32)
    colours = picture * torch.tensor(PHOTO_STD)[:, None, None] + torch.tensor(PHOTO_MEAN)[:, None, None]
    torch.testing.assert_close(joined(picture), inner(F.conv2d(colours, mix, shift)), rtol=1e-3, atol=1e-4)

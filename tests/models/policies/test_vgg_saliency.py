"""Saliency by VGG19 as a policy: colours by wavelength, the brightness rule, blocks, pooling to seats."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from models.network import sizes
from models.network.sizes import VggSizes
from models.policies.policies import score_seats
from models.policies.vgg import VggFeatures, VggSaliency, channels_of, close_ring, colours_of
from models.policies.vgg_file import VggFile
from models.reading.inference import CoarseLook, Glance
from models.training.pretrained import rgb_response
from models.weights.files import Weights
from pipeline.errors import SettingsError, WeightsError
from pipeline.geometry.grid import SceneGrid


@pytest.fixture
def saliency(tiny: Callable[..., Weights]) -> VggSaliency:
    """A narrow network on the columns of small weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = VggFeatures(VggSizes(widths=(4, 6, 8, 10, 10))).eval().requires_grad_(False)
        for value in network.parameters():
            if value.dim() == 4:
                torch.nn.init.kaiming_normal_(value)
    return VggSaliency(network, colours_of(tiny()))


def look(columns: NDArray[np.float32], patch: int = 8, factor: int = 2) -> Glance:
    """A scene just as large as its padded coarse grid."""
    y, x = columns.shape[:2]
    grid = SceneGrid(y * factor, x * factor, patch, factor)
    return Glance(grid, columns, np.empty((0, 0, 0), np.float32))


def noise(seed: int, *shape: int) -> NDArray[np.float32]:
    """Seeded normal columns."""
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def test_training_median_and_spread_become_those_of_photographs(tiny: Callable[..., Weights]):
    """The median pixel is 0, the mean of photographs; one spread more of every column is 1 in each colour."""
    weights = tiny()
    normal, wavelength = weights.normalisation, np.linspace(400.0, 1000.0, 4)
    pixels = np.stack([normal.centre, normal.centre + normal.spread, normal.centre - 2 * normal.spread])
    columns = normal.apply(pixels, np.ones(4, np.bool_))
    assert len(wavelength) == weights.basis.columns
    assert columns @ colours_of(weights) == pytest.approx(np.repeat([[0.0], [1.0], [-2.0]], 3, axis=1), abs=1e-4)


def test_colours_are_those_of_the_scene(tiny: Callable[..., Weights]):
    """Undoing the normalisation and mixing by wavelength gives the same colours, brought to one scale."""
    weights = tiny()
    scene = np.random.default_rng(3).uniform(0, 1, (20, 4)).astype(np.float32)
    response, normal = rgb_response(weights.basis), weights.normalisation
    wanted = (scene - normal.centre) @ response.T / (response @ normal.spread)
    found = normal.apply(scene, np.ones(4, np.bool_)) @ colours_of(weights)
    assert found == pytest.approx(wanted, abs=1e-4)


@pytest.mark.parametrize("size", [(16, 24), (37, 53), (4, 4)])
def test_a_flat_scene_scores_alike_everywhere(saliency: VggSaliency, size: tuple[int, int]):
    """Nothing to see anywhere, borders included: every seat is worth its share of the scene."""
    grid = SceneGrid(*size, 8, 2)
    y, x = (side // 2 for side in grid.padded_shape)
    seen = Glance(grid, np.full((y, x, 4), 0.4, np.float32), np.empty((0, 0, 0), np.float32))
    scores = score_seats("vgg-static", seen, network=saliency)
    share = grid.valid_share().ravel()
    assert scores == pytest.approx(scores.max() / share.max() * share, rel=1e-3)
    assert scores.max() > 0


def test_a_moved_scene_has_moved_scores(saliency: VggSaliency):
    """Away from borders what stands out is found wherever it lies: by whole places of the last level."""
    here, there = (np.zeros((256, 256, 4), np.float32) for _ in range(2))
    detail = noise(1, 24, 24, 4)
    here[112:136, 112:136] = detail
    there[128:152, 96:120] = detail
    before, after = saliency(look(here)), saliency(look(there))
    assert after[96:184, 64:152] == pytest.approx(before[80:168, 80:168], rel=1e-3, abs=1e-4 * before.max())


def test_detail_is_found(saliency: VggSaliency):
    """A textured part of a flat scene scores above the parts without any."""
    columns = np.zeros((64, 96, 4), np.float32)
    columns[16:32, 64:80] = noise(2, 16, 16, 4)
    scores = score_seats("vgg-static", look(columns), network=saliency).reshape(16, 24)
    assert np.median(scores[4:8, 16:20]) > 2 * np.median(scores[:, :8])


def test_the_score_is_the_greatest_on_the_scene():
    """A seat takes its greatest coarse pixel; what lies off the scene does not count, and a share is worth a share."""
    grid = SceneGrid(12, 16, 8, 2)
    y, x = (side // 2 for side in grid.padded_shape)
    seen = Glance(grid, np.zeros((y, x, 4), np.float32), np.empty((0, 0, 0), np.float32))
    pixels = np.zeros((y, x))
    pixels[1, 2], pixels[5, 6], pixels[6:, :] = 5.0, 3.0, 99.0
    scores = score_seats("vgg-static", seen, network=lambda _: pixels)
    assert scores.reshape(grid.seat_shape)[:2, :2].tolist() == [[5.0, 0.0], [0.0, 1.5]]


def test_blocks_join(monkeypatch: pytest.MonkeyPatch):
    """Where all that bears on a pixel lies within a block's surroundings, reading in blocks changes nothing."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        shallow = VggFeatures(VggSizes((1, 1, 1), (4, 6, 8))).eval().requires_grad_(False)
    saliency = VggSaliency(shallow, np.eye(4, 3, dtype=np.float32))
    seen = look(noise(5, 96, 160, 4))
    whole = saliency(seen)
    monkeypatch.setattr(sizes, "BLOCK_PX", 64)
    parts = saliency(seen)
    inside = np.s_[28:-28, 28:-28]  # the ends of the scene are joined to each other
    assert parts[inside] == pytest.approx(whole[inside], rel=1e-4, abs=1e-6)
    assert (parts > 0).mean() > 0.9


@pytest.mark.parametrize(("count", "size"), [(1, 48), (5, 48), (40, 80), (100, 144)])
def test_a_ring_has_no_step(count: int, size: int):
    """The lengthened axis keeps its pixels and closes with steps no larger than those it has, up to the fading."""
    ramp = np.linspace(0, 1, count, dtype=np.float32)[:, None]
    ring = close_ring(ramp, size)
    assert ring.shape == (size, 1)
    assert (ring[:count] == ramp).all()
    steps = np.abs(np.diff(np.concatenate([ring, ring[:1]]), axis=0))
    assert steps.max() <= 2 / max(count - 1, 1) + 2 / (size - count + 1)


def test_the_gradient_is_at_hand_inside_inference_mode(saliency: VggSaliency):
    """A caller that reads the glance without gradients gets the same saliency."""
    seen = look(noise(6, 16, 16, 4))
    with torch.inference_mode():
        inside = saliency(seen)
    assert (inside == saliency(seen)).all()


def trained(channels: int, wavelength_nm: tuple[float, ...] | None = None) -> VggFeatures:
    """A narrow network that reads some channels, as one that learned from data of one's own."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(4)
        sizes = VggSizes(widths=(4, 6, 8, 10, 10), channels=channels)
        return VggFeatures(sizes, wavelength_nm).eval().requires_grad_(False)


@pytest.mark.parametrize("network", [trained(3), trained(4), trained(2, (500.0, 900.0)), trained(1, (650.0,))])
def test_channels_of_a_trained_network_are_brought_to_one_scale(tiny: Callable[..., Weights], network: VggFeatures):
    """Whatever they are, the training median becomes 0 and one spread more of every column 1."""
    weights = tiny()
    normal, count = weights.normalisation, network.sizes.channels
    pixels = np.stack([normal.centre, normal.centre + normal.spread])
    found = normal.apply(pixels, np.ones(4, np.bool_)) @ channels_of(weights, network)
    assert found == pytest.approx(np.repeat([[0.0], [1.0]], count, axis=1), abs=1e-4)


def test_which_channels_a_trained_network_reads(tiny: Callable[..., Weights]):
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


def test_channels_that_the_weights_do_not_have_are_refused(tiny: Callable[..., Weights]):
    """The message says what came, what would do, and how wavelengths are named."""
    with pytest.raises(WeightsError, match=r"reads 5 channels without saying which.* have 4 .* tensor 'wavelength_nm'"):
        channels_of(tiny(), trained(5))
    with pytest.raises(WeightsError, match=r"a channel .* is at 1650 nm, the segmenter's weights are for 400-1000 nm"):
        channels_of(tiny(), trained(2, (500.0, 1650.0)))


def test_a_trained_network_finds_detail_in_its_channels(tiny: Callable[..., Weights]):
    """The policy vgg-trained scores by all channels that enter, also what colours do not show."""
    weights = tiny()
    saliency = VggSaliency(trained(4), channels_of(weights, trained(4)))
    columns = np.zeros((64, 96, 4), np.float32)
    columns[16:32, 64:80] = noise(2, 16, 16, 4)
    scores = score_seats("vgg-trained", look(columns), network=saliency).reshape(16, 24)
    assert np.median(scores[4:8, 16:20]) > 2 * np.median(scores[:, :8])
    with pytest.raises(SettingsError, match="'vgg-trained' needs --vgg FILE"):
        score_seats("vgg-trained", look(columns))


def test_a_network_that_is_missing_is_asked_for(tmp_path, tiny: Callable[..., Weights]):
    """The policy names its flag, a missing file what could stand there, a changed one that it changed."""
    seen: CoarseLook = look(noise(0, 8, 8, 4))
    with pytest.raises(SettingsError, match="needs --vgg FILE"):
        score_seats("vgg-static", seen)  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match=r"no file .*none\.pth; --vgg takes the weights of VGG19: torchvision"):
        VggFile.found(tmp_path / "none.pth")
    with pytest.raises(SettingsError, match=r"no file .*none\.pth; --vgg takes VGG19 trained on data of your own"):
        VggFile.found(tmp_path / "none.pth", trained=True)
    (tmp_path / "other.pth").write_bytes(b"no weights")
    with pytest.raises(WeightsError, match=r"other\.pth"):
        VggFile.found(tmp_path / "other.pth").saliency(tiny())

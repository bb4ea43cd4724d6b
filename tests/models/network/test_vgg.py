"""VGG19's convolutions: names, sizes, gradients, a ring without borders, and the layouts of common files."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from models.network.sizes import AROUND_PX, BLOCK_PX, VggSizes, saliency_multiply_adds, stretches
from models.policies.vgg import PHOTO_MEAN, PHOTO_STD, HalvingMaximum, VggFeatures, common_names, input_gradient

NARROW = VggSizes(widths=(4, 6, 8, 10, 10))


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


def noise(seed: int, *shape: int) -> Tensor:
    """Seeded normal noise."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_names_and_sizes_are_those_of_vgg19():
    """Sixteen convolutions stand where torchvision has them; 20 024 384 numbers in all."""
    sizes = VggSizes()
    assert sizes.places == [0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28, 30, 32, 34]
    with torch.device("meta"):
        state = VggFeatures().state_dict()
    assert set(state) == {f"features.{n}.{part}" for n in sizes.places for part in ("weight", "bias")}
    assert sum(value.numel() for value in state.values()) == 20_024_384
    assert state["features.28.weight"].shape == (512, 512, 3, 3)


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


def test_equal_pixels_share_the_gradient():
    """A flat 2 x 2 window gives each pixel a quarter; otherwise the largest takes all."""
    flat = torch.zeros(1, 1, 2, 2, requires_grad=True)
    HalvingMaximum()(flat).sum().backward()
    assert flat.grad is not None
    assert flat.grad.tolist() == [[[[0.25, 0.25], [0.25, 0.25]]]]
    x = noise(0, 2, 3, 6, 4)
    assert torch.equal(HalvingMaximum()(x), F.max_pool2d(x, 2))


@pytest.mark.parametrize("level", [-1.0, 0.0, 0.7])
def test_a_flat_picture_has_a_flat_gradient(level: float):
    """Neither borders nor the lattice of maxima show where there is nothing to see."""
    gradient = input_gradient(narrow(5), torch.full((1, 3, 48, 32), level))
    spread = (gradient - gradient.mean(dim=(2, 3), keepdim=True)).abs().amax()
    assert float(spread) <= 1e-4 * float(gradient.abs().amax())
    assert float(gradient.abs().amax()) > 0


@pytest.mark.parametrize("shift", [(16, 0), (0, -32), (32, 16)])
def test_a_moved_picture_has_a_moved_gradient(shift: tuple[int, int]):
    """On the ring a shift by places of the last level moves the gradient and changes nothing else."""
    network, picture = narrow(2), noise(4, 1, 3, 64, 48)
    moved = input_gradient(network, picture.roll(shift, (2, 3)))
    torch.testing.assert_close(moved, input_gradient(network, picture).roll(shift, (2, 3)), rtol=1e-4, atol=1e-5)


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


@pytest.mark.parametrize("size", [1, 31, BLOCK_PX, BLOCK_PX + 1, 3 * BLOCK_PX - 5])
def test_blocks_keep_every_pixel_once(size: int):
    """Kept stretches follow each other from end to end, each with its surroundings, whose ends can be joined."""
    parts = list(stretches(size))
    assert max(part.kept_last - part.kept_first for part in parts) < BLOCK_PX + 16
    assert [n for part in parts for n in range(part.kept_first, part.kept_last)] == list(range(size))
    for part in parts:
        assert part.first == max(0, part.kept_first - AROUND_PX)
        assert part.last == min(size, part.kept_last + AROUND_PX)
        assert part.closed(16) % 16 == 0
        assert part.closed(16) >= part.last - part.first + AROUND_PX


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


def test_other_layouts_keep_or_get_their_names():
    """The stack saved without its parent gets it; names of another network come back as they are."""
    network = narrow()
    bare = {name.removeprefix("features."): value for name, value in network.state_dict().items()}
    assert list(common_names(bare, NARROW)) == list(network.state_dict())
    other = {"blocks.0.weight": torch.zeros(2)}
    assert common_names(other, NARROW) is other
    assert common_names({"0.weight": torch.zeros(2)}, NARROW).keys() == {"0.weight"}

"""VGG19's convolutions, with the tensor names of the common files: ``features.N.weight`` and ``features.N.bias``."""

from __future__ import annotations

from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn

from models.network.vgg_sizes import VggSizes

WAVELENGTHS = "wavelength_nm"  # a tensor beside the others that says where the channels of a trained network lie
# of the photographs that VGG learned from: red, green and blue, values 0..1
PHOTO_MEAN, PHOTO_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class HalvingMaximum(nn.Module):
    """The largest of each 2 x 2 pixels. Equal ones share the gradient: else a flat image would show a lattice."""

    def forward(self, x: Tensor) -> Tensor:
        """(image, channel, y, x), even y and x -> (image, channel, y / 2, x / 2)."""
        images, channels, down, across = x.shape
        return x.reshape(images, channels, down // 2, 2, across // 2, 2).amax(dim=(3, 5))


class VggFeatures(nn.Module):
    """The convolution stack up to its last activation.

    The image is a ring both ways, the right border beside the left one. Zeros beyond the border, as in training, are a
    grey of their own and draw a frame; and where the sum over outputs ends, gradients no longer cancel.
    """

    def __init__(self, sizes: VggSizes | None = None, wavelength_nm: tuple[float, ...] | None = None) -> None:
        super().__init__()
        self.sizes, self.wavelength_nm = sizes or VggSizes(), wavelength_nm  # of the channels, where they were named
        layers: list[nn.Module] = []
        for (before, width), depth in zip(
            pairwise((self.sizes.channels, *self.sizes.widths)), self.sizes.depths, strict=True
        ):
            layers += [HalvingMaximum()] if layers else []
            for number in range(depth):
                layers.append(nn.Conv2d(width if number else before, width, 3, padding=1, padding_mode="circular"))
                layers.append(nn.ReLU())
        self.features = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """(image, channel, y, x), photographs in their standard deviations -> (image, width, y, x) of the last level.

        y and x must divide by ``sizes.coarsest``.
        """
        return cast("Tensor", self.features(x))


def common_names(state: dict[str, Tensor], sizes: VggSizes) -> dict[str, Tensor]:
    """Bring other layouts of the same network to the names ``features.N``; what is none of them comes back as it is.

    Known: the stack saved without its parent (``N.weight``), and the normalised variant, which counts a padding layer
    before every convolution and begins with a 1 x 1 convolution from RGB in 0..1 to what the next one reads.
    """
    numbers = sorted({int(name.split(".")[0]) for name in state if name.split(".")[0].isdigit()})
    complete = all(f"{number}.{part}" in state for number in numbers for part in ("weight", "bias"))
    if not numbers or not complete or any(state[f"{number}.weight"].dim() != 4 for number in numbers):
        return state
    if len(numbers) != len(sizes.places) + 1 or state["0.weight"].shape[1:] != (3, 1, 1):
        return {f"features.{name}": value for name, value in state.items()}
    named = _joined(state, numbers[0], numbers[1])
    for place, number in zip(sizes.places[1:], numbers[2:], strict=True):
        named |= {f"features.{place}.{part}": state[f"{number}.{part}"] for part in ("weight", "bias")}
    return named


def _joined(state: dict[str, Tensor], enter: int, first: int) -> dict[str, Tensor]:
    """One convolution out of the 1 x 1 one and the next, reading standard deviations of photographs."""
    mix, shift = state[f"{enter}.weight"][:, :, 0, 0].double(), state[f"{enter}.bias"].double()
    kernel, bias = state[f"{first}.weight"].double(), state[f"{first}.bias"].double()
    mean, std = (torch.tensor(values, dtype=torch.float64) for values in (PHOTO_MEAN, PHOTO_STD))
    return {
        "features.0.weight": torch.einsum("omyx,mc->ocyx", kernel, mix * std).float(),
        "features.0.bias": (bias + kernel.sum(dim=(2, 3)) @ (mix @ mean + shift)).float(),
    }

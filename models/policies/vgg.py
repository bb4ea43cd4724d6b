"""VGG19 and its saliency, the paper's static attention: where the picture moves a network that knows photographs.

The gradient is that of the summed last activation, not of a class score: the files in use hold no classifier, its
classes are none of a field's, and its layers hold the image to 224 px. A sum is also local: parts of a field can be
read apart. It is taken to the channels that enter VGG, absolute, the largest of them.

A network that learned from data of one's own (the paper's trained attention) is read the same way. The paper says
neither how it is trained, a choice of patches passing no gradient, nor how more than three bands enter it. Here the user
trains it on what they like; its channels are what `channels_of` says, each brought to the median 0 and the spread 1 of
the data that the segmenter was trained on.

Tensors have the names of the common files: ``features.N.weight`` and ``features.N.bias``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from models.network.sizes import Stretch, VggSizes, stretches
from models.network.spectral import REACH, checked_wavelengths
from models.reading.inference import CoarsePass
from models.training.pretrained import LoadReport, load_into, mixed_channels, rgb_response, wavelength_response
from models.weights.files import Weights
from models.weights.state_files import read_state
from pipeline.errors import WavelengthError, WeightsError

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
    # one convolution out of the 1 x 1 one and the next, reading standard deviations of photographs
    mix, shift = state["0.weight"][:, :, 0, 0].double(), state["0.bias"].double()
    kernel, bias = (state[f"{numbers[1]}.{part}"].double() for part in ("weight", "bias"))
    mean, std = (torch.tensor(values, dtype=torch.float64) for values in (PHOTO_MEAN, PHOTO_STD))
    named = {
        "features.0.weight": torch.einsum("omyx,mc->ocyx", kernel, mix * std).float(),
        "features.0.bias": (bias + kernel.sum(dim=(2, 3)) @ (mix @ mean + shift)).float(),
    }
    for place, number in zip(sizes.places[1:], numbers[2:], strict=True):
        named |= {f"features.{place}.{part}": state[f"{number}.{part}"] for part in ("weight", "bias")}
    return named


def channels_of(weights: Weights, network: VggFeatures) -> NDArray[np.float32]:
    """Mix normalised columns to the channels that a trained VGG19 reads, (column, channel).

    By the wavelengths that its file names; where it names none, three channels are red, green and blue, and as many as
    the segmenter has columns are those columns in their order. Raises WeightsError for another number of channels and
    no wavelengths, or one that the segmenter's columns do not reach.
    """
    basis, count = weights.basis, network.sizes.channels
    if network.wavelength_nm is not None:
        edge = REACH * basis.spacing_nm
        for nm in network.wavelength_nm:
            if not basis.low_nm - edge <= nm <= basis.high_nm + edge:
                raise WeightsError(
                    f"a channel of the trained VGG19 is at {nm:g} nm, the segmenter's weights are for"
                    f" {basis.low_nm:.0f}-{basis.high_nm:.0f} nm; use weights of both for the same bands"
                )
        return mixed_channels(weights.normalisation, wavelength_response(basis, network.wavelength_nm))
    if count == 3:
        return colours_of(weights)
    if count == basis.columns:
        return mixed_channels(weights.normalisation, np.eye(count, dtype=np.float32))
    raise WeightsError(
        f"the trained VGG19 reads {count} channels without saying which, the segmenter's weights have {basis.columns}"
        f" spectral columns; give 3 (red, green, blue) or {basis.columns}, or add a tensor {WAVELENGTHS!r} to its file"
    )


def colours_of(weights: Weights) -> NDArray[np.float32]:
    """Mix normalised columns to red, green and blue as VGG reads them, (column, 3).

    The median of the training data becomes the mean of VGG's photographs, its spread theirs: one rule for a whole
    field and for every field of these weights, whatever the light of one.
    """
    return mixed_channels(weights.normalisation, rgb_response(weights.basis))


@dataclass(frozen=True)
class VggSaliency:
    """Saliency of each coarse pixel."""

    network: VggFeatures
    colours: NDArray[np.float32]  # (column, channel)

    def __call__(self, seen: CoarsePass) -> NDArray[np.float64]:
        """(y, x) of the padded coarse grid: never of a finer one, which would need what is not captured yet."""
        picture = seen.columns @ self.colours
        drawn = np.empty(picture.shape[:2])
        for rows in stretches(picture.shape[0]):
            for columns in stretches(picture.shape[1]):
                part = picture[rows.first : rows.last, columns.first : columns.last]
                kept = np.s_[rows.kept_first : rows.kept_last, columns.kept_first : columns.kept_last]
                drawn[kept] = self._of_block(part, rows, columns)[rows.kept, columns.kept]
        return drawn

    def _of_block(self, part: NDArray[np.float32], rows: Stretch, columns: Stretch) -> NDArray[np.float32]:
        step = self.network.sizes.coarsest
        ring = close_ring(close_ring(part, rows.closed(step)).swapaxes(0, 1), columns.closed(step)).swapaxes(0, 1)
        gradient = input_gradient(self.network, torch.from_numpy(np.ascontiguousarray(ring.transpose(2, 0, 1)))[None])
        found: NDArray[np.float32] = gradient[0].abs().amax(dim=0).numpy()[: part.shape[0], : part.shape[1]]
        return found


def input_gradient(network: VggFeatures, picture: torch.Tensor) -> torch.Tensor:
    """Gradient of the summed last activation to the picture (image, channel, y, x), of its shape."""
    with torch.inference_mode(mode=False), torch.enable_grad():
        entered = picture.clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(network(entered).sum(), entered)
    return gradient


def close_ring(picture: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Lengthen the first axis to ``size`` so that its end runs into its beginning without a step.

    Beyond the end the picture goes on mirrored, and fades into what lies, mirrored, before its beginning.
    """
    count = len(picture)
    step = np.arange(1, size - count + 1)
    inwards = np.minimum(step, count - 1)
    fade = (step / (size - count + 1)).reshape(-1, *[1] * (picture.ndim - 1))
    tail, head = picture[count - 1 - inwards], picture[inwards[::-1]]
    return np.concatenate([picture, ((1 - fade) * tail + fade * head).astype(np.float32)])


def load_vgg(path: Path, sizes: VggSizes | None = None, *, trained: bool = False) -> tuple[VggFeatures, LoadReport]:
    """Read VGG19's convolutions: torchvision's file, the stack alone, or the normalised variant.

    ``trained`` on data of one's own it may read any number of channels, and a tensor ``wavelength_nm`` in the file, one
    number for each, says where they lie.

    Raises WeightsError as `read_state`, or where a convolution is missing or of another size: another network, such as
    VGG16; or for other channels than photographs have, or wavelengths that do not belong to them.
    """
    sizes = sizes or VggSizes()
    state = read_state(path)
    wavelengths = state.pop(WAVELENGTHS, None) if trained else None
    state = common_names(state, sizes)
    first = state.get("features.0.weight")  # loading refuses a file without it
    channels = 3 if first is None or first.dim() != 4 else int(first.shape[1])
    if channels != 3 and not trained:
        raise WeightsError(
            f"{path} reads {channels} channels, a VGG19 of photographs 3; one trained on such data is for the"
            " policy vgg-trained"
        )
    try:
        named = None if wavelengths is None else checked_wavelengths(wavelengths.double().numpy(), channels).tolist()
    except WavelengthError as error:
        raise WeightsError(f"{path}, tensor {WAVELENGTHS!r}: {error}") from error
    network = VggFeatures(replace(sizes, channels=channels), named and tuple(named))
    try:
        report = load_into(network, state)
    except WeightsError as error:
        raise WeightsError(f"{path} is no VGG19: {error}") from error
    if report.missing:
        raise WeightsError(
            f"{path} lacks {len(report.missing)} of {len(network.state_dict())} tensors of VGG19's convolutions, the"
            f" first {report.missing[0]} ({report}); give VGG19 without batch normalisation"
        )
    return network.requires_grad_(False).eval(), report

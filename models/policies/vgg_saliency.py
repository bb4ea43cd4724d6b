"""Saliency by VGG19, the paper's static attention: where the picture moves a network that knows photographs.

The gradient is that of the summed last activation, not of a class score: the files in use hold no classifier, its
classes are none of a field's, and its layers hold the image to 224 px. A sum is also local: parts of a field can be
read apart. It is taken to the channels that enter VGG, absolute, the largest of them.

A network that learned from data of one's own (the paper's trained attention) is read the same way. The paper says
neither how it is trained, a choice of seats passing no gradient, nor how more than three bands enter it. Here the user
trains it on what they like; its channels are what `channels_of` says, each brought to the median 0 and the spread 1 of
the data that the segmenter was trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from models.network.spectral import REACH
from models.network.vgg import WAVELENGTHS, VggFeatures
from models.network.vgg_sizes import Stretch, stretches
from models.reading.inference import CoarseLook
from models.training.kernel_fits import mixed_channels, rgb_response, wavelength_response
from models.weights.files import Weights
from pipeline.errors import WeightsError


def channels_of(weights: Weights, network: VggFeatures) -> NDArray[np.float32]:
    """Mix normalised columns to the channels that a trained VGG19 reads, (column, channel).

    By the wavelengths that its file names; where it names none, three channels are red, green and blue, and as many as
    the segmenter has columns are those columns in their order.

    Raises
    ------
    WeightsError : another number of channels and no wavelengths, or one that the segmenter's columns do not reach.
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

    def __call__(self, seen: CoarseLook) -> NDArray[np.float64]:
        """(y, x) of the padded coarse grid: never of a finer one, which would need what is not captured yet."""
        picture = seen.columns @ self.colours
        drawn = np.empty(picture.shape[:2])
        for rows in stretches(picture.shape[0]):
            for columns in stretches(picture.shape[1]):
                part = picture[rows.first : rows.last, columns.first : columns.last]
                kept = np.s_[rows.kept_first : rows.kept_last, columns.kept_first : columns.kept_last]
                own = np.s_[_own(rows), _own(columns)]
                drawn[kept] = self._of_block(part, rows, columns)[own]
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


def _own(stretch: Stretch) -> slice:
    return slice(stretch.kept_first - stretch.first, stretch.kept_last - stretch.first)

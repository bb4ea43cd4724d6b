"""Fitting kernels trained on photographs to other bands and another patch size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor

from models.network.spectral import REACH, Normalisation, SpectralBasis

RGB_NM = (650.0, 550.0, 450.0)


def rgb_response(basis: SpectralBasis) -> NDArray[np.float32]:
    """How much each spectral column says of red, green and blue (650, 550, 450 nm), (3, column), rows summing to 1."""
    return wavelength_response(basis, RGB_NM)


def wavelength_response(basis: SpectralBasis, wavelength_nm: Sequence[float]) -> NDArray[np.float32]:
    """How much each spectral column says of the light at some wavelengths, (wavelength, column), rows summing to 1.

    A wavelength outside the basis takes its nearest end: data without blue show red there.
    """
    centres = np.linspace(basis.low_nm, basis.high_nm, basis.columns)
    wanted = np.clip(wavelength_nm, basis.low_nm, basis.high_nm)
    distance = np.abs(wanted[:, None] - centres[None, :]) / basis.spacing_nm
    bump = np.where(distance <= REACH, np.exp(-0.5 * (distance / 0.5) ** 2), 0.0)
    return np.asarray(bump / bump.sum(axis=1, keepdims=True), np.float32)


def mixed_channels(normalisation: Normalisation, response: NDArray[np.floating]) -> NDArray[np.float32]:
    """Mix normalised columns to channels by a response (channel, column), (column, channel).

    The median of the training data becomes 0 in every channel, one spread more of all columns 1.
    """
    exact = response.astype(np.float64)
    undo = np.linalg.inv(normalisation.whitening.astype(np.float64)) * normalisation.spread
    return np.asarray(undo @ exact.T / (exact @ normalisation.spread), np.float32)


def map_rgb_kernel(kernel: Tensor, response: NDArray[np.floating]) -> Tensor:
    """Kernel (out, 3, y, x) over colours -> (out, column, y, x), the sum over colours of weight times response.

    It says of the columns what the old one says of the colours mixed from them; grey of all columns is grey.
    """
    return torch.einsum("ocyx,cj->ojyx", kernel, torch.as_tensor(np.asarray(response), dtype=kernel.dtype))


def resize_patch_kernel(kernel: Tensor, size: tuple[int, int]) -> Tensor:
    """Kernel (out, in, y, x) of patches -> the same for patches of ``size``.

    Its answer to a patch enlarged bilinearly is the old one to the patch itself: the pseudo-inverse of enlarging.
    """
    rows, columns = kernel.shape[2:]
    pixels = torch.eye(rows * columns, dtype=torch.float64).reshape(-1, 1, rows, columns)
    enlarge = F.interpolate(pixels, size=size, mode="bilinear", align_corners=False).reshape(rows * columns, -1)
    fitted = kernel.double().reshape(-1, rows * columns) @ torch.linalg.pinv(enlarge).T
    resized: Tensor = fitted.reshape(*kernel.shape[:2], *size).to(kernel.dtype)
    return resized

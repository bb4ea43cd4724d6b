"""The first kernels of a start brought to the spectral columns that are trained on: earlier columns, or colours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.network.sizes import SegmenterConfig
from models.network.spectral import Normalisation, SpectralBasis
from models.training.kernel_fits import map_rgb_kernel, resize_patch_kernel, wavelength_response
from models.training.pretrained import PATCHES

STEMS = ("coarse_stem", "fine_stem")


def column_change(
    old_basis: SpectralBasis, old: Normalisation, basis: SpectralBasis, new: Normalisation
) -> NDArray[np.float64]:
    """What normalised columns of the new data say of the old ones, (new column, old column).

    By wavelength, whatever the number of columns; median and spread of the new data take the place of the old ones.
    """
    centres = np.linspace(old_basis.low_nm, old_basis.high_nm, old_basis.columns)
    mixed = np.asarray(wavelength_response(basis, tuple(centres)).T, np.float64)
    if basis == old_basis:
        mixed = np.eye(basis.columns)
    whitened = mixed @ old.whitening.astype(np.float64)
    return np.asarray(np.linalg.solve(new.whitening.astype(np.float64), whitened), np.float64)


def for_columns(state: Mapping[str, Tensor], change: NDArray[np.float64]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Bring the first kernels to the new columns, with how; nothing where these mean the same.

    No kernel grows: what hardly varied in the old data and was made large there may vary much in the new.
    """
    fitted, how = dict(state), dict[str, str]()
    if change.shape[0] == change.shape[1] and np.allclose(change, np.eye(len(change)), atol=1e-5):
        return fitted, how
    for name in (f"{stem}.{part}.weight" for stem in STEMS for part in ("enter", "embed")):
        kernel = state.get(name)
        if kernel is None or kernel.dim() != 4 or kernel.shape[1] != change.shape[1]:
            continue
        mixed = torch.einsum("ocyx,jc->ojyx", kernel.double(), torch.from_numpy(change))
        before, after = (one.flatten(1).norm(dim=1).clamp(min=1e-12) for one in (kernel.double(), mixed))
        fitted[name] = (mixed * (before / after).clamp(max=1.0)[:, None, None, None]).to(kernel.dtype)
        how[name] = f"{kernel.shape[1]} to {change.shape[0]} spectral columns by wavelength"
    return fitted, how


def of_colours(kernel: Tensor) -> bool:
    """Whether it is a kernel (out, 3, y, x)."""
    return kernel.dim() == 4 and kernel.shape[1] == 3


def with_patch_kernels(
    state: Mapping[str, Tensor], config: SegmenterConfig, colours: NDArray[np.float32]
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Bring a transformer's patch kernel to both stems: to their patch size, and from colours to columns; with how."""
    fitted, how = dict(state), dict[str, str]()
    name = next((name for name in state if name.removeprefix("encoder.") == PATCHES), None)
    if name is None or not config.patch_kernel or not of_colours(state[name]):
        return fitted, how
    kernel, side = fitted.pop(name), config.patch // config.token_side
    sized = kernel if kernel.shape[2:] == (side, side) else resize_patch_kernel(kernel, (side, side))
    mapped = map_rgb_kernel(sized, colours.T)
    how[name] = f"{tuple(kernel.shape)} to {tuple(mapped.shape)}, colours to spectral columns by wavelength"
    bias = fitted.pop(name.removesuffix("weight") + "bias", torch.zeros(kernel.shape[0]))
    for stem in STEMS:
        fitted[f"{stem}.embed.weight"], fitted[f"{stem}.embed.bias"] = mapped, bias
    return fitted, how

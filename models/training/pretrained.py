"""Tensors of other networks put into one of ours, by name and shape, with a report of what became of each.

Known layouts: timm and DeiT vision transformers, Segmenter checkpoints (their encoder is the timm one under
``encoder.``) and VGG19. Kernels trained on photographs are fitted to other bands and another patch size.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor, nn

from models.network.spectral import REACH, Normalisation, SpectralBasis
from pipeline.errors import WeightsError

PATCHES = "patch_embed.proj.weight"
_UNUSED = {
    "head": "a classifier of photographs",
    "head_dist": "a classifier of photographs",
    "classifier": "a classifier of photographs",
    "pre_logits": "a classifier of photographs",
    "patch_embed": "a kernel of whole patches of colours",
    "pos_embed": "positions on a grid of its own",
    "cls_token": "a token of the whole image",
    "dist_token": "a token of the whole image",
    "decoder": "a decoder for its own classes",
    "decode_head": "a decoder for its own classes",
}
RGB_NM = (650.0, 550.0, 450.0)


@dataclass
class LoadReport:
    """What became of each tensor of a file, by its name there; and what of the module nothing came for."""

    matched: list[str] = field(default_factory=list)
    resized: dict[str, str] = field(default_factory=dict)  # name -> how
    skipped: dict[str, str] = field(default_factory=dict)  # name -> why
    missing: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        """One line with the counts and the reasons."""
        counts = f"{len(self.matched)} tensors matched, {len(self.resized)} resized, {len(self.skipped)} skipped"
        reasons = sorted(set(self.skipped.values()))
        return counts + (f" ({'; '.join(reasons[:3])}{'; ...' if len(reasons) > 3 else ''})" if reasons else "")


def load_into(module: nn.Module, state: Mapping[str, Tensor], *, names: Mapping[str, str] | None = None) -> LoadReport:
    """Put every tensor that has a place into ``module``, in place; nothing is changed where none has.

    ``state`` are named tensors as `models.weights.state_files.read_state` gives them, ``names`` beginnings of names, of
    the file to the module's own, ``*`` standing for one number: ``{"blocks.*.attn.qkv": "layers.*.qkv"}``. The first
    that fits counts; other names stay as they are. Raises WeightsError where nothing fits, naming what was found.
    """
    places, report = module.state_dict(), LoadReport()
    found: dict[str, Tensor] = {}
    for name, value in state.items():
        plain = name.removeprefix("encoder.").removeprefix("backbone.")  # of a Segmenter's encoder, and mmseg's
        target = _renamed(plain, names or {})
        if target not in places:
            head = plain.split(".")[0]
            report.skipped[name] = _UNUSED.get(head, f"no place for {head}")
            continue
        if why := _refusal(value, places[target].shape):
            report.skipped[name] = why
            continue
        found[target] = value
        report.matched.append(name)
    report.missing = [name for name in places if name not in found]
    if not found:
        shown = ", ".join(f"{name} {tuple(value.shape)}" for name, value in list(state.items())[:4]) or "nothing"
        expected = set(_UNUSED.values())  # of such files: what else is wrong comes first
        reasons = "; ".join(sorted(set(report.skipped.values()), key=lambda why: (why in expected, why))[:3])
        raise WeightsError(
            f"none of {len(state)} tensors fits the network: found {shown} ({reasons}); use weights made for it"
        )
    module.load_state_dict(found, strict=False)
    return report


def _renamed(name: str, names: Mapping[str, str]) -> str:
    for old, new in names.items():
        fits = re.match(re.escape(old).replace(r"\*", r"(\d+)") + r"(?=\.|$)", name)
        if fits:
            numbers = iter(fits.groups())
            return re.sub(r"\*", lambda _, numbers=numbers: next(numbers), new) + name[fits.end() :]  # type: ignore[misc]
    return name


def _refusal(value: Tensor, shape: torch.Size) -> str:
    """Why a tensor is not taken; nothing where it is."""
    if not value.is_floating_point() or not bool(torch.isfinite(value).all()):
        return "values that are not finite numbers"
    return "" if value.shape == shape else f"{tuple(value.shape)} does not fit {tuple(shape)}"


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

"""Putting tensors of other networks into one of ours: by name and shape, with a report of what became of each.

Known layouts: timm and DeiT vision transformers, Segmenter checkpoints (their encoder is the timm one under
``encoder.``) and VGG19.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from models.network.spectral import checked_wavelengths
from models.network.vgg import WAVELENGTHS, VggFeatures, common_names
from models.network.vgg_sizes import VggSizes
from models.weights.state_files import read_state
from pipeline.errors import WavelengthError, WeightsError

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

    Parameters
    ----------
    state
        Named tensors as `models.weights.state_files.read_state` gives them.
    names
        Beginnings of names, of the file to the module's own, ``*`` standing for one number:
        ``{"blocks.*.attn.qkv": "layers.*.qkv"}``. The first that fits counts; other names stay as they are.

    Raises
    ------
    WeightsError : nothing fits; names what was found.
    """
    places, report = module.state_dict(), LoadReport()
    found: dict[str, Tensor] = {}
    for name, value in state.items():
        target = _renamed(_plain(name), names or {})
        if target not in places:
            head = _plain(name).split(".")[0]
            report.skipped[name] = _UNUSED.get(head, f"no place for {head}")
            continue
        why = _refusal(value, places[target].shape)
        if why:
            report.skipped[name] = why
            continue
        found[target] = value
        report.matched.append(name)
    report.missing = [name for name in places if name not in found]
    if not found:
        raise WeightsError(_nothing_fits(state, report))
    module.load_state_dict(found, strict=False)
    return report


def _plain(name: str) -> str:
    """A Segmenter's encoder has the names of timm below ``encoder.``, mmseg's ``backbone.``."""
    return name.removeprefix("encoder.").removeprefix("backbone.")


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


def _nothing_fits(state: Mapping[str, Tensor], report: LoadReport) -> str:
    shown = ", ".join(f"{name} {tuple(value.shape)}" for name, value in list(state.items())[:4])
    expected = set(_UNUSED.values())  # of such files: what else is wrong comes first
    reasons = "; ".join(sorted(set(report.skipped.values()), key=lambda why: (why in expected, why))[:3])
    found = f"found {shown or 'nothing'} ({reasons})"
    return f"none of {len(state)} tensors fits the network: {found}; use weights made for it"


def load_vgg(path: Path, sizes: VggSizes | None = None, *, trained: bool = False) -> tuple[VggFeatures, LoadReport]:
    """Read VGG19's convolutions: torchvision's file, the stack alone, or the normalised variant.

    Parameters
    ----------
    trained
        On data of one's own: then it may read any number of channels, and a tensor ``wavelength_nm`` in the file, one
        number for each, says where they lie.

    Raises
    ------
    WeightsError : as `read_state`, or a convolution is missing or of another size: another network, such as VGG16;
        or other channels than photographs have, or wavelengths that do not belong to them.
    """
    sizes = sizes or VggSizes()
    state = read_state(path)
    wavelengths = state.pop(WAVELENGTHS, None) if trained else None
    state = common_names(state, sizes)
    channels = _channels(state)
    if channels != 3 and not trained:
        raise WeightsError(
            f"{path} reads {channels} channels, a VGG19 of photographs 3; one trained on such data is for the"
            " policy vgg-trained"
        )
    named = None if wavelengths is None else _wavelengths(wavelengths, channels, path)
    network = VggFeatures(replace(sizes, channels=channels), named)
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


def _channels(state: Mapping[str, Tensor]) -> int:
    """What the first convolution reads; 3 where there is none, which loading refuses."""
    first = state.get("features.0.weight")
    return 3 if first is None or first.dim() != 4 else int(first.shape[1])


def _wavelengths(tensor: Tensor, channels: int, path: Path) -> tuple[float, ...]:
    try:
        return tuple(checked_wavelengths(tensor.double().numpy(), channels).tolist())
    except WavelengthError as error:
        raise WeightsError(f"{path}, tensor {WAVELENGTHS!r}: {error}") from error

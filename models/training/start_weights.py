"""Weights to begin training from: a vision transformer's blocks, a Segmenter's encoder, or earlier weights of ours.

What of a vision transformer has a place here is its blocks, its last norm and its patch kernel: brought from colours to
spectral columns and added to what our convolutions make of a patch. It has none for the class token, positions (ours
are computed from places) and its heads. Queries and keys are normalised here, which theirs are not: what is begun from
is a start, not the network it was.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig
from models.network.spectral import Normalisation, SpectralBasis
from models.training.pretrained import (
    PATCHES,
    LoadReport,
    load_into,
    map_rgb_kernel,
    mixed_channels,
    resize_patch_kernel,
    rgb_response,
    wavelength_response,
)
from models.weights.files import FORMAT, NORMALISATION, Description, describe_weights, read_tensors
from models.weights.state_files import read_heads, read_notes, read_state
from pipeline.errors import SettingsError, WeightsError

STEMS = ("coarse_stem", "fine_stem")
HEAD_WIDTH = 64  # of every common vision transformer: its file does not say how many heads it has
START_FROM = (  # in words
    "a vision transformer of timm or DeiT, a Segmenter checkpoint with its variant.yml, or weights that `spectralzoom"
    " train` made"
)
SAME_SPREAD = 0.1  # columns of the same data differ by no more, as a fraction
LICENCES = ("licence", "license")
CLASS_HEADS = ("coarse_classes", "fine_classes", "scorer")  # the scorer reads probabilities of classes
_BLOCK = "encoder.blocks.*."
_TRANSFORMER = {
    "blocks.*.attn.qkv": _BLOCK + "attention.qkv",
    "blocks.*.attn.proj": _BLOCK + "attention.out",
    "blocks.*.mlp.fc1": _BLOCK + "mlp.0",
    "blocks.*.mlp.fc2": _BLOCK + "mlp.2",
    "blocks.*.norm1": _BLOCK + "norm1",
    "blocks.*.norm2": _BLOCK + "norm2",
    "norm": "encoder.norm",
}
_OURS = {"blocks": "encoder.blocks", "norm": "encoder.norm"}


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


def for_columns(
    state: Mapping[str, Tensor], change: NDArray[np.float64], *, same_data: bool = False
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Bring the first kernels to the new columns, with how; nothing where these mean the same.

    No kernel grows, but for the same data: what hardly varied in the old and was made large there may vary much in the
    new.
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
        smaller = torch.ones_like(after) if same_data else (before / after).clamp(max=1.0)
        fitted[name] = (mixed * smaller[:, None, None, None]).to(kernel.dtype)
        how[name] = f"{kernel.shape[1]} to {change.shape[0]} spectral columns by wavelength"
    return fitted, how


def with_patch_kernels(
    state: Mapping[str, Tensor], config: SegmenterConfig, colours: NDArray[np.float32]
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Bring a transformer's patch kernel to both stems: to their patch size, and from colours to columns; with how."""
    fitted, how = dict(state), dict[str, str]()
    name = next((name for name in state if name.removeprefix("encoder.") == PATCHES), None)
    if name is None or not config.patch_kernel or state[name].dim() != 4 or state[name].shape[1] != 3:
        return fitted, how
    kernel, side = fitted.pop(name), config.patch // config.token_side
    sized = kernel if kernel.shape[2:] == (side, side) else resize_patch_kernel(kernel, (side, side))
    mapped = map_rgb_kernel(sized, colours.T)
    how[name] = f"{tuple(kernel.shape)} to {tuple(mapped.shape)}, colours to spectral columns by wavelength"
    bias = fitted.pop(name.removesuffix("weight") + "bias", torch.zeros(kernel.shape[0]))
    for stem in STEMS:
        fitted[f"{stem}.embed.weight"], fitted[f"{stem}.embed.bias"] = mapped, bias
    return fitted, how


@dataclass(frozen=True)
class TokenSizes:
    """Sizes that a start shares with what is begun from it; fewer or more layers may be."""

    dim: int
    heads: int
    mlp_ratio: int
    layers: int


@dataclass(frozen=True)
class Start:
    """What training begins from, in the segmenter's own names, and what becomes of each tensor of the file."""

    state: dict[str, Tensor]
    report: LoadReport
    record: dict[str, Any]  # for the weights' record: file, hash, kind, report, licence


class StartFile:
    """A file to begin from.

    Raises SettingsError where there is none, and WeightsError where it is of no kind that is known, saying which are.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise SettingsError(f"no file {path}; --init takes {START_FROM}")
        self.path = path
        self.described: Description | None = None  # what earlier weights of ours say of themselves
        if path.suffix == ".safetensors" and FORMAT.partition("/")[0] in read_notes(path).get("about", ""):
            self.described = describe_weights(path)
            self.state, self.kind = read_tensors(path, self.described), "spectralzoom"
            return
        self.state = read_state(path)
        for self.kind, prefix in (("vision transformer", ""), ("Segmenter", "encoder.")):
            qkv = self.state.get(f"{prefix}blocks.0.attn.qkv.weight")
            if qkv is not None and qkv.dim() == 2:
                return
        shown = ", ".join(f"{name} {tuple(value.shape)}" for name, value in list(self.state.items())[:4])
        raise WeightsError(
            f"none of {len(self.state)} tensors of {path} has a place in the segmenter: found {shown}; --init takes"
            f" {START_FROM}"
        )

    @cached_property
    def sizes(self) -> TokenSizes:
        """Sizes of its tokens. Raises WeightsError where they cannot be told."""
        if self.described is not None:
            config = self.described.config
            return TokenSizes(config.dim, config.heads, config.mlp_ratio, config.layers)
        plain = {name.removeprefix("encoder."): value for name, value in self.state.items()}
        dim = int(plain["blocks.0.attn.qkv.weight"].shape[-1])
        wide = plain.get("blocks.0.mlp.fc1.weight")
        heads = read_heads(self.path) if self.kind == "Segmenter" else max(dim // HEAD_WIDTH, 1)
        layers = len({name.split(".")[1] for name in plain if name.startswith("blocks.")})
        return TokenSizes(dim, heads, 4 if wide is None else int(wide.shape[0]) // dim, layers)

    def check(self, config: TokenSizes | SegmenterConfig) -> None:
        """Refuse tokens of other sizes than are to be trained. Raises SettingsError that says what to pass."""
        own = self.sizes
        if (own.dim, own.heads, own.mlp_ratio) != (config.dim, config.heads, config.mlp_ratio):
            wanted, given = (
                f"--dim {one.dim} --heads {one.heads} --mlp-ratio {one.mlp_ratio}" for one in (own, config)
            )
            raise SettingsError(
                f"--init {self.path}: its tokens have a width of {own.dim}, {own.heads} heads and an MLP"
                f" {own.mlp_ratio} times as wide; what would be trained has {given}; pass {wanted} (and --layers"
                f" {own.layers} to take all its layers)"
            )

    @property
    def patch_kernel(self) -> bool:
        """Whether what is begun from it has a patch kernel: a transformer's of colours, or that of earlier weights."""
        if self.described is not None:
            return self.described.config.patch_kernel
        return any(
            name.removeprefix("encoder.") == PATCHES and value.dim() == 4 and value.shape[1] == 3
            for name, value in self.state.items()
        )

    @property
    def earlier(self) -> dict[str, Any]:
        """The record of earlier weights of ours; empty for other files."""
        return {} if self.described is None else self.described.record

    def begin(
        self, config: SegmenterConfig, basis: SpectralBasis, normalisation: Normalisation, names: tuple[str, ...]
    ) -> Start:
        """Give what of the file has a place in a segmenter of these sizes, columns and classes.

        Raises WeightsError where nothing has.
        """
        state, spared, changed = dict(self.state), dict[str, str](), dict[str, str]()
        if self.described is not None:
            state, spared = _without_heads(state, names == self.described.class_names)
            try:
                own = Normalisation(*(self.state[f"normalisation.{name}"].numpy() for name in NORMALISATION))
            except KeyError as error:
                raise WeightsError(
                    f"the weights to begin from lack the tensor {error}; train or copy them again"
                ) from None
            alike = self.described.basis == basis and np.allclose(own.spread, normalisation.spread, rtol=SAME_SPREAD)
            change = column_change(self.described.basis, own, basis, normalisation)
            state, changed = for_columns(state, change, same_data=alike)
        else:
            state, changed = with_patch_kernels(state, config, mixed_channels(normalisation, rgb_response(basis)))
        with torch.random.fork_rng(devices=[]):
            model = Segmenter(config)
        report = load_into(model, state, names=_TRANSFORMER if self.described is None else _OURS)
        _settle(report, self.state, spared, changed)
        missing = set(report.missing)
        taken = {name: value for name, value in model.state_dict().items() if name not in missing}
        skipped: dict[str, list[str]] = {}
        for name, why in report.skipped.items():
            skipped.setdefault(why, []).append(name)
        record = {
            "file": self.path.name,
            "sha256": hashlib.sha256(self.path.read_bytes()).hexdigest(),
            "kind": self.kind,
            "matched": len(report.matched),
            "resized": dict(report.resized),
            "skipped": skipped,
            "licence": self._licence(),
        }
        return Start(taken, report, record)

    def _licence(self) -> str | None:
        """What the file says of its licence, or what the one says that it was begun from; None where neither does."""
        begun = self.earlier.get("begun_from") or {}
        for notes in (self.earlier, begun, read_notes(self.path)):
            for name in LICENCES:
                if notes.get(name):
                    return str(notes[name])
        return None


def _without_heads(state: Mapping[str, Tensor], same: bool) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Leave out what is no part of the segmenter, and what tells classes apart where these are others, with why."""
    beside = {"class_colours", *(f"normalisation.{name}" for name in NORMALISATION)}
    kept = {name: value for name, value in state.items() if name not in beside}
    if same:
        return kept, {}
    heads = {name: "other classes" for name in kept if name.split(".")[0] in CLASS_HEADS}
    return {name: value for name, value in kept.items() if name not in heads}, heads


def _settle(
    report: LoadReport, state: Mapping[str, Tensor], spared: Mapping[str, str], changed: Mapping[str, str]
) -> None:
    """Bring what was done before loading into its report, by the names of the file."""
    made = {f"{stem}.embed.{part}" for stem in STEMS for part in ("weight", "bias")}
    if any(name.removeprefix("encoder.") == PATCHES for name in changed) and made <= set(report.matched):
        kept = [name for name in report.matched if name not in made]
        biases = {name.removesuffix("weight") + "bias" for name in changed}
        report.matched[:] = [*kept, *(name for name in state if name in biases)]
        report.resized |= changed
    report.skipped |= spared
    for name, why in report.skipped.items():
        if why == "no place for blocks":
            report.skipped[name] = "layers beyond the last"
    for name in [name for name in changed if name in report.matched]:
        report.matched.remove(name)
        report.resized[name] = changed[name]

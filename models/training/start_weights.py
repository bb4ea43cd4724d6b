"""Earlier weights to begin training from: what of them has a place in the network that is wanted."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig
from models.network.spectral import REACH, Normalisation, SpectralBasis
from models.weights.files import NORMALISATION, describe_weights, read_tensors
from pipeline.errors import SettingsError

FIRST_KERNELS = ("overview_stem.enter.weight", "full_stem.enter.weight", "spectral.weight")
SAME_SPREAD = 0.1  # columns of the same data differ by no more, as a fraction
CLASS_HEADS = ("overview_classes", "full_classes", "spectral", "scorer")  # the scorer reads probabilities of classes
BESIDE = ("class_colours", *(f"normalisation.{name}" for name in NORMALISATION))  # no part of the network


def column_change(
    old_basis: SpectralBasis, old: Normalisation, basis: SpectralBasis, new: Normalisation
) -> NDArray[np.float64]:
    """Return the matrix from normalised columns of the new data to the old ones, (new column, old column).

    By wavelength, whatever the number of columns; median and spread of the new data take the place of the old ones.
    """
    if basis == old_basis:
        mixed = np.eye(basis.columns)
    else:  # wavelengths outside the new basis take its nearest end
        old_nm, new_nm = (np.linspace(one.low_nm, one.high_nm, one.columns) for one in (old_basis, basis))
        distance = (np.clip(old_nm, basis.low_nm, basis.high_nm) - new_nm[:, None]) / basis.spacing_nm
        bump = np.where(np.abs(distance) <= REACH, np.exp(-0.5 * (distance / 0.5) ** 2), 0.0)
        mixed = bump / bump.sum(axis=0)
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
    for name in FIRST_KERNELS:
        kernel, beside = state[name].tensor_split([change.shape[1]], dim=1)
        mixed = torch.einsum("ocyx,jc->ojyx", kernel.double(), torch.from_numpy(change))
        before, after = (one.flatten(1).norm(dim=1).clamp(min=1e-12) for one in (kernel.double(), mixed))
        smaller = torch.ones_like(after) if same_data else (before / after).clamp(max=1.0)
        fitted[name] = torch.cat([(mixed * smaller[:, None, None, None]).to(kernel.dtype), beside], dim=1)
        how[name] = f"{kernel.shape[1]} to {change.shape[0]} spectral columns by wavelength"
    return fitted, how


@dataclass(frozen=True)
class Start:
    """Tensors that training begins from, by the segmenter's names, and what became of each tensor of the file."""

    state: dict[str, Tensor]
    record: dict[str, Any]  # for the weights' record: file, hash, matched, resized, skipped


class StartFile:
    """A file of weights to begin from. Raises SettingsError where there is none; WeightsError as `describe_weights`."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise SettingsError(f"no file {path}; --init takes weights that `spectralzoom train` made")
        self.path, self.described = path, describe_weights(path)
        self.tensors = read_tensors(path, self.described)

    @property
    def earlier(self) -> dict[str, Any]:
        """The record of these weights."""
        return self.described.record

    def check(self, config: SegmenterConfig) -> None:
        """Refuse tokens of other sizes than are to be trained. Raises SettingsError that says what to pass."""
        own = self.described.config
        if (own.dim, own.heads, own.mlp_ratio) != (config.dim, config.heads, config.mlp_ratio):
            wanted, given = (
                f"--dim {one.dim} --heads {one.heads} --mlp-ratio {one.mlp_ratio}" for one in (own, config)
            )
            raise SettingsError(
                f"--init {self.path}: its tokens have a width of {own.dim}, {own.heads} heads and an MLP"
                f" {own.mlp_ratio} times as wide; what would be trained has {given}; pass {wanted} (and --layers"
                f" {own.layers} to take all its layers)"
            )

    def begin(
        self, config: SegmenterConfig, basis: SpectralBasis, normalisation: Normalisation, names: tuple[str, ...]
    ) -> Start:
        """Give what of the file has a place in a segmenter of these sizes, columns and classes."""
        own = Normalisation(*(self.tensors[f"normalisation.{name}"].numpy() for name in NORMALISATION))
        alike = self.described.basis == basis and np.allclose(own.spread, normalisation.spread, rtol=SAME_SPREAD)
        state = {name: value for name, value in self.tensors.items() if name not in BESIDE}
        change = column_change(self.described.basis, own, basis, normalisation)
        state, changed = for_columns(state, change, same_data=alike)
        with torch.device("meta"):
            places = Segmenter(config).state_dict()
        taken: dict[str, Tensor] = {}
        skipped: dict[str, list[str]] = {}
        for name, value in state.items():
            if names != self.described.class_names and name.split(".")[0] in CLASS_HEADS:
                why = "other classes"
            elif name not in places:
                why = "layers beyond the last"
            elif value.shape != places[name].shape:
                why = f"{tuple(value.shape)} does not fit {tuple(places[name].shape)}"
            else:
                taken[name] = value
                continue
            skipped.setdefault(why, []).append(name)
        record = {
            "file": self.path.name,
            "sha256": hashlib.sha256(self.path.read_bytes()).hexdigest(),
            "matched": len(taken.keys() - changed.keys()),
            "resized": changed,
            "skipped": skipped,
        }
        return Start(taken, record)

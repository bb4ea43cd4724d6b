"""Initial weights of a training: linear discriminants of mean spectra, or tensors of earlier weights."""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from torch import Tensor, nn

from models.evaluation.metrics import confusion, mean_iou
from models.network.segmenter import Segmenter
from models.network.sizes import AROUND_PX, SegmenterConfig
from models.network.spectral import REACH, Normalisation, SpectralBasis
from models.reading.inference import map_of_columns
from models.training.examples import Example
from models.weights.files import NORMALISATION, Weights, describe_weights, read_tensors
from pipeline.errors import SettingsError
from pipeline.geometry.grid import UNLABELLED, SceneGrid

PIXELS = 60_000  # to fit classifiers to, of all scenes together
ABSENT = -20.0  # logit of a class without a pixel
FIRST_KERNELS = ("overview_stem.enter.weight", "full_stem.enter.weight", "spectral.weight")
SAME_SPREAD = 0.1  # largest relative difference of columns of the same data
CLASS_HEADS = ("overview_classes", "full_classes", "spectral", "scorer")  # the scorer has an input for each class
BESIDE = ("class_colours", *(f"normalisation.{name}" for name in NORMALISATION))  # not of the network


@dataclass(frozen=True)
class LabelledPixels:
    """Features of labelled pixels and their classes."""

    features: NDArray[np.float32]  # (pixel, column) means of `AROUND_PX` x `AROUND_PX` px
    labels: NDArray[np.uint8]  # (pixel,)

    @staticmethod
    def drawn(examples: Sequence[Example], rng: np.random.Generator, most: int = PIXELS) -> LabelledPixels:
        """Draw labelled pixels at random, ``most`` together, from each scene in proportion to its number."""
        counts = [int(np.count_nonzero(one.labels != UNLABELLED)) for one in examples]
        fraction = min(1.0, most / max(sum(counts), 1))
        features, labels = [], []
        for example, count in zip(examples, counts, strict=True):
            places = np.flatnonzero(example.labels != UNLABELLED)
            places = np.sort(rng.choice(places, min(count, math.ceil(count * fraction)), replace=False))
            size = (AROUND_PX, AROUND_PX, 1)
            means = scipy.ndimage.uniform_filter(example.columns.astype(np.float32), size, mode="nearest")
            features.append(means.reshape(-1, means.shape[-1])[places])
            labels.append(example.labels.ravel()[places])
        return LabelledPixels(np.concatenate(features), np.concatenate(labels))


def linear_discriminants(pixels: LabelledPixels, classes: int) -> dict[str, Tensor]:
    """Fit linear discriminants with shrinkage; return them as tensors of the segmenter's ``spectral`` layer.

    A class without a pixel gets the logit `ABSENT`. With pixels of a single class all classes are equally likely.
    """
    weight, bias = np.zeros((classes, pixels.features.shape[1])), np.full(classes, ABSENT)
    known = np.unique(pixels.labels)
    if len(known) > 1:
        fitted = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(pixels.features, pixels.labels)
        slope, offset = fitted.coef_, fitted.intercept_
        if len(known) == 2:  # one function separates both
            slope, offset = np.concatenate([0 * slope, slope]), np.concatenate([0 * offset, offset])
        weight[known], bias[known] = slope, offset
    else:
        bias[...] = 0.0
    return {
        "spectral.weight": torch.from_numpy(weight.astype(np.float32))[:, :, None, None],
        "spectral.bias": torch.from_numpy(bias.astype(np.float32)),
    }


def better_reading(
    weights: Weights, start: Mapping[str, Tensor], validation: Sequence[Example]
) -> tuple[Weights, dict[str, Any]]:
    """Choose the better of the trained network and its initial linear discriminants, by mIoU of validation scenes.

    Returns the better weights, and both scores.
    """
    plain = copy.deepcopy(weights.segmenter)
    plain.load_state_dict(dict(start), strict=False)
    for last in (plain.overview_classes, plain.full_classes):
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)  # type: ignore[arg-type]
    readings = {"network": weights, "linear discriminants": replace(weights, segmenter=plain)}
    scores = {name: _miou(one, validation) for name, one in readings.items()}
    kept = max(scores, key=lambda name: scores[name])  # the network on a tie
    return readings[kept], {"miou": scores, "kept": kept}


def _miou(weights: Weights, examples: Sequence[Example]) -> float:
    """Return the mIoU of all scenes together, by every line at the reference exposure."""
    counts = np.zeros((weights.config.classes,) * 2, np.int64)
    for example in examples:
        grid = SceneGrid(*example.shape, weights.config.patch, 1)
        drawn, _ = map_of_columns(weights, example.columns.astype(np.float32), grid)
        counts += confusion(example.labels[: grid.height, : grid.width], drawn.classes, weights.config.classes)
    return mean_iou(counts)


def column_change(
    old_basis: SpectralBasis, old: Normalisation, basis: SpectralBasis, new: Normalisation
) -> NDArray[np.float64]:
    """Return the matrix from normalised columns of new data to the old ones, (new column, old column).

    Columns correspond by wavelength. Median and spread of the new data replace the old ones.
    """
    if basis == old_basis:
        mixed = np.eye(basis.columns)
    else:  # clipped to the new basis
        old_nm, new_nm = (np.linspace(one.low_nm, one.high_nm, one.columns) for one in (old_basis, basis))
        distance = (np.clip(old_nm, basis.low_nm, basis.high_nm) - new_nm[:, None]) / basis.spacing_nm
        bump = np.where(np.abs(distance) <= REACH, np.exp(-0.5 * (distance / 0.5) ** 2), 0.0)
        mixed = bump / bump.sum(axis=0)
    whitened = mixed @ old.whitening.astype(np.float64)
    return np.asarray(np.linalg.solve(new.whitening.astype(np.float64), whitened), np.float64)


def for_columns(
    state: Mapping[str, Tensor], change: NDArray[np.float64], *, same_data: bool = False
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Convert the first kernels to new columns; return the tensors, and a description of each change.

    A kernel's norm may grow for the ``same_data`` only: whitening has enlarged small variations of the old data, which
    may be large in the new.
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
    """Initial tensors by the segmenter's names, and a record of the tensors of their file."""

    state: dict[str, Tensor]
    record: dict[str, Any]  # file, hash, matched, resized, skipped


class StartFile:
    """A file of initial weights. Raises SettingsError where it does not exist; WeightsError as `describe_weights`."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise SettingsError(f"no file {path}; --init takes weights that `spectralzoom train` made")
        self.path, self.described = path, describe_weights(path)
        self.tensors = read_tensors(path, self.described)

    @property
    def earlier(self) -> dict[str, Any]:
        """Return the record of these weights."""
        return self.described.record

    def check(self, config: SegmenterConfig) -> None:
        """Raise SettingsError, with the flags to pass, where the sizes of tokens differ."""
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
        """Return the tensors that fit a segmenter of these sizes, columns and classes."""
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

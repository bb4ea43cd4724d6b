"""Weights on disk: one sealed file with the tensors, the spectral basis, the classes and how they were made."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from models.network.sizes import SegmenterConfig
from models.network.spectral import Normalisation, SpectralBasis, check_basis, project
from models.weights.sealed_files import (
    DAMAGED,
    KEY_DIGITS,
    broken_seal,
    changed_tensor,
    hash_without_seal,
    own_tensors,
    read_about,
    write_sealed,
)
from pipeline.errors import WeightsError
from pipeline.lazy import deferred
from pipeline.readings import readings_alone

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from models.network import controls
    from models.network.controls import Network
    from models.network.segmenter import Segmenter
else:
    torch = deferred("torch")
    controls = deferred("models.network.controls")

NORMALISATION = ("centre", "spread", "whitening")
FORMAT, UNSEALED = "spectralzoom-weights/2", "spectralzoom-weights/1"  # the earlier one has no hashes
SPREAD = "normalisation.spread"
CALIBRATION = "calibration"  # of a record: how sure of themselves maps may be, and the temperature, where one is needed
KINDS = {"F32": "torch.float32", "U8": "torch.uint8"}  # by safetensors' names
Learned = TypeVar("Learned", bound="AnyWeights")


@dataclass(frozen=True)
class Description:
    """What a file of weights says of itself; to read that takes neither its tensors nor torch."""

    config: SegmenterConfig
    basis: SpectralBasis
    class_names: tuple[str, ...]
    record: dict[str, Any]
    about: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)  # all of it, hashes too

    @property
    def sealed(self) -> bool:
        """Whether the file tells the hash of every tensor."""
        return self.about.get("format") == FORMAT


@dataclass(frozen=True)
class AnyWeights:
    """A network of any design with all it needs: basis, normalisation, classes, and the record of its training."""

    network: Network
    basis: SpectralBasis
    normalisation: Normalisation
    class_names: tuple[str, ...]
    class_colours: NDArray[np.uint8]  # (class, 3)
    record: dict[str, Any] = field(default_factory=dict)  # command, seed, data, split, validation, licence

    @property
    def config(self) -> SegmenterConfig:
        """Sizes of the network, and which one it is."""
        return self.network.config

    @property
    def temperature(self) -> float:
        """What logits of maps are divided by; 1 unless the record of training has another."""
        return float((self.record.get(CALIBRATION) or {}).get("temperature", 1.0))

    def columns(self, values: NDArray[np.floating], wavelength_nm: NDArray[np.floating]) -> NDArray[np.float32]:
        """Normalised spectral columns of pixels, (..., band) -> (..., column) float32.

        Columns that no band reaches take what the others let expect, and so do those of which all bands are dead.
        A value that is no reading by `Normalisation.most_value` is dead. A pixel with more than half of its bands dead
        is NaN.
        """
        values = readings_alone(values, self.normalisation.most_value)
        matrix, reached = self.basis.matrix(wavelength_nm)
        seen = project(values, matrix)
        columns = self.normalisation.apply(seen, reached)
        columns[~np.isfinite(seen[..., reached]).any(axis=-1)] = np.nan
        return columns


@dataclass(frozen=True)
class Weights(AnyWeights):
    """Those of a two-scale segmenter, which surveys are made with."""

    network: Segmenter

    def on(self, device: str) -> Weights:
        """The same where it computes on a device of this machine, by `models.network.machine.choose_device`."""
        self.network.to(device)
        return self

    @property
    def segmenter(self) -> Segmenter:
        """The network."""
        return self.network


def save_weights(weights: AnyWeights, path: Path) -> None:
    """Write the file, sealed, by a temporary name and a rename, so that it is whole or absent.

    Raises WeightsError where the disk refuses.
    """
    tensors = dict(weights.network.state_dict())
    for name in NORMALISATION:
        tensors[f"normalisation.{name}"] = torch.from_numpy(getattr(weights.normalisation, name).copy())
    tensors["class_colours"] = torch.from_numpy(weights.class_colours.copy())
    about = {
        "format": FORMAT,
        "config": weights.config.as_dict(),
        "basis": {"low_nm": weights.basis.low_nm, "high_nm": weights.basis.high_nm, "columns": weights.basis.columns},
        "class_names": list(weights.class_names),
        "record": weights.record,
    }
    try:
        write_sealed(path, about, tensors)
    except OSError as error:
        raise WeightsError(f"cannot write weights to {path}: {error.strerror}; choose another -o") from error


def content_key(path: Path) -> str:
    """Name weights by what they hold, 20 hexadecimal digits: the same with hashes and without.

    It is the beginning of the SHA-256 of the file as it was before files had hashes, so that sealing weights makes
    nothing anew that was made with them. Raises WeightsError where the file cannot be read.
    """
    try:
        return hash_without_seal(path, {"format": UNSEALED})[:KEY_DIGITS]
    except (*DAMAGED, KeyError, TypeError, ValueError) as error:
        raise _unreadable(path, error) from error


def unsealed_note(path: Path) -> str:
    """What to say of weights without hashes."""
    return f"{path.name} was made before weights had hashes: damage to its numbers cannot be told; train them anew"


def load_weights(path: Path) -> Weights:
    """Read a file that ``save_weights`` wrote of a two-scale segmenter. No pickle is involved.

    Raises WeightsError where it is missing, of another format or a control, or where a tensor (named) is not the one
    that was written, does not fit its config, or holds what is no finite number.
    """
    described = describe_weights(path)
    check_two_scale(described.config, path)
    return Weights(**vars(_read(path, described)))


def load_any_weights(path: Path) -> AnyWeights:
    """Read ``Weights`` of a two-scale segmenter, otherwise those of a control; raises WeightsError likewise."""
    described = describe_weights(path)
    return load_weights(path) if described.config.design == "two-scale" else _read(path, described)


def check_two_scale(config: SegmenterConfig, path: Path) -> None:
    """Refuse a control where a survey is to be made (WeightsError)."""
    if config.design != "two-scale":
        raise WeightsError(
            f"{path} holds the control '{config.preset}', which is there to be compared with; a survey needs weights of"
            " two scales: train some with: spectralzoom train DATASET -o WEIGHTS (without --preset)"
        )


def _read(path: Path, described: Description) -> AnyWeights:
    tensors = read_tensors(path, described)
    network = _network(described.config, "cpu")
    network.load_state_dict({name: tensors[name] for name in network.state_dict()})
    normalisation = Normalisation(*(tensors[f"normalisation.{name}"].numpy() for name in NORMALISATION))
    return AnyWeights(
        network.eval(),
        described.basis,
        normalisation,
        described.class_names,
        tensors["class_colours"].numpy(),
        described.record,
    )


def _network(config: SegmenterConfig, device: str) -> Network:
    with torch.device(device):
        return controls.build_network(config)


def read_tensors(path: Path, described: Description) -> dict[str, Tensor]:
    """Read every tensor of a file of weights, after its header was held against what the description asks for.

    Raises WeightsError as ``load_weights``.
    """

    with _opened(path, "pt") as file:
        claimed = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        if wrong := misfit(described.config, claimed):
            raise WeightsError(f"{path}: {wrong}; train it again")
        tensors = own_tensors(file)
    if wrong := changed_tensor(described.about, tensors) if described.sealed else "":
        raise WeightsError(f"{path} is damaged: {wrong}; copy or train the file again")
    if wrong := unusable(tensors):
        raise WeightsError(f"{path}: {wrong}; copy or train the file again")
    return tensors


def describe_weights(path: Path) -> Description:
    """Read what a file of weights says of itself, in milliseconds.

    Raises WeightsError where it is missing, cut short, of another format, or where its description is damaged or asks
    for what cannot be.
    """
    if not path.is_file():
        raise WeightsError(f"no weights at {path}; train some with: spectralzoom train DATASET -o {path.name}")
    with _opened(path, "np") as file:
        about = read_about(file)
    if about.get("format") not in (FORMAT, UNSEALED):
        raise WeightsError(f"{path} holds {about.get('format', 'no format mark')}, expected {FORMAT}; train it again")
    if wrong := broken_seal(about) if about["format"] == FORMAT else "":
        raise WeightsError(f"{path} is damaged: {wrong}; copy or train the file again")
    try:
        config, basis = SegmenterConfig(**about["config"]), SpectralBasis(**about["basis"])
        names, record = tuple(map(str, about["class_names"])), dict(about["record"])
        check_basis(basis, config.columns)
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{path}: its description is damaged ({error}); copy or train the file again") from error
    if len(names) != config.classes:
        raise WeightsError(f"{path} names {len(names)} classes, its segmenter has {config.classes}")
    return Description(config, basis, names, record, about)


@contextmanager
def _opened(path: Path, framework: str) -> Iterator[Any]:
    try:
        with safe_open(path, framework=framework) as file:
            yield file
    except DAMAGED as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> WeightsError:
    return WeightsError(f"{path} is not a readable safetensors file ({error}); train or copy it again")


def with_record(weights: Learned, **entries: Any) -> Learned:
    """Give the same weights with entries added to their record."""
    return replace(weights, record={**weights.record, **entries})


def misfit(config: SegmenterConfig, claimed: Mapping[str, Any]) -> str:
    """Which tensor of a file's header is not as the config asks, in words; nothing where all are. Reads no numbers.

    ``claimed`` are slices of `safetensors`, by the tensors' names. Shapes are those of the network on torch's meta
    device, where tensors have a size and no memory.
    """
    one, all_pairs = (config.columns,), (config.columns, config.columns)
    wanted = {name: (tuple(value.shape), "F32") for name, value in _network(config, "meta").state_dict().items()}
    wanted |= {"normalisation.centre": (one, "F32"), SPREAD: (one, "F32")}
    wanted |= {"normalisation.whitening": (all_pairs, "F32"), "class_colours": ((config.classes, 3), "U8")}
    for name, (shape, kind) in wanted.items():
        if name not in claimed:
            return f"tensor {name} should be {shape}, the file has nothing"
        came, word = tuple(claimed[name].get_shape()), claimed[name].get_dtype()
        if came != shape:
            return f"tensor {name} should be {shape}, the file has {came}"
        if word != kind:
            return f"tensor {name} should be of {KINDS[kind]}, the file has {word}"
    return ""


def unusable(tensors: Mapping[str, Tensor], spreads: Sequence[str] = (SPREAD,)) -> str:
    """Which tensor holds numbers that nothing can be computed with, in words; nothing where none does.

    Those called as ``spreads`` are divided by.
    """
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            count = int((~torch.isfinite(value)).sum())
            return f"{count} of {value.numel()} numbers of tensor {name} are not finite"
    for name in spreads:
        if not bool((tensors[name] > 0).all()):
            return f"tensor {name} holds a spread that is not above 0"
    return ""

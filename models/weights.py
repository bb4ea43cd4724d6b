"""Weights on disk: one safetensors file with the tensors, the spectral basis, the classes and how they were made."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from models.sizes import SegmenterConfig
from models.spectral import Normalisation, SpectralBasis, project
from pipeline.errors import WeightsError

if TYPE_CHECKING:
    import torch

    from models.designs import Network
    from models.segmenter import Segmenter

NORMALISATION = ("centre", "spread", "whitening")
FORMAT = "spectralzoom-weights/1"
Learned = TypeVar("Learned", bound="AnyWeights")


@dataclass(frozen=True)
class Description:
    """What a file of weights says of itself; to read that takes neither its tensors nor torch."""

    config: SegmenterConfig
    basis: SpectralBasis
    class_names: tuple[str, ...]
    record: dict[str, Any]


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

    def columns(self, values: NDArray[np.floating], wavelength_nm: NDArray[np.floating]) -> NDArray[np.float32]:
        """Normalised spectral columns of pixels, (..., band) -> (..., column) float32.

        Columns that no band reaches take what the others let expect, and so do those of which all bands are dead.
        A pixel with more than half of its bands dead is NaN.
        """
        matrix, reached = self.basis.matrix(wavelength_nm)
        seen = project(values, matrix)
        columns = self.normalisation.apply(seen, reached)
        columns[~np.isfinite(seen[..., reached]).any(axis=-1)] = np.nan
        return columns


@dataclass(frozen=True)
class Weights(AnyWeights):
    """Those of a two-scale segmenter, which surveys are made with."""

    network: Segmenter

    @property
    def segmenter(self) -> Segmenter:
        """The network."""
        return self.network


def save_weights(weights: AnyWeights, path: Path) -> None:
    """Write the file by a temporary name and a rename, so that it is whole or absent."""
    import torch
    from safetensors.torch import save

    tensors = {name: value.detach().cpu().contiguous() for name, value in weights.network.state_dict().items()}
    for name in NORMALISATION:
        tensors[f"normalisation.{name}"] = torch.from_numpy(getattr(weights.normalisation, name).copy())
    tensors["class_colours"] = torch.from_numpy(weights.class_colours.copy())
    about = {
        "format": FORMAT,
        "config": weights.config.as_dict(),
        "basis": {
            "low_nm": weights.basis.low_nm,
            "high_nm": weights.basis.high_nm,
            "columns": weights.basis.columns,
        },
        "class_names": list(weights.class_names),
        "record": weights.record,
    }
    temporary = path.with_name(path.name + ".part")
    try:
        temporary.write_bytes(save(tensors, {"about": json.dumps(about, sort_keys=True)}))
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise WeightsError(f"cannot write weights to {path}: {error.strerror}; choose another -o") from error


def load_weights(path: Path) -> Weights:
    """Read a file that ``save_weights`` wrote of a two-scale segmenter. No pickle is involved.

    Raises
    ------
    WeightsError : missing, damaged, of another format, a control, or a tensor that does not fit its config (named).
    """
    described = describe_weights(path)
    check_two_scale(described.config, path)
    weights = _read(path, described)
    return Weights(*(getattr(weights, part.name) for part in fields(AnyWeights)))


def load_any_weights(path: Path) -> AnyWeights:
    """Read a file that ``save_weights`` wrote: ``Weights`` of a two-scale segmenter, otherwise those of a control.

    Raises
    ------
    WeightsError : as in ``load_weights``.
    """
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
    with _opened(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    return _assemble(path, described, tensors)


def describe_weights(path: Path) -> Description:
    """Read what a file of weights says of itself, in milliseconds.

    Raises
    ------
    WeightsError : missing, cut short, of another format, or a description that is damaged.
    """
    if not path.is_file():
        raise WeightsError(f"no weights at {path}; train some with: spectralzoom train DATASET -o {path.name}")
    with _opened(path, "np") as file:
        about = json.loads((file.metadata() or {}).get("about", "{}"))
    if about.get("format") != FORMAT:
        raise WeightsError(f"{path} holds {about.get('format', 'no format mark')}, expected {FORMAT}; train it again")
    try:
        config, basis = SegmenterConfig(**about["config"]), SpectralBasis(**about["basis"])
        names, record = tuple(about["class_names"]), dict(about["record"])
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{path}: its description is damaged ({error}); copy or train the file again") from error
    if len(names) != config.classes:
        raise WeightsError(f"{path} names {len(names)} classes, its segmenter has {config.classes}")
    return Description(config, basis, names, record)


@contextmanager
def _opened(path: Path, framework: str) -> Iterator[Any]:
    try:
        with safe_open(path, framework=framework) as file:
            yield file
    except (SafetensorError, OSError, json.JSONDecodeError) as error:
        raise WeightsError(f"{path} is not a readable safetensors file ({error}); train or copy it again") from error


def _assemble(path: Path, described: Description, tensors: dict[str, torch.Tensor]) -> AnyWeights:
    from models.designs import build_network

    network = build_network(described.config)
    parameters = network.state_dict()
    expected = {name: tuple(value.shape) for name, value in parameters.items()} | _shapes_beside(network.config)
    for name, shape in expected.items():
        came = tuple(tensors[name].shape) if name in tensors else "nothing"
        if came != shape:
            raise WeightsError(f"{path}: tensor {name} should be {shape}, the file has {came}; train it again")
    network.load_state_dict({name: tensors[name] for name in parameters})
    normalisation = Normalisation(*(tensors[f"normalisation.{name}"].numpy() for name in NORMALISATION))
    return AnyWeights(
        network.eval(), described.basis, normalisation, described.class_names, tensors["class_colours"].numpy(),
        described.record,
    )  # fmt: skip


def _shapes_beside(config: SegmenterConfig) -> dict[str, tuple[int, ...]]:
    """Shapes of the tensors that are not the network's own."""
    one, all_pairs = (config.columns,), (config.columns, config.columns)
    return {
        "normalisation.centre": one,
        "normalisation.spread": one,
        "normalisation.whitening": all_pairs,
        "class_colours": (config.classes, 3),
    }


def with_record(weights: Learned, **entries: Any) -> Learned:
    """Give the same weights with entries added to their record."""
    return replace(weights, record={**weights.record, **entries})

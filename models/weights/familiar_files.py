"""What weights take for familiar, on disk: a sealed file beside the weights that it was measured for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from models.evaluation.expected_scores import MapScores
from models.reading.familiar import Familiar, Limits
from models.weights.files import Description, content_key, unusable
from models.weights.sealed_files import beside, changed_tensor, key_of_sealed, open_sealed, write_sealed
from models.weights.trained_on import TrainedOn
from pipeline.errors import WeightsError
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import torch
else:
    torch = deferred("torch")

FORMAT = "spectralzoom-familiar/1"
MAP_SCORES = "map_scores"  # of the record: how what maps expect to score came true, where that was measured
SUFFIX = ".familiar.safetensors"
OF_COMPONENTS = ("centres", "covariance", "shot", "read")
OF_LIMITS = ("rates", "light", "fine", "coarse")


@dataclass(frozen=True)
class FamiliarWeights:
    """What is familiar to some weights, and what they were trained on and how sure of themselves they may be."""

    familiar: Familiar
    weights_key: str
    trained_on: TrainedOn
    record: Mapping[str, Any] = field(default_factory=dict)  # command, scenes, calibration, map scores


@dataclass(frozen=True)
class FamiliarFile:
    """The same by its file: where it lies and what it holds."""

    path: Path
    key: str
    trained_on: TrainedOn
    map_scores: MapScores | None = None  # None of files of before, and of weights that were trained in one light


def familiar_path(weights: Path) -> Path:
    """Where what is familiar to some weights lies: beside them, by their name."""
    return beside(weights, SUFFIX)


def save_familiar(made: FamiliarWeights, path: Path) -> None:
    """Write the file, sealed; whole or absent. Raises WeightsError where the disk refuses."""
    familiar, limits = made.familiar, made.familiar.limits
    arrays = {name: getattr(familiar, name) for name in OF_COMPONENTS}
    arrays |= {name: getattr(limits, name) for name in OF_LIMITS}
    about = {
        "format": FORMAT,
        "weights_key": made.weights_key,
        "bands": familiar.bands,
        "columns": familiar.centres.shape[1],
        "steps": list(limits.steps),
        "trained_on": made.trained_on.as_dict(),
        "record": dict(made.record),
    }
    try:
        tensors = {name: torch.from_numpy(np.ascontiguousarray(one, np.float32)) for name, one in arrays.items()}
        write_sealed(path, about, tensors)
    except OSError as error:
        raise WeightsError(f"cannot write what is familiar to {path}: {error.strerror}; choose another -o") from error


def describe_familiar(weights: Path, described: Description, weights_key: str) -> FamiliarFile | None:
    """What is familiar to some weights, by what the file beside them says; None where there is none.

    Reads no tensor, and takes no torch. Raises WeightsError as `load_familiar` where the description is wrong.
    """
    path = familiar_path(weights)
    if not path.is_file():
        return None
    with open_sealed(path, "np", FORMAT, _refused) as (_, about):
        _checked(path, about, described, weights_key)
    scores = about["record"].get(MAP_SCORES)
    told = None if scores is None else MapScores.read(scores)
    return FamiliarFile(path, familiar_key(path), TrainedOn.read(about["trained_on"]), told)


def familiar_key(path: Path) -> str:
    """Name the file by what it holds, 20 hexadecimal digits. Raises WeightsError where it cannot be read."""
    return key_of_sealed(path, FORMAT, _refused)


def load_familiar(weights: Path, described: Description) -> FamiliarWeights:
    """Read a file that `save_familiar` wrote beside some weights. No pickle is involved.

    Raises WeightsError where it is damaged, of another format, or was measured for other weights.
    """
    path = familiar_path(weights)
    with open_sealed(path, "pt", FORMAT, _refused) as (file, about):
        _checked(path, about, described, content_key(weights))
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    if wrong := changed_tensor(about, tensors) or unusable(tensors, spreads=("light", "rates")):
        raise _refused(path, wrong)
    try:
        arrays = {name: tensors[name].double().numpy() for name in (*OF_COMPONENTS, *OF_LIMITS)}
        steps = tuple(map(int, about["steps"]))
        limits = Limits(arrays["rates"], arrays["light"], steps, arrays["fine"], arrays["coarse"])
        familiar = Familiar(**{name: arrays[name] for name in OF_COMPONENTS}, limits=limits, bands=int(about["bands"]))
        familiar.lit(float(limits.light[0]))  # a covariance that is none is told here
    except (KeyError, ValueError) as error:
        raise _refused(path, str(error)[:120]) from error
    return FamiliarWeights(familiar, about["weights_key"], TrainedOn.read(about["trained_on"]), about["record"])


def _checked(path: Path, about: Mapping[str, Any], described: Description, weights_key: str) -> None:
    """Refuse a description that lacks something, or is of other weights (WeightsError)."""
    try:
        TrainedOn.read(about["trained_on"])
        key, columns, _ = str(about["weights_key"]), int(about["columns"]), about["steps"]
        if (scores := about["record"].get(MAP_SCORES)) is not None:
            MapScores.read(scores)
    except (KeyError, TypeError, ValueError) as error:
        raise _refused(path, f"its description lacks {error}") from error
    if key != weights_key or columns != described.config.columns:
        raise WeightsError(
            f"{path} says what is familiar to other weights ({key}, {columns} columns) than those beside it"
            f" ({weights_key}, {described.config.columns}): move it away, or measure it for them with"
            f" spectralzoom train DATASET --familiar WEIGHTS -o {path.name}"
        )


def _refused(path: Path, why: str) -> WeightsError:
    return WeightsError(
        f"{path} does not say what is familiar to weights ({why}); move it away, or make it again with"
        f" spectralzoom train DATASET --familiar WEIGHTS -o {path.name}"
    )

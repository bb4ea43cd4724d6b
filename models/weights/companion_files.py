"""Sealed files beside weights: what is familiar, how what maps expect came true, and their reader of memories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from models.evaluation.expected_scores import MapScores
from models.network.sizes import MemorySizes
from models.reading.familiar import Familiar, Limits
from models.weights.files import Description, content_key, unusable
from models.weights.sealed_files import beside, changed_tensor, key_of_sealed, open_sealed, own_tensors, write_sealed
from pipeline.errors import WeightsError
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import torch

    import models.network.memory_reader as memory_reader
    from models.network.memory_reader import MemoryReader
else:
    torch = deferred("torch")
    memory_reader = deferred("models.network.memory_reader")

TRAINED_ON = "trained_on"  # its entry in a record

Range = tuple[float, float]
FAMILIAR_FORMAT = "spectralzoom-familiar/1"
MAP_SCORES = "map_scores"  # of the record: how what maps expect to score came true, where that was measured
FAMILIAR_SUFFIX = ".familiar.safetensors"
OF_COMPONENTS = ("centres", "covariance", "shot", "read")
OF_LIMITS = ("rates", "light", "fine", "coarse")
MEMORY_FORMAT = "spectralzoom-memory/1"
MEMORY_SUFFIX = ".memory.safetensors"
MOST_WIDTH = 1024


@dataclass(frozen=True)
class TrainedOn:
    """Ranges of what training saw; None where nobody knows."""

    bands: int
    wavelength_nm: Range
    exposure_ms: Range
    scenes: int
    classes: tuple[str, ...]
    day: tuple[int, int] | None = None  # of the year
    sun_elevation_deg: Range | None = None
    ground_pixel_m: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a record; `read` gives them back."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @staticmethod
    def read(content: Mapping[str, Any]) -> TrainedOn:
        """Read what `as_dict` gave. Raises KeyError, TypeError or ValueError where that is not what it is."""
        return TrainedOn(
            int(content["bands"]),
            _range(content["wavelength_nm"]),
            _range(content["exposure_ms"]),
            int(content["scenes"]),
            tuple(map(str, content["classes"])),
            None if content["day"] is None else (int(content["day"][0]), int(content["day"][1])),
            None if content["sun_elevation_deg"] is None else _range(content["sun_elevation_deg"]),
            None if content["ground_pixel_m"] is None else float(content["ground_pixel_m"]),
        )


def _range(values: Any) -> Range:
    low, high = map(float, values)
    return low, high


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
    return beside(weights, FAMILIAR_SUFFIX)


def save_familiar(made: FamiliarWeights, path: Path) -> None:
    """Write the file, sealed; whole or absent. Raises WeightsError where the disk refuses."""
    familiar, limits = made.familiar, made.familiar.limits
    arrays = {name: getattr(familiar, name) for name in OF_COMPONENTS}
    arrays |= {name: getattr(limits, name) for name in OF_LIMITS}
    about = {
        "format": FAMILIAR_FORMAT,
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
    with open_sealed(path, "np", FAMILIAR_FORMAT, _refused) as (_, about):
        _checked(path, about, described, weights_key)
    scores = about["record"].get(MAP_SCORES)
    told = None if scores is None else MapScores.read(scores)
    return FamiliarFile(path, familiar_key(path), TrainedOn.read(about["trained_on"]), told)


def familiar_key(path: Path) -> str:
    """Name the file by what it holds, 20 hexadecimal digits. Raises WeightsError where it cannot be read."""
    return key_of_sealed(path, FAMILIAR_FORMAT, _refused)


def load_familiar(weights: Path, described: Description) -> FamiliarWeights:
    """Read a file that `save_familiar` wrote beside some weights. No pickle is involved.

    Raises WeightsError where it is damaged, of another format, or was measured for other weights.
    """
    path = familiar_path(weights)
    with open_sealed(path, "pt", FAMILIAR_FORMAT, _refused) as (file, about):
        _checked(path, about, described, content_key(weights))
        tensors = own_tensors(file)
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


@dataclass(frozen=True)
class MemoryWeights:
    """A reader of memories, the weights that it goes with and how it was trained."""

    reader: MemoryReader
    weights_key: str
    class_names: tuple[str, ...]
    record: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ReaderFile:
    """A reader of memories by its file: where it lies, what it holds, and how large it is."""

    path: Path
    key: str
    sizes: MemorySizes


def describe_reader(weights: Path, described: Description) -> ReaderFile | None:
    """The reader of memories beside some weights, by what its file says; None where there is none.

    Reads no tensor, and takes no torch. Raises WeightsError as `load_memory` where the description is wrong.
    """
    path = memory_path(weights)
    if not path.is_file():
        return None
    with open_sealed(path, "np", MEMORY_FORMAT, _refused_reader) as (_, about):
        sizes = _checked_reader(path, about, described)
    return ReaderFile(path, memory_key(path), sizes)


def memory_path(weights: Path) -> Path:
    """Where the reader of memories that goes with some weights lies: beside them, by their name."""
    return beside(weights, MEMORY_SUFFIX)


def save_memory(memory: MemoryWeights, path: Path) -> None:
    """Write the file, sealed; whole or absent. Raises WeightsError where the disk refuses."""
    about = {
        "format": MEMORY_FORMAT,
        "sizes": memory.reader.sizes.as_dict(),
        "weights_key": memory.weights_key,
        "class_names": list(memory.class_names),
        "record": dict(memory.record),
    }
    try:
        write_sealed(path, about, dict(memory.reader.state_dict()))
    except OSError as error:
        raise WeightsError(
            f"cannot write the reader of memories to {path}: {error.strerror}; choose another -o"
        ) from error


def memory_key(path: Path) -> str:
    """Name a reader by what it holds, 20 hexadecimal digits. Raises WeightsError where the file cannot be read."""
    return key_of_sealed(path, MEMORY_FORMAT, _refused_reader)


def load_memory(path: Path, described: Description) -> MemoryWeights:
    """Read a file that ``save_memory`` wrote, for weights so described. No pickle is involved.

    Raises WeightsError where it is damaged, of another format, or for other classes or columns than the weights have.
    """
    with open_sealed(path, "pt", MEMORY_FORMAT, _refused_reader) as (file, about):
        sizes = _checked_reader(path, about, described)
        tensors = own_tensors(file)
    if wrong := changed_tensor(about, tensors) or unusable(tensors, spreads=()):
        raise _refused_reader(path, wrong)
    with torch.device("meta"):
        reader = memory_reader.MemoryReader(sizes)
    try:
        reader.load_state_dict(tensors, assign=True)
    except RuntimeError as error:
        raise _refused_reader(path, str(error).splitlines()[-1].strip()) from error
    names = tuple(map(str, about["class_names"]))
    return MemoryWeights(reader.eval(), str(about["weights_key"]), names, dict(about["record"]))


def _checked_reader(path: Path, about: Mapping[str, Any], described: Description) -> MemorySizes:
    """Sizes that can be built, for the classes and columns that the weights have."""
    try:
        sizes = MemorySizes(**about["sizes"])
        names = tuple(map(str, about["class_names"]))
        _ = about["weights_key"], about["record"]
    except (KeyError, TypeError) as error:
        raise _refused_reader(path, f"its description lacks {error}") from error
    config = described.config
    wanted = (config.classes, config.columns, config.factor)
    if names != described.class_names or (sizes.classes, sizes.columns, sizes.factor) != wanted:
        raise WeightsError(
            f"{path} reads memories of {sizes.classes} classes, {sizes.columns} columns and a factor of {sizes.factor},"
            f" the weights have {wanted}, or call the classes otherwise: train one for them with"
            f" spectralzoom train DATASET --remember WEIGHTS -o {path.name}"
        )
    if not 0 < sizes.width <= MOST_WIDTH or not 0 < sizes.coarse_width <= MOST_WIDTH:
        raise _refused_reader(path, f"widths of {sizes.width} and {sizes.coarse_width} are none that anybody builds")
    return sizes


def _refused_reader(path: Path, why: str) -> WeightsError:
    return WeightsError(f"{path} is no readable file of a reader of memories ({why}); train or copy it again")

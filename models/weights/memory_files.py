"""Readers of memories on disk: a sealed file beside the weights whose maps they were trained on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from models.network.sizes import MemorySizes
from models.weights.files import Description, unusable
from models.weights.sealed_files import beside, changed_tensor, key_of_sealed, open_sealed, write_sealed
from pipeline.errors import WeightsError
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import torch

    import models.network.memory_reader as memory_reader
    from models.network.memory_reader import MemoryReader
else:
    torch = deferred("torch")
    memory_reader = deferred("models.network.memory_reader")

FORMAT = "spectralzoom-memory/1"
SUFFIX = ".memory.safetensors"
MOST_WIDTH = 1024


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
    with open_sealed(path, "np", FORMAT, _refused) as (_, about):
        sizes = _checked(path, about, described)
    return ReaderFile(path, memory_key(path), sizes)


def memory_path(weights: Path) -> Path:
    """Where the reader of memories that goes with some weights lies: beside them, by their name."""
    return beside(weights, SUFFIX)


def save_memory(memory: MemoryWeights, path: Path) -> None:
    """Write the file, sealed; whole or absent. Raises WeightsError where the disk refuses."""
    about = {
        "format": FORMAT,
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
    return key_of_sealed(path, FORMAT, _refused)


def load_memory(path: Path, described: Description) -> MemoryWeights:
    """Read a file that ``save_memory`` wrote, for weights so described. No pickle is involved.

    Raises WeightsError where it is damaged, of another format, or for other classes or columns than the weights have.
    """
    with open_sealed(path, "pt", FORMAT, _refused) as (file, about):
        sizes = _checked(path, about, described)
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    if wrong := changed_tensor(about, tensors) or unusable(tensors, spreads=()):
        raise _refused(path, wrong)
    with torch.device("meta"):
        reader = memory_reader.MemoryReader(sizes)
    try:
        reader.load_state_dict(tensors, assign=True)
    except RuntimeError as error:
        raise _refused(path, str(error).splitlines()[-1].strip()) from error
    names = tuple(map(str, about["class_names"]))
    return MemoryWeights(reader.eval(), str(about["weights_key"]), names, dict(about["record"]))


def _checked(path: Path, about: Mapping[str, Any], described: Description) -> MemorySizes:
    """Sizes that can be built, for the classes and columns that the weights have."""
    try:
        sizes = MemorySizes(**about["sizes"])
        names = tuple(map(str, about["class_names"]))
        _ = about["weights_key"], about["record"]
    except (KeyError, TypeError) as error:
        raise _refused(path, f"its description lacks {error}") from error
    config = described.config
    wanted = (config.classes, config.columns, config.factor)
    if names != described.class_names or (sizes.classes, sizes.columns, sizes.factor) != wanted:
        raise WeightsError(
            f"{path} reads memories of {sizes.classes} classes, {sizes.columns} columns and a factor of {sizes.factor},"
            f" the weights have {wanted}, or call the classes otherwise: train one for them with"
            f" spectralzoom train DATASET --remember WEIGHTS -o {path.name}"
        )
    if not 0 < sizes.width <= MOST_WIDTH or not 0 < sizes.coarse_width <= MOST_WIDTH:
        raise _refused(path, f"widths of {sizes.width} and {sizes.coarse_width} are none that anybody builds")
    return sizes


def _refused(path: Path, why: str) -> WeightsError:
    return WeightsError(f"{path} is no readable file of a reader of memories ({why}); train or copy it again")

"""Training that goes on after it was killed: everything a run needs to continue, in one sealed file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import Tensor

from models.weights.sealed_files import DAMAGED, broken_seal, changed_tensor, read_about, write_sealed
from pipeline.errors import WeightsError

FORMAT, UNSEALED = "spectralzoom-checkpoint/2", "spectralzoom-checkpoint/1"  # the earlier one has no hashes
Checkpoint = tuple[dict[str, Any], dict[str, Tensor]]


def save_checkpoint(path: Path, identity: str, about: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Replace the checkpoint by a temporary name and a rename, so that it is always a whole one.

    Raises
    ------
    WeightsError : the disk refuses.
    """
    try:
        write_sealed(path, {"format": FORMAT, "identity": identity, **about}, tensors)
    except OSError as error:
        raise WeightsError(f"cannot keep the state of training in {path}: {error.strerror}; free some space") from error


def load_checkpoint(path: Path, identity: str) -> Checkpoint | None:
    """Read the checkpoint of the same training run; None where there is none, or one of another run.

    Raises
    ------
    WeightsError : what lies there is not what was written. Nothing of it is used, and it is left where it is.
    """
    found = read_checkpoint(path)
    return None if found is None or found[0]["identity"] != identity else found


def read_checkpoint(path: Path) -> Checkpoint | None:
    """Read a checkpoint, of whichever run; None where there is no file. Raises WeightsError as ``load_checkpoint``."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            about = read_about(file)
            wrong = _stranger(about) or broken_seal(about)
            tensors = {} if wrong else {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except DAMAGED as error:
        raise _refused(path, str(error)[:120]) from error
    if wrong := wrong or changed_tensor(about, tensors):
        raise _refused(path, wrong)
    return about, tensors


def _stranger(about: dict[str, Any]) -> str:
    """Why a description is no checkpoint's, in words; nothing where it is one's."""
    kind = about.get("format")
    if kind == UNSEALED:
        return "an earlier version wrote it, without hashes to check it by"
    return "" if kind == FORMAT else f"it holds {kind or 'no format mark'}, expected {FORMAT}"


def _refused(path: Path, why: str) -> WeightsError:
    return WeightsError(
        f"the state of training in {path} cannot be gone on from: {why}; bring back a copy of it, or delete it to begin"
        " anew"
    )

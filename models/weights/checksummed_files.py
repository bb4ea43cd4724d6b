"""Files of tensors that say what they hold: safetensors with the hash of every tensor and of the description itself.

The hashes lie in the description, the one text beside the tensors. They tell damage, not forgery: whoever can write the
file can seal it anew.

A checkpoint of training is one: everything that a run needs to go on after it was killed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open

from pipeline.errors import WeightsError
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import safetensors.torch as safetensors_torch
    import torch
    from torch import Tensor
else:
    torch = deferred("torch")
    safetensors_torch = deferred("safetensors.torch")

KEY_DIGITS = 20
ABOUT = "about"  # the text's name in the file
TENSORS, SEAL = "tensors", "seal"  # entries of the description: hashes of the tensors by name, and its own
# what reading a description may raise over bytes that are not what they should be
DAMAGED = (SafetensorError, OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError)
CHECKPOINT = "spectralzoom-checkpoint/2"
Checkpoint = tuple[dict[str, Any], "dict[str, Tensor]"]


def write_checksummed(path: Path, about: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Write the file by a temporary name and a rename, so that it is whole or absent. Raises OSError."""
    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    plain = {name: value for name, value in about.items() if name not in (TENSORS, SEAL)}
    hashed = {**plain, TENSORS: {name: hash_of(tensor) for name, tensor in whole.items()}}
    text = json.dumps({**hashed, SEAL: _seal(hashed)}, sort_keys=True)
    temporary = path.with_name(path.name + ".part")
    try:
        temporary.write_bytes(safetensors_torch.save(whole, {ABOUT: text}))
        temporary.replace(path)
    except OSError:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def read_about(file: Any) -> dict[str, Any]:
    """Give the description of a file that `safetensors.safe_open` opened; empty where there is none."""
    about = json.loads((file.metadata() or {}).get(ABOUT, "{}"))
    return about if isinstance(about, dict) else {}


def own_tensors(file: Any, start: str = "") -> dict[str, Tensor]:
    """Tensors of a file that `safetensors.safe_open` opened whose names begin so, by name, in memory of their own.

    What safetensors gives lies in the mapped file, and would change with it where that is written over.
    """
    return {name: file.get_tensor(name).clone() for name in file.keys() if name.startswith(start)}  # noqa: SIM118


def broken_seal(about: Mapping[str, Any]) -> str:
    """Why a description is not what was written, in words; nothing where it is."""
    told = about.get(SEAL)
    if told is None or not isinstance(about.get(TENSORS), dict):
        return "its hashes are missing"
    return "" if told == _seal(about) else "its description is not what was written"


def changed_tensor(told: Mapping[str, str], tensors: Mapping[str, Tensor]) -> str:
    """Which tensor is not the one that was written, by their hashes, in words; nothing where all are."""
    if other := sorted(set(told) ^ set(tensors)):
        return f"tensor {other[0]} is {'missing' if other[0] in told else 'none of those that were written'}"
    changed = next((name for name, tensor in tensors.items() if hash_of(tensor) != told[name]), None)
    return "" if changed is None else f"tensor {changed} is not what was written"


def hash_of(tensor: Tensor) -> str:
    """SHA-256 of a tensor's kind, shape and numbers, in hexadecimal digits."""
    digest = hashlib.sha256(f"{tensor.dtype} {tuple(tensor.shape)}\n".encode())
    digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _seal(about: Mapping[str, Any]) -> str:
    """Hash of a description without its seal, whatever the order and the spaces of its text."""
    plain = {name: value for name, value in about.items() if name != SEAL}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def key_of(about: Mapping[str, Any], hashes: Mapping[str, str]) -> str:
    """Name a description and its tensors by what they hold, 20 hexadecimal digits."""
    return hashlib.sha256(json.dumps([about, hashes], sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]


def save_checkpoint(path: Path, identity: str, about: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Replace the checkpoint by a temporary name and a rename, so that it is always a whole one.

    Raises WeightsError where the disk refuses.
    """
    try:
        write_checksummed(path, {"format": CHECKPOINT, "identity": identity, **about}, tensors)
    except OSError as error:
        raise WeightsError(f"cannot keep the state of training in {path}: {error.strerror}; free some space") from error


def load_checkpoint(path: Path, identity: str) -> Checkpoint | None:
    """Read the checkpoint of the same training run; None where there is none, or one of another run.

    Raises WeightsError where what lies there is not what was written. Nothing of it is used, and it is left where it
    is.
    """
    found = read_checkpoint(path)
    return None if found is None or found[0]["identity"] != identity else found


def read_checkpoint(path: Path) -> Checkpoint | None:
    """Read a checkpoint, of whichever run; None where there is no file. Raises WeightsError as ``load_checkpoint``."""
    if not path.is_file():
        return None
    tensors: dict[str, Tensor] = {}
    try:
        with safe_open(path, framework="pt") as file:
            about = read_about(file)
            kind = about.get("format")
            if kind != CHECKPOINT:
                wrong = f"it holds {kind or 'no format mark'}, expected {CHECKPOINT}"
            elif not (wrong := broken_seal(about)):
                tensors = own_tensors(file)
                wrong = changed_tensor(about[TENSORS], tensors)
    except DAMAGED as error:
        raise _refused(path, str(error)[:120]) from error
    if wrong:
        raise _refused(path, wrong)
    return about, tensors


def _refused(path: Path, why: str) -> WeightsError:
    return WeightsError(
        f"the state of training in {path} cannot be gone on from: {why}; bring back a copy of it, or delete it to begin"
        " anew"
    )

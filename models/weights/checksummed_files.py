"""Files of tensors that say what they hold: safetensors with the hash of every tensor and of the description itself.

The hashes lie in the description, the one text beside the tensors. They tell damage, not forgery: whoever can write the
file can seal it anew.

A checkpoint of training is one: everything that a run needs to go on after it was killed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
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


class NotChecksummedError(ValueError):
    """A file is not what was written; its text goes on from the file's name, and says in what."""


def read_about(path: Path, kind: str) -> dict[str, Any]:
    """Read a file's description, without its tensors. NotSealedError: damaged, or no file of this ``kind``."""
    with _opened(path, "np") as file:
        about = json.loads((file.metadata() or {}).get(ABOUT, "{}"))
    about = about if isinstance(about, dict) else {}
    if about.get("format") != kind:
        raise NotChecksummedError(f"holds {about.get('format', 'no format mark')}, expected {kind}")
    if about.get(SEAL) is None or not isinstance(about.get(TENSORS), dict):
        raise NotChecksummedError("is damaged: its hashes are missing")
    if about[SEAL] != _seal(about):
        raise NotChecksummedError("is damaged: its description is not what was written")
    return about


def read_tensors(
    path: Path, about: Mapping[str, Any], wanted: Callable[[str], bool] = lambda name: True
) -> dict[str, Tensor]:
    """Read the tensors whose names are ``wanted``, in memory of their own. NotSealedError: one is not what was written.

    What safetensors gives lies in the mapped file, and would change with it where that is written over.
    """
    with _opened(path, "pt") as file:
        tensors = {name: file.get_tensor(name).clone() for name in file.keys() if wanted(name)}  # noqa: SIM118
    hashes = {name: value for name, value in about[TENSORS].items() if wanted(name)}
    for name in sorted(set(hashes) ^ set(tensors)):
        what = "missing" if name in hashes else "none of those that were written"
        raise NotChecksummedError(f"is damaged: tensor {name} is {what}")
    for name, tensor in tensors.items():
        if hash_of(tensor) != hashes[name]:
            raise NotChecksummedError(f"is damaged: tensor {name} is not what was written")
    return tensors


def claimed_shapes(path: Path) -> dict[str, tuple[tuple[int, ...], str]]:
    """Shape and kind of number of every tensor by a file's header, no tensor read. Raises NotSealedError."""
    with _opened(path, "np") as file:
        parts = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
        return {name: (tuple(one.get_shape()), one.get_dtype()) for name, one in parts.items()}


@contextmanager
def _opened(path: Path, framework: str) -> Iterator[Any]:
    try:
        with safe_open(path, framework=framework) as file:
            yield file
    except DAMAGED as error:
        raise NotChecksummedError(f"is not a readable safetensors file ({str(error)[:200]})") from error


def hash_of(tensor: Tensor) -> str:
    """SHA-256 of a tensor's kind, shape and numbers, in hexadecimal digits."""
    digest = hashlib.sha256(f"{tensor.dtype} {tuple(tensor.shape)}\n".encode())
    digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _seal(about: Mapping[str, Any]) -> str:
    """Hash of a description without its seal, whatever the order and the spaces of its text."""
    plain = {name: value for name, value in about.items() if name != SEAL}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def key_of(about: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> str:
    """Name a description and its tensors by what they hold, 20 hexadecimal digits."""
    hashes = {name: hash_of(tensor) for name, tensor in tensors.items()}
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

    Raises WeightsError as `read_checkpoint`.
    """
    found = read_checkpoint(path)
    return None if found is None or found[0]["identity"] != identity else found


def read_checkpoint(path: Path) -> Checkpoint | None:
    """Read a checkpoint, of whichever run; None where there is no file.

    Raises WeightsError where what lies there is not what was written. Nothing of it is used, and it is left where it
    is.
    """
    if not path.is_file():
        return None
    try:
        about = read_about(path, CHECKPOINT)
        return about, read_tensors(path, about)
    except NotChecksummedError as error:
        raise WeightsError(
            f"the state of training in {path} cannot be gone on from: it {error}; bring back a copy of it, or delete it"
            " to begin anew"
        ) from error

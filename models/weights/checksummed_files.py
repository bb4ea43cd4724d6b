"""Read and write checksummed files of tensors: safetensors with a description and the hashes of both.

The description is the only text of the file. It has the hash of every tensor and its own, which detect damage, not
forgery. Checkpoints of trainings are such files.
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
ABOUT = "about"  # name of the text in the file
TENSORS, SEAL = "tensors", "seal"  # entries of the description: hashes of the tensors, and its own
# errors of reading damaged bytes
DAMAGED = (SafetensorError, OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError)
CHECKPOINT = "spectralzoom-checkpoint/2"
Checkpoint = tuple[dict[str, Any], "dict[str, Tensor]"]


def write_checksummed(path: Path, about: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Write a file by a temporary name and a rename, so that it is complete or absent. Raises OSError."""
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
    """Damaged file; the message follows the file's name."""


def read_about(path: Path, kind: str) -> dict[str, Any]:
    """Read the description of a file. Raises NotChecksummedError: it is damaged, or not of this ``kind``."""
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
    """Read a copy of the ``wanted`` tensors. Raises NotChecksummedError: one differs from its hash, or is missing.

    Tensors of safetensors lie in the mapped file and would change with it.
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


@contextmanager
def _opened(path: Path, framework: str) -> Iterator[Any]:
    try:
        with safe_open(path, framework=framework) as file:
            yield file
    except DAMAGED as error:
        raise NotChecksummedError(f"is not a readable safetensors file ({str(error)[:200]})") from error


def hash_of(tensor: Tensor) -> str:
    """Return the SHA-256 of a tensor's type, shape and numbers, in hexadecimal digits."""
    digest = hashlib.sha256(f"{tensor.dtype} {tuple(tensor.shape)}\n".encode())
    digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _seal(about: Mapping[str, Any]) -> str:
    """Return the hash of a description without its own hash."""
    plain = {name: value for name, value in about.items() if name != SEAL}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def key_of(about: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> str:
    """Return the hash of a description and its tensors, 20 hexadecimal digits."""
    hashes = {name: hash_of(tensor) for name, tensor in tensors.items()}
    return hashlib.sha256(json.dumps([about, hashes], sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]


def save_checkpoint(path: Path, identity: str, about: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Replace the checkpoint atomically. Raises WeightsError for an error of the disk."""
    try:
        write_checksummed(path, {"format": CHECKPOINT, "identity": identity, **about}, tensors)
    except OSError as error:
        raise WeightsError(f"cannot write the checkpoint {path}: {error.strerror}; free some space") from error


def load_checkpoint(path: Path, identity: str) -> Checkpoint | None:
    """Read the checkpoint of this training run; None without one. Raises WeightsError as `read_checkpoint`."""
    found = read_checkpoint(path)
    return None if found is None or found[0]["identity"] != identity else found


def read_checkpoint(path: Path) -> Checkpoint | None:
    """Read the checkpoint of any run; None without a file. Raises WeightsError: it is damaged; the file stays."""
    if not path.is_file():
        return None
    try:
        about = read_about(path, CHECKPOINT)
        return about, read_tensors(path, about)
    except NotChecksummedError as error:
        raise WeightsError(
            f"the checkpoint {path} cannot be resumed: it {error}; restore a copy of it, or delete it to start again"
        ) from error

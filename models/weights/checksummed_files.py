"""Read and write checksummed files of tensors: safetensors with a description and the hashes of both.

The description is the only text of the file. It has the hash of every tensor and its own, which detect damage, not
forgery. Weights and checkpoints of trainings are such files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open

from spectralzoom.pipeline.errors import WeightsError

if TYPE_CHECKING:
    from torch import Tensor

KEY_DIGITS = 20
ABOUT = "about"  # name of the text in the file
TENSORS, SEAL = "tensors", "seal"  # entries of the description: hashes of the tensors, and its own
DAMAGED = (SafetensorError, OSError, KeyError, TypeError, ValueError, RecursionError, RuntimeError)
CHECKPOINT = "spectralzoom-checkpoint/2"
REMEDY = "restore a copy of it, name another file, or move it elsewhere and train or measure it again"
ANOTHER = "it is of another version; train anew: spectralzoom train DATASET -o FILE.safetensors, or name another file"


def write_checksummed(path: Path, about: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Write a file by a temporary name and a rename, so that it is complete or absent.

    Raises WeightsError for an error of the disk.
    """
    import safetensors.torch as safetensors_torch

    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    hashed = {**about, TENSORS: {name: hash_of(tensor) for name, tensor in whole.items()}}
    text = json.dumps({**hashed, SEAL: _seal(hashed)}, sort_keys=True)
    temporary = path.with_name(path.name + ".part")
    try:
        temporary.write_bytes(safetensors_torch.save(whole, {ABOUT: text}))
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise WeightsError(f"cannot write {path}: {error.strerror}; free some space or choose another -o") from error


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """Turn errors of damaged or forged content into a WeightsError with the file's name and the remedy."""
    try:
        yield
    except WeightsError:
        raise
    except DAMAGED as error:
        other = type(error) in (TypeError, RuntimeError)  # of sizes and layers that this version does not know
        why = ANOTHER if other else f"{' '.join(str(error).split())[:300]}; {REMEDY}"
        raise WeightsError(f"cannot read {path}: {why}") from error


def read_about(path: Path, kind: str, remedy: str = REMEDY) -> dict[str, Any]:
    """Read the description of a file of a ``kind``, without torch. Raises WeightsError: it is damaged, or another.

    ``remedy`` is the advice for one of another kind.
    """
    with refusing(path), path.open("rb"), safe_open(path, framework="np") as file:  # which takes refusal for absence
        about = json.loads((file.metadata() or {}).get(ABOUT, "{}"))
        if (written := about.get("format", "no format mark")) != kind:
            raise WeightsError(f"cannot read {path}: it holds {written}, expected {kind}; {remedy}")
        if about.get(SEAL) != _seal(about):
            raise ValueError("it is damaged: its description is not what was written")
    return dict(about)


def read_tensors(
    path: Path, about: Mapping[str, Any], wanted: Callable[[str], bool] = lambda name: True
) -> dict[str, Tensor]:
    """Read a copy of the ``wanted`` tensors. Raises WeightsError: one differs from its hash, or is missing.

    Tensors of safetensors lie in the mapped file and would change with it.
    """
    with refusing(path), safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name).clone() for name in file.keys() if wanted(name)}  # noqa: SIM118
        hashes = {name: value for name, value in about[TENSORS].items() if wanted(name)}
        for name in sorted(hashes.keys() | tensors.keys()):
            if name not in tensors or hash_of(tensors[name]) != hashes.get(name):
                raise ValueError(f"it is damaged, or changed while it was read: tensor {name} is not what was written")
    return tensors


def hash_of(tensor: Tensor) -> str:
    """Return the SHA-256 of a tensor's type, shape and numbers, in hexadecimal digits."""
    import torch

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
    write_checksummed(path, {"format": CHECKPOINT, "identity": identity, **about}, tensors)


def load_checkpoint(path: Path, identity: str | None = None) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
    """Read the checkpoint of a training run, or of any; None without a file, or where it is of another run.

    Raises WeightsError: it is damaged; the file stays.
    """
    if not path.is_file():
        return None
    about = read_about(path, CHECKPOINT)
    tensors = read_tensors(path, about)
    return (about, tensors) if identity in (None, about["identity"]) else None

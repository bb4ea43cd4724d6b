"""Training that goes on after it was killed: everything a run needs to continue, in one safetensors file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from pipeline.errors import WeightsError

FORMAT = "spectralzoom-checkpoint/1"


def save_checkpoint(path: Path, identity: str, about: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Replace the checkpoint by a temporary name and a rename, so that it is always a whole one.

    Raises
    ------
    WeightsError : the disk refuses.
    """
    temporary = path.with_name(path.name + ".part")
    content = {"about": json.dumps({"format": FORMAT, "identity": identity, **about})}
    whole = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    try:
        temporary.write_bytes(save(whole, content))
        temporary.replace(path)
    except OSError as error:
        raise WeightsError(f"cannot keep the state of training in {path}: {error.strerror}; free some space") from error


def load_checkpoint(path: Path, identity: str) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
    """Read the checkpoint of the same training run; None where none can be read, or it is of another run."""
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("about", "{}"))
            if about.get("format") != FORMAT or about.get("identity") != identity:
                return None
            return about, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (OSError, SafetensorError, json.JSONDecodeError):
        return None

"""Files of other people's weights: read as plain tensors, never as Python objects that could run code."""

from __future__ import annotations

import pickle
import re
import struct
import warnings
from collections.abc import Mapping
from pathlib import Path
from zipfile import BadZipFile

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor

from pipeline.errors import WeightsError

WRAPPERS = ("model", "state_dict", "model_state_dict", "model_ema", "module")
DAMAGED = (  # what the readers raise over bytes that are not what they should be
    SafetensorError,
    RuntimeError,
    EOFError,
    OSError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    AssertionError,
    BadZipFile,
    struct.error,
    MemoryError,
)
PREFIX = "module."  # what training on several devices puts before every name


def read_state(path: Path) -> dict[str, Tensor]:
    """Read named tensors of a ``.safetensors`` file or of one that torch saved; wrappers around them are opened.

    Raises WeightsError for a file that is missing, cut short, without tensors or with one larger than itself, or that
    holds Python objects, which are refused unread.
    """
    if not path.is_file():
        raise WeightsError(f"no file of weights at {path}; give the path of a .safetensors or .pth file")
    found = unwrap_state(_read(path), str(path))
    size = path.stat().st_size
    for name, tensor in found.items():  # one number repeated would fill the memory
        if tensor.numel() * tensor.element_size() > size:
            raise WeightsError(
                f"{path} claims {tuple(tensor.shape)} numbers for the tensor {name}, more than its {size} bytes hold;"
                " save the state dict again, every tensor contiguous"
            )
    return found


def read_notes(path: Path) -> dict[str, str]:
    """Texts that lie beside the tensors of a file: safetensors' own, or entries of what torch saved, by their names.

    Raises WeightsError as `read_state`.
    """
    if path.suffix != ".safetensors":
        content = _read(path)
        whole = content if isinstance(content, Mapping) else {}
        return {str(name): value for name, value in whole.items() if isinstance(value, str)}
    try:
        with safe_open(path, framework="np") as file:
            return dict(file.metadata() or {})
    except DAMAGED as error:
        raise WeightsError(f"{path} is damaged or no file of weights ({_first_line(error)}); copy it again") from error


def _read(path: Path) -> object:
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other pickles than its own: it refuses what it does not know
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        if "weights_only" in str(error).lower() or "unsupported" in str(error).lower():
            raise WeightsError(
                f"{path} holds more than tensors, or is none of torch's files; Python objects are never loaded, they"
                " can run code: save the state dict alone, as .safetensors or with torch.save"
            ) from error
        raise WeightsError(f"{path} is damaged or no file of weights ({_first_line(error)}); copy it again") from error
    except DAMAGED as error:
        raise WeightsError(f"{path} is damaged or no file of weights ({_first_line(error)}); copy it again") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120] or type(error).__name__


def unwrap_state(content: object, place: str) -> dict[str, Tensor]:
    """Give the named tensors inside ``model``, ``state_dict`` and the like, without prefixes of parallel training.

    Raises WeightsError where there are no named tensors; says what there is instead.
    """
    inside = content
    while isinstance(inside, Mapping):
        tensors = {str(name): value for name, value in inside.items() if isinstance(value, Tensor)}
        if tensors:
            every = all(name.startswith(PREFIX) for name in tensors)
            return {name.removeprefix(PREFIX) if every else name: value for name, value in tensors.items()}
        inside = next((inside[name] for name in WRAPPERS if name in inside), None)
    found = ", ".join(map(str, list(content)[:5])) if isinstance(content, Mapping) else type(content).__name__
    raise WeightsError(f"{place} has no named tensors, it has: {found or 'nothing'}; give a state dict")


def read_heads(checkpoint: Path) -> int:
    """Attention heads by the ``variant.yml`` beside a Segmenter checkpoint: the shapes of its tensors do not tell.

    Raises WeightsError where it is missing, damaged, or lacks the entry.
    """
    path = checkpoint.with_name("variant.yml")
    try:
        found = re.search(r"^\s+n_heads:(.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
        if found is None:
            raise WeightsError(f"{path} lacks 'n_heads'; copy the file that came with {checkpoint.name}")
        return int(found[1])
    except FileNotFoundError:
        raise WeightsError(
            f"no variant.yml beside {checkpoint}; copy it there, it says how many heads it has"
        ) from None
    except (OSError, ValueError) as error:
        raise WeightsError(f"cannot use {path} ({_first_line(error)}); copy the one of {checkpoint.name}") from error

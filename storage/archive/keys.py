"""Keys of stages: a hash of what went in, so that the same work has the same address."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ArchiveError

KEY_LENGTH = 20
SIGNIFICANT_DIGITS = 12


def stage_key(
    stage: str, version: int | str, params: Mapping[str, Any], inputs: Sequence[str] | Mapping[str, str]
) -> str:
    """Key of one stage's output: 20 hex digits of the SHA-256 of stage, version, parameters and input keys.

    Floats count to 12 significant digits, 2 and 2.0 alike; the order of parameters does not count, that of a list of
    inputs does. Raises ArchiveError: a parameter is of a kind that has no lasting text, such as a function.
    """
    facts = {"stage": stage, "version": str(version), "params": params, "inputs": inputs}
    return hashlib.sha256(canonical_json(facts).encode()).hexdigest()[:KEY_LENGTH]


def canonical_json(value: object) -> str:
    """One text for one meaning: sorted names, quantised floats, no spaces."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def plain(value: object) -> Any:
    """The value as JSON knows it. Arrays become the hash of their bytes; NaN and infinities become words."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            return f"{value}"
        rounded = float(f"{value:.{SIGNIFICANT_DIGITS}g}")
        return int(rounded) if rounded.is_integer() and abs(rounded) < 2.0**53 else rounded
    if isinstance(value, PurePath):
        return value.as_posix()
    if isinstance(value, bytes):
        return {"sha256": hashlib.sha256(value).hexdigest()}
    if isinstance(value, np.ndarray):
        if value.dtype.kind == "O":
            raise ArchiveError("an array of objects cannot be part of a key; give numbers")
        content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"dtype": value.dtype.str, "shape": list(value.shape), "sha256": content}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, set | frozenset):
        return sorted((plain(entry) for entry in value), key=lambda entry: json.dumps(entry, sort_keys=True))
    if isinstance(value, Sequence):
        return [plain(entry) for entry in value]
    raise ArchiveError(f"{type(value).__name__} {value!r} cannot be part of a key; give numbers, text, lists or tables")


def array_digest(array: NDArray[np.generic]) -> str:
    """Hash of an array's shape and values."""
    return hashlib.sha256(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes()).hexdigest()[:20]

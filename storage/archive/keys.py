"""Compute the keys of stores, hashes of everything that determines their content, and the addresses in an archive.

Find stores and runs among other files, and check that a folder can be an archive.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import secrets
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import ArchiveError
from spectralzoom.storage.archive.staging import MANIFEST_NAME, PART_SUFFIX, check_name, is_name, refusals, sync_path

KEY_LENGTH = 20
SIGNIFICANT_DIGITS = 12


def stage_key(stage: str, version: int | str, params: Mapping[str, Any], inputs: Sequence[str]) -> str:
    """Return the key of one stage's output: 20 hex digits of the SHA-256 of stage, version, parameters and input keys.

    Floats count to 12 significant digits, 2 and 2.0 alike; the order of parameters does not count, that of a list of
    inputs does. Raises ArchiveError: a parameter is of a kind that has no lasting text, such as a function.
    """
    facts = {"stage": stage, "version": str(version), "params": params, "inputs": inputs}
    return hashlib.sha256(canonical_json(facts).encode()).hexdigest()[:KEY_LENGTH]


def canonical_json(value: object) -> str:
    """Return the same text for the same meaning: sorted names, quantised floats, no spaces."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def plain(value: object) -> Any:
    """Return the value in JSON types. Arrays become the hash of their bytes; NaN and infinities become text."""
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
        return {
            "dtype": value.dtype.str,
            "shape": list(value.shape),
            "sha256": hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest(),
        }
    if hasattr(value, "key") and not isinstance(value, type):
        return plain(value.key)
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, set | frozenset):
        return sorted((plain(entry) for entry in value), key=lambda entry: json.dumps(entry, sort_keys=True))
    if isinstance(value, Sequence):
        return [plain(entry) for entry in value]
    raise ArchiveError(f"{type(value).__name__} {value!r} cannot be part of a key; give numbers, text, lists or tables")


def array_digest(array: NDArray[np.generic]) -> str:
    """Return a hash of an array's shape and values."""
    return hashlib.sha256(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes()).hexdigest()[:20]


STORE_URI = re.compile(r"stages/([^/\s]+)/([^/\s]+)")
ADDRESS = re.compile(r"(?i)[a-z][a-z0-9+]+:(?=/)")  # of a bucket or server
LATEST = "latest"  # the newest run
SECOND = len("20261120T101701")  # of a run's name: when it was begun


@dataclass(frozen=True)
class StageRef:
    """Address of one published store, which tasks pass on instead of arrays."""

    stage: str
    key: str
    path: Path = field(compare=False)

    @property
    def uri(self) -> str:
        """Address relative to the archive."""
        return f"stages/{self.stage}/{self.key}"


def store_at(root: Path, stage: str, key: str) -> StageRef:
    """Return the address of a store, whether it exists or not. Raises ArchiveError: a name is not allowed."""
    check_name(stage)
    check_name(key)
    return StageRef(stage, key, root / "stages" / stage / key)


def published_stores(root: Path, stage: str | None = None) -> list[StageRef]:
    """Return every published store (of one stage), by stage and key."""
    folders = sorted((root / "stages").glob(f"{stage or '*'}/*"))
    return [StageRef(path.parent.name, path.name, path) for path in folders if _is_published(path)]


def published_runs(root: Path) -> list[Path]:
    """Return the folders of the published runs, oldest first.

    Runs are sorted by the second in their names, then by the time at which they were written.
    """
    ages = dict[Path, int]()
    for path in (root / "runs").glob("*"):
        with suppress(FileNotFoundError):  # it goes meanwhile
            if _is_published(path):
                ages[path] = (path / MANIFEST_NAME).lstat().st_mtime_ns
    return sorted(ages, key=lambda folder: (folder.name[:SECOND], ages[folder], folder.name))


def _is_published(folder: Path) -> bool:
    """Return whether a folder has a manifest, even a damaged one."""
    return not folder.name.endswith(PART_SUFFIX) and (folder / MANIFEST_NAME).exists()


def without_manifest(root: Path) -> list[Path]:
    """Return folders without a manifest, and foreign files, that lie among stores and runs."""
    inside = [*root.glob("stages/*/*"), *root.glob("runs/*")]
    loose = [path for path in root.glob("stages/*") if not path.is_dir()]
    foreign = (path for path in (*inside, *loose) if not path.name.endswith(PART_SUFFIX) and not _is_published(path))
    return sorted(path for path in foreign if os.path.lexists(path))  # else it has gone meanwhile


def in_text(text: str) -> str | None:
    """Return the store's address that begins a text such as ``stages/rectify/<key>/mosaic.zarr``, or None."""
    found = STORE_URI.match(text)
    # stages/../.. leads out of the archive
    return found.group(0) if found is not None and all(is_name(part) for part in found.groups()) else None


def is_archive(address: str | Path) -> bool:
    """Return whether there is an archive to open, or a file that will be refused."""
    return (Path(address) / "stages").is_dir() or Path(address).is_file()


def open_folder(path: Path, *, create: bool, write: bool) -> None:
    """Create an archive's folder with ``create``, and check that it can be used.

    Raises ArchiveError: the path is the address of a bucket, is a file, is missing, or cannot be read or written to
    (``write``).
    """
    if (found := ADDRESS.match(str(path))) is not None:
        raise ArchiveError(
            f"{found[0]}//{str(path)[found.end() :].lstrip('/')} is not a folder: expected the folder of an archive; "
            "spectralzoom pull copies one from s3://bucket/prefix, and push copies it there"
        )
    try:
        with refusals(path, "use the archive"):
            _open_folder(path, create=create, write=write)
    except ArchiveError:
        raise
    except OSError as error:  # at the door whatever the system answers means that this is no place for an archive
        raise ArchiveError(f"cannot use {path} as an archive: {error.strerror}; choose another folder") from error


def _open_folder(path: Path, *, create: bool, write: bool) -> None:
    if path.exists() and not path.is_dir():
        cure = "choose another folder" if create else "check the name"
        raise ArchiveError(f"{path} is a file, expected a folder for the archive; {cure}")
    if not (path / "stages").is_dir():
        if not create:
            state = "is a folder but no archive (it has no folder stages)" if path.is_dir() else "is not there"
            raise ArchiveError(f"{path} {state}; check the name, or make an archive with survey --out")
        (path / "stages").mkdir(parents=True, exist_ok=True)
        for named in (path, path.parent):
            sync_path(named)
    if write:  # a small file: rights alone do not tell of a read-only or full disk
        probe = path / f".probe-{os.getpid()}-{secrets.token_hex(4)}"
        try:
            probe.write_bytes(b"written to see whether this can be written to")
        except OSError as error:
            if create or error.errno not in (errno.ENOSPC, errno.EDQUOT):  # gc frees the space of a full disk
                raise
        finally:
            with suppress(OSError):
                probe.unlink(missing_ok=True)

"""Write and check manifests: the facts of a published folder, and hash and size of every file.

The ``seal`` is the SHA-256 of the manifest's text without it, so that a flipped bit in the manifest itself is found.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, cast

from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.storage.archive.staging import MANIFEST_NAME, file_hash, files_below, remove_tree, sync_path

FORMAT = 2
CLEARED = "cleared"  # file that marks a store whose other files were deleted; its manifest stays as it is
CURE = "restore it from a copy, or remove it by gc --damaged and survey again"
_DISTRIBUTIONS = ("spectralzoom", "numpy", "numba", "torch", "xarray", "zarr", "numcodecs")


def write_manifest(folder: Path, facts: Mapping[str, Any]) -> None:
    """Sync every file of a staged folder and write ``manifest.json`` with their hashes and sizes beside ``facts``.

    The date and the versions of libraries are the present ones, unless ``facts`` has them.
    """
    files: dict[str, dict[str, Any]] = {}
    for path in files_below(folder):
        sync_path(path)
        files[path.relative_to(folder).as_posix()] = {"sha256": file_hash(path), "size": path.stat().st_size}
    known = {"created": datetime.now(UTC).isoformat(timespec="milliseconds"), "libraries": library_versions()}
    manifest = folder / MANIFEST_NAME
    manifest.write_text(manifest_text({**known, **facts, "files": files, "format": FORMAT}), encoding="utf-8")
    sync_path(manifest)
    for inner in sorted(path for path in folder.rglob("*") if path.is_dir()):
        sync_path(inner)
    sync_path(folder)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the content of a published folder's manifest.

    Raises IncompleteStoreError: it is missing, cannot be read, does not match its seal, or lists a file outside.
    """
    content, problem = try_manifest(folder)
    if problem is not None:
        raise IncompleteStoreError(f"{folder} has no valid {MANIFEST_NAME} ({problem}); {CURE}")
    return content


def try_manifest(folder: Path) -> tuple[dict[str, Any], str | None]:
    """Return the content of a published folder's manifest and None, or an empty table and the problem."""
    try:
        return parse_manifest((folder / MANIFEST_NAME).read_bytes())
    except FileNotFoundError:
        return {}, "it is missing"
    except OSError as error:
        return {}, error.strerror or str(error)


def parse_manifest(written: bytes) -> tuple[dict[str, Any], str | None]:
    """Return the content of a manifest's text and None, or an empty table and the problem."""
    try:
        text = written.decode()
        content = json.loads(text)
        if not isinstance(content, dict) or not isinstance(content.get("files"), dict):
            raise TypeError("it lists no files")
        before, _, after = text.partition(f'\n "seal": "{content.get("seal")}"')
        plain = before + after[1:] if after.startswith(",") else before[:-1] + after  # with the comma of its line
        if content.get("seal") != hashlib.sha256(plain.encode()).hexdigest():
            raise ValueError("it has changed since it was published: its seal does not fit")
        for name, entry in content["files"].items():
            parts = PurePosixPath(name).parts
            if not parts or name.startswith("/") or ".." in parts or "\0" in name:
                raise ValueError(f"it lists {name!r}, which is no file of this folder")
            if not isinstance(entry, dict) or entry.keys() != {"sha256", "size"}:
                raise ValueError(f"it gives no size and hash of {name!r}")
    except RecursionError:
        return {}, "it is nested too deeply"
    except (ValueError, TypeError) as error:
        return {}, str(error)
    return content, None


def manifest_sha256(folder: Path) -> str:
    """Return the SHA-256 of a published folder's manifest.json; runs record it of each store.

    Raises IncompleteStoreError: there is none.
    """
    try:
        return file_hash(folder / MANIFEST_NAME)
    except OSError as error:
        raise IncompleteStoreError(f"{folder / MANIFEST_NAME} cannot be read: {error.strerror}; {CURE}") from error


def listed_bytes(manifest: Mapping[str, Any]) -> int:
    """Return the size of all files that a manifest lists."""
    return sum(entry["size"] for entry in manifest["files"].values())


def is_cleared(folder: Path) -> bool:
    """Return whether a store's files were cleared away, or are being deleted."""
    return (folder / CLEARED).exists()


def clear_files(folder: Path) -> None:
    """Mark a store as cleared, then delete its files but the manifest; a killed process leaves it marked."""
    if not is_cleared(folder):
        (folder / CLEARED).touch()
        sync_path(folder)
    for path in cleared_leftovers(folder):
        remove_tree(path) if path.is_dir() else path.unlink()


def cleared_leftovers(folder: Path) -> list[Path]:
    """Return what a cleared store has besides manifest and mark: files that a killed process was deleting."""
    return [path for path in folder.iterdir() if path.name not in (MANIFEST_NAME, CLEARED)]


def refill(part: Path, final: Path) -> None:
    """Move a store that was built again into its cleared folder; it counts as cleared until all of it is there."""
    clear_files(final)
    for path in part.iterdir():
        if path.name != MANIFEST_NAME:
            path.rename(final / path.name)
    sync_path(final)
    (part / MANIFEST_NAME).replace(final / MANIFEST_NAME)
    sync_path(final)
    (final / CLEARED).unlink()
    sync_path(final)


def as_table(value: object) -> dict[str, Any]:
    """Return a value of a damaged or foreign manifest if it is a table, else an empty one."""
    return value if isinstance(value, dict) else {}


def check_files(folder: Path, *, hashes: bool) -> None:
    """Compare a published folder with its manifest: names and sizes, and every byte where ``hashes``.

    Raises IncompleteStoreError: a file is missing, has another size or content, or is not listed.
    """
    manifest = read_manifest(folder)
    for name, problem in broken_files(folder, manifest, hashes=hashes):
        if is_cleared(folder) or read_manifest(folder) != manifest:  # another process has cleared it, or made it anew
            check_files(folder, hashes=hashes)
            return
        raise IncompleteStoreError(f"{folder / name} {problem}; {CURE}")


def broken_files(folder: Path, manifest: Mapping[str, Any], *, hashes: bool) -> Iterator[tuple[str, str]]:
    """Yield name and problem of every file that differs from the manifest; with ``hashes`` also of extra files.

    A cleared store has no files to compare.
    """
    if is_cleared(folder):
        return
    for name, entry in manifest["files"].items():
        if (problem := file_problem(folder / name, entry, hashes=hashes)) is not None:
            yield name, problem
    if hashes:
        found = {path.relative_to(folder).as_posix() for path in files_below(folder)}
        for name in sorted(found - set(manifest["files"])):
            yield name, "is not in the manifest: take it out of the archive"


def file_problem(path: Path, entry: Mapping[str, Any], *, hashes: bool) -> str | None:
    """Return the difference of a file from its ``entry`` in the manifest, as text behind its name; None without one."""
    try:
        size = path.stat().st_size
        if size != entry["size"]:
            return f"has {size} bytes, expected {entry['size']}"
        if hashes and file_hash(path) != entry["sha256"]:
            return "has changed since it was published (its SHA-256 differs)"
    except FileNotFoundError:
        return "cannot be read: it is missing"
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    return None


def manifest_text(content: Mapping[str, Any]) -> str:
    """Return the text of a manifest with its seal, the SHA-256 of the text without it."""

    def text(values: Mapping[str, Any]) -> str:
        return json.dumps(values, indent=1, sort_keys=True, allow_nan=False) + "\n"

    checksummed = {**content, "seal": hashlib.sha256(text(content).encode()).hexdigest()}
    return text(checksummed)


@cache
def library_versions() -> Mapping[str, str]:
    """Return the installed versions of the libraries that a stored result may depend on."""
    found: dict[str, str] = {}
    for name in _DISTRIBUTIONS:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def read_table(path: Path) -> dict[str, Any]:
    """Return the content of a file directly in a published store's folder.

    Raises IncompleteStoreError: the store's manifest does not list the file, or not one of these bytes.
    """
    entry = read_manifest(path.parent)["files"].get(path.name)
    problem = "is in no manifest" if entry is None else file_problem(path, entry, hashes=True)
    if problem is not None:
        raise IncompleteStoreError(f"{path} {problem}; {CURE}")
    return cast(dict[str, Any], json.loads(path.read_bytes()))


def write_table(path: Path, content: Mapping[str, Any]) -> None:
    """Write plain values in their own order; numpy's numbers become floats."""
    path.write_text(json.dumps(content, indent=1, default=float) + "\n")

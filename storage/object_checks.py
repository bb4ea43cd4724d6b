"""An archive in a bucket read again to the last byte, and what broken-off uploads have left there."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from storage.manifests import try_manifest
from storage.object_stores import Listed, Objects, some_at_a_time
from storage.object_transfers import ATTEMPT, files_at, is_address
from storage.records import RECEIPT
from storage.shard_names import name_damage
from storage.staging import MANIFEST_NAME
from storage.verification import Finding, Progress, verify_everything

DAY_S = 86400.0


def verify_objects(objects: Objects, progress: Progress | None = None) -> list[Finding]:
    """Check every store and run in a bucket; a finding for each that is whole, and for each thing that is not.

    Nothing is taken from a working copy: manifests and receipts are fetched again, into a folder that goes away.
    """
    there = objects.listing()
    with tempfile.TemporaryDirectory(prefix="spectralzoom-verify-") as name:
        root = Path(name)
        (root / "stages").mkdir()
        published = [path.removesuffix(f"/{MANIFEST_NAME}") for path in there if _is_manifest(path)]
        some_at_a_time(lambda uri: _lay_out(objects, root, uri), published)

        def problems(folder: Path) -> Iterator[str]:
            yield from _problems(objects, there, root, folder.relative_to(root).as_posix())

        return verify_everything(root, progress, problems)


def _is_manifest(path: str) -> bool:
    parts = path.split("/")
    return parts[-1] == MANIFEST_NAME and (len(parts), parts[0]) in ((4, "stages"), (3, "runs")) and is_address(path)


def _lay_out(objects: Objects, root: Path, uri: str) -> None:
    """Manifest, and receipt as it is, of what is published at an address."""
    text = objects.read(f"{uri}/{MANIFEST_NAME}")
    if text is None:
        return
    (root / uri).mkdir(parents=True)
    (root / uri / MANIFEST_NAME).write_bytes(text)
    if uri.startswith("runs/") and (receipt := objects.read(f"{files_at(uri, text)}/{RECEIPT}")) is not None:
        (root / uri / RECEIPT).write_bytes(receipt)


def _problems(objects: Objects, there: Mapping[str, Listed], root: Path, uri: str) -> Iterator[str]:
    """What is wrong with one published folder, object by object."""
    manifest, problem = try_manifest(root / uri)
    if problem is not None:
        yield f"{MANIFEST_NAME} cannot be believed: {problem}"
        return
    place = files_at(uri, (root / uri / MANIFEST_NAME).read_bytes())
    for name, entry in manifest["files"].items():
        problem = _object_problem(objects, there, f"{place}/{name}", entry)
        if problem is not None:
            yield f"{name} {problem}{_damage(objects, root / uri, place, name)}"
    extra = {path.removeprefix(f"{place}/") for path in there if path.startswith(f"{place}/")} - set(manifest["files"])
    yield from (f"{name} is not in the manifest: take it out of the archive" for name in sorted(extra))


def _object_problem(objects: Objects, there: Mapping[str, Listed], name: str, entry: Mapping[str, Any]) -> str | None:
    if name not in there:
        return "cannot be read: it is missing"
    if there[name].size != entry["size"]:
        return f"has {there[name].size} bytes, expected {entry['size']}"
    try:
        _, digest = objects.measure(name)
    except FileNotFoundError:
        return "cannot be read: it is missing"
    return None if digest == entry["sha256"] else "has changed since it was published (its SHA-256 differs)"


def _damage(objects: Objects, folder: Path, place: str, name: str) -> str:
    """Which part of an array it is and which of its chunks can be read, from the object and the array's description."""
    about = [f"{parent.as_posix()}/zarr.json" for parent in Path(name).parents if parent != Path()]
    for one in (name, *about):
        try:
            objects.save(f"{place}/{one}", folder / one)
        except FileNotFoundError:
            (folder / one).unlink(missing_ok=True)
    return name_damage(folder, name)


def find_leftovers(objects: Objects, keep_days: float) -> dict[str, int]:
    """Folders of files that no manifest publishes and that are older than ``keep_days``, with their bytes.

    Ages are told from the store's own dates, up to the youngest object: the lease of whoever clears up.
    """
    there = objects.listing()
    now = max((one.changed for one in there.values()), default=None)
    attempts: dict[str, list[Listed]] = {}
    for path, one in there.items():
        if (folder := _attempt(path)) is not None:
            attempts.setdefault(folder, []).append(one)
    found: dict[str, int] = {}
    for folder, files in sorted(attempts.items()):
        assert now is not None
        age = (now - max(one.changed for one in files)).total_seconds()
        if age >= keep_days * DAY_S and not _is_published(objects, there, folder):
            found[folder] = sum(one.size for one in files)
    return found


def _attempt(path: str) -> str | None:
    """The folder of one upload's files that an object belongs to."""
    parts = path.split("/")
    depth = {"stages": 3, "runs": 2}.get(parts[0], len(parts))
    return "/".join(parts[: depth + 1]) if len(parts) > depth + 1 and ATTEMPT.fullmatch(parts[depth]) else None


def _is_published(objects: Objects, there: Mapping[str, Listed], folder: str) -> bool:
    uri = folder.rpartition("/")[0]
    if f"{uri}/{MANIFEST_NAME}" not in there:
        return False
    text = objects.read(f"{uri}/{MANIFEST_NAME}")
    return text is not None and files_at(uri, text) == folder

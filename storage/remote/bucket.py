"""Copy the stores and runs of an archive to a bucket, and back into a folder.

Stores and runs never change, so a bucket is a copy. A store's or run's manifest has the same address in the bucket. Its
files lie below ``<address>/<attempt>/``, where the attempt is the beginning of the SHA-256 of the manifest, so that two
writers never mix their files. A conditional put of the manifest comes last: the first writer wins. Every file is
compared with its hash before it is sent, and after it is fetched.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError
from spectralzoom.storage.remote.objects import Objects, some_at_a_time
from spectralzoom.storage.store import (
    CLEARED,
    LATEST,
    MANIFEST,
    RESTS_ON,
    Archive,
    check_store,
    is_cleared,
    lies_ahead,
    parse_manifest,
    uri_of,
)

Report = Callable[[str, float], None]  # address, and the fraction that is done


@dataclass(frozen=True)
class Copied:
    """Stores and runs that were copied, the bytes of their files, and those that were there before.

    ``conflicts`` are runs that were not copied, since another run has their name.
    """

    copied: list[str]
    bytes: int
    there: int
    conflicts: list[str]


def push(archive: Archive, objects: Objects, report: Report) -> Copied:
    """Send the stores and runs that the bucket lacks; stores come first, so that each run finds its own.

    Raises UnreachableError: the bucket refuses or does not answer; IncompleteStoreError: a store or run is damaged;
    ArchiveError: the bucket ignores conditional puts.
    """
    with archive.in_use():
        here = list(archive.manifests())
        there = _published(objects.listing())
        waiting = [uri for uri in here if uri not in there]
        if waiting:
            _check_conditional_puts(objects)
        sent = 0
        for number, uri in enumerate(waiting):
            report(uri, number / len(waiting))
            sent += _send(archive.root / uri, uri, objects)
        return Copied(waiting, sent, len(here) - len(waiting), _conflicts(objects, archive, set(here) & set(there)))


def pull(objects: Objects, archive: Archive, report: Report, run: str | None = None) -> Copied:
    """Fetch the stores and runs that the archive lacks; with ``run`` this run alone, and the stores that it names.

    Raises UnreachableError: the bucket refuses or does not answer; IncompleteStoreError: an object is missing or has
    changed; ArchiveError: there is no archive or no such run in the bucket.
    """
    listed = objects.listing()
    there = _published(listed)
    if not there:
        raise ArchiveError(f"{objects.place.url} has no archive: check the address, or push one")
    with archive.in_use():
        wanted = sorted(there, key=lambda uri: (not uri.startswith("stages/"), uri))  # stores before runs
        if run is not None:
            wanted = _of_run(objects, run, there)
        waiting = [uri for uri in wanted if not (archive.root / uri).exists()]
        fetched = 0
        for number, uri in enumerate(waiting):
            report(uri, number / len(waiting))
            fetched += _fetch(uri, objects, archive, listed)
        known = set(wanted) - set(waiting)
        return Copied(waiting, fetched, len(known), _conflicts(objects, archive, known))


def _send(folder: Path, uri: str, objects: Objects) -> int:
    """Send one store or run, its manifest last; return the bytes of its files."""
    check_store(folder, every_byte=True)
    text = (folder / MANIFEST).read_bytes()
    place = _files_at(uri, text)
    names: list[str] = [] if is_cleared(folder) else [*_manifest(uri, text)["files"]]
    if is_cleared(folder):
        objects.write(f"{place}/{CLEARED}", b"")
    some_at_a_time(lambda name: objects.write(f"{place}/{name}", folder / name), names)
    objects.create(f"{uri}/{MANIFEST}", text)  # else another writer was first: its store is as good
    return sum((folder / name).stat().st_size for name in names)


def _fetch(uri: str, objects: Objects, archive: Archive, listed: Collection[str]) -> int:
    """Fetch one store or run into the archive; return the bytes of its files."""
    text = objects.read(f"{uri}/{MANIFEST}")
    if text is None:  # another machine has removed it meanwhile
        return 0
    place = _files_at(uri, text)
    files = _manifest(f"{objects.place.url}/{uri}", text)["files"]
    is_cleared_there = f"{place}/{CLEARED}" in listed

    def fetch(part: Path) -> None:
        (part / MANIFEST).write_bytes(text)
        if is_cleared_there:
            (part / CLEARED).touch()
        else:
            some_at_a_time(lambda name: objects.fetch(f"{place}/{name}", part / name, files[name][1]), files)

    fetched = archive.adopt(uri, fetch)  # else another process has fetched or made it
    return sum(size for size, _ in files.values()) if fetched and not is_cleared_there else 0


def _of_run(objects: Objects, run: str, there: Collection[str]) -> list[str]:
    """Return the addresses of the stores that a run names, and of the run."""
    runs = sorted(uri for uri in there if uri.startswith("runs/"))
    uri = f"runs/{run.removeprefix('runs/')}"
    if run == LATEST:
        uri = next((one for one in reversed(runs) if not _is_ahead(one, objects)), uri)
    text = objects.read(f"{uri}/{MANIFEST}") if uri in there else None
    if text is None:
        known = ", ".join(name.removeprefix("runs/") for name in runs[-5:]) or "none"
        raise ArchiveError(f"{objects.place.url} has no run {run!r}; its latest are {known}")
    return [*sorted(_manifest(uri, text)[RESTS_ON].keys() & set(there)), uri]


def _is_ahead(uri: str, objects: Objects) -> bool:
    """Return whether a run lies in the future, which a warning says."""
    text = objects.read(f"{uri}/{MANIFEST}")
    return text is None or lies_ahead(uri.removeprefix("runs/"), _manifest(uri, text)["created"], warns=True)


def _conflicts(objects: Objects, archive: Archive, both: Iterable[str]) -> list[str]:
    """Return the runs of two machines that have one name."""
    runs = sorted(uri for uri in both if uri.startswith("runs/"))
    texts = ((uri, (archive.root / uri / MANIFEST).read_bytes()) for uri in runs)
    return [uri for uri, text in texts if objects.read(f"{uri}/{MANIFEST}") != text]


def _published(listed: Collection[str]) -> list[str]:
    """Return the addresses of stores and runs that have a manifest in the bucket."""
    ends = (name.removesuffix(f"/{MANIFEST}") for name in listed if name.endswith(f"/{MANIFEST}"))
    return [uri for uri in ends if _is_address(uri)]


def _is_address(uri: str) -> bool:
    return uri_of(uri) == uri


def _files_at(uri: str, manifest: bytes) -> str:
    """Return the address of the files that a manifest lists."""
    return f"{uri}/{hashlib.sha256(manifest).hexdigest()[:16]}"


def _manifest(place: str, text: bytes) -> dict[str, Any]:
    """Return the content of a manifest. Raises IncompleteStoreError: it is damaged."""
    try:
        return parse_manifest(text)
    except ValueError as error:
        raise IncompleteStoreError(f"{place}/{MANIFEST} is damaged: {error}") from error


def _check_conditional_puts(objects: Objects) -> None:
    """Check that a second conditional put of one name is refused."""
    name = f".probe-{secrets.token_hex(8)}"
    written = objects.create(name, b""), objects.create(name, b"")
    objects.remove(name)
    if written != (True, False):
        raise ArchiveError(
            f"{objects.place.url}: this store ignores conditional puts (If-None-Match), without which two machines "
            "would overwrite each other; use one that has them"
        )

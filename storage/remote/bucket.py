"""Copy the stores and runs of an archive to a bucket, and back into a folder.

Stores and runs never change, so a bucket is a copy. The manifest of a store or run is the object
``<address>/manifest.json``, that of a cleared store ``<address>/cleared.json``. The files lie below
``<address>/<attempt>/``, where the attempt is the beginning of the SHA-256 of the manifest, so that two writers never
mix their files. A conditional put of the manifest comes last: the first writer wins. Every file is compared with its
hash when it is sent, and after it is fetched.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError
from spectralzoom.storage.remote.objects import Objects, some_at_a_time
from spectralzoom.storage.store import (
    LATEST,
    MANIFEST,
    RESTS_ON,
    Archive,
    check_store,
    conflicts,
    damage,
    digest_of,
    inputs_first,
    is_cleared,
    is_known,
    lies_ahead,
    manifest_bytes,
    manifest_digest,
    parse_manifest,
    try_manifest,
    uri_of,
)
from spectralzoom.storage.whole_files import write_new

OF_CLEARED = "cleared.json"  # the manifest of a store without its files
KINDS = (OF_CLEARED, MANIFEST)
PROBE = ".conditional-put"
TO_ANOTHER = "two machines made it, not bit for bit equal: keep one of both, or copy to another folder or prefix"
Report = Callable[[str, float], None]  # address, and the fraction that is done


@dataclass(frozen=True)
class Copied:
    """Stores and runs that were copied, the bytes of their files, and the number of those that were there before.

    ``conflicts`` are stores and runs that both sides have with other content; ``missing`` are stores that copied runs
    name, and that are in neither place. ``bad_names`` are objects in the bucket that no client can ask for.
    """

    copied: list[str]
    bytes: int
    there: int
    conflicts: list[str]
    missing: list[str]
    bad_names: list[str]


def push(archive: Archive, objects: Objects, report: Report) -> Copied:
    """Send the stores and runs that the bucket lacks, inputs first, so that each run finds its own.

    Files of stores that were cleared or removed here stay in the bucket. Raises UnreachableError: the bucket refuses or
    does not answer; ArchiveError: the bucket ignores conditional puts; IncompleteStoreError, after all else was sent: a
    store or run is damaged, or the bucket has it, cleared, or an input of it with other content.
    """
    with archive.in_use():
        return send_stores(archive, objects, list(archive.manifests()), report)


def send_stores(
    archive: Archive, objects: Objects, uris: Collection[str], report: Report = lambda uri, done: None
) -> Copied:
    """Send these stores and runs, inputs first, if the bucket lacks them. Raises as `push`."""
    there = _published(objects.listing())
    waiting = [uri for uri in uris if there.get(uri) not in (MANIFEST, _manifest_name(archive.root / uri))]
    if waiting:
        _check_conditional_puts(objects)
    digests: dict[str, str | None] = {}  # of stores in the bucket

    def digest_there(uri: str) -> str | None:
        if uri not in digests:
            digests[uri] = _digest(uri, there, objects)
        return digests[uri]

    def send(uri: str) -> int | None:
        here, other = digest_of(archive.root / uri), digest_there(uri)
        if here and other and here != other:  # it is cleared there, and runs rest on it
            differ = f"its digest is {here[:12]} here and {other[:12]} there"
            raise IncompleteStoreError(f"{uri} cannot be copied to {objects.url}: {differ}; {TO_ANOTHER}")
        size, text = _send(archive.root / uri, uri, objects)
        digests[uri] = manifest_digest(parse_manifest(text))
        return size

    known = {uri: try_manifest(archive.root / uri)[0] for uri in waiting}
    return _copy(archive, objects, uris, known, report, send, digest_there, digest_there, objects.url)


def pull(objects: Objects, archive: Archive, report: Report, run: str | None = None) -> Copied:
    """Fetch the stores and runs that the archive lacks; with ``run`` this run alone, and the stores that it names.

    Inputs come first. Raises UnreachableError: the bucket refuses or does not answer; ArchiveError: there is no archive
    or no such run in the bucket; IncompleteStoreError, after all else was fetched: an object is missing or has changed,
    or the archive has an input of a store or run with other content.
    """
    there = _published(objects.listing())
    if not there:
        raise ArchiveError(f"{objects.url} has no archive: check the address, or push one")
    archive.reclaim()
    with archive.in_use():
        wanted = _of_run(objects, run, there) if run is not None else sorted(there, key=lambda uri: uri[:4] == "runs")
        waiting = [uri for uri in wanted if not is_known(archive.root / uri)]
        found = some_at_a_time(lambda uri: _lineage(uri, there[uri], objects), waiting)
        known = {uri: one for uri, one in zip(waiting, found, strict=True) if one is not None}

        def fetch(uri: str) -> int | None:
            if "damage" in known[uri]:
                raise known[uri]["damage"]
            return fetch_store(uri, there[uri], objects, archive)

        def digest_here(uri: str) -> str | None:
            return digest_of(archive.root / uri)

        digest_there = partial(_digest, there=there, objects=objects)
        return _copy(archive, objects, wanted, known, report, fetch, digest_there, digest_here, archive.name)


def _digest(uri: str, there: Mapping[str, str], objects: Objects) -> str | None:
    """Return the digest of a store or run in the bucket; None if it is not there."""
    text = objects.read(f"{uri}/{there[uri]}", parse_manifest) if uri in there else None
    return None if text is None else manifest_digest(parse_manifest(text))


def _lineage(uri: str, kind: str, objects: Objects) -> dict[str, Any] | None:
    """Return inputs and their digests of a manifest, or its ``damage``; None if another machine has removed it."""
    try:
        text = objects.read(f"{uri}/{kind}", parse_manifest)
    except IncompleteStoreError as error:
        return {"inputs": [], RESTS_ON: {}, "damage": error}
    return None if text is None else {name: parse_manifest(text)[name] for name in ("inputs", RESTS_ON)}


def _copy(
    archive: Archive,
    objects: Objects,
    asked: Collection[str],
    waiting: Mapping[str, Mapping[str, Any]],
    report: Report,
    work: Callable[[str], int | None],
    digest_there: Callable[[str], str | None],
    digest: Callable[[str], str | None],
    place: str,
) -> Copied:
    """Copy what waits, by its manifest, to a ``place`` whose stores have a ``digest``, inputs first.

    The digests of the bucket (``digest_there``) are compared with those of the archive for all that was ``asked``.
    ``work`` returns the bytes, or None where another process was first. A store or run that is damaged, or whose input
    differs there, is left out with what rests on it; then its error is raised at the end.
    """
    copied, total = [], 0
    failed: dict[str, IncompleteStoreError] = {}
    for number, uri in enumerate(inputs_first(waiting, waiting)):
        report(uri, number / len(waiting))
        try:
            if below := next((one for one in waiting[uri][RESTS_ON] if one in failed), None):
                raise failed[below]
            for problem in conflicts(waiting[uri], digest, place):
                raise IncompleteStoreError(f"{uri} cannot be copied to {place}: {problem}; {TO_ANOTHER}")
            size = work(uri)
        except IncompleteStoreError as error:
            failed[uri] = error
            continue
        if size is not None:
            copied.append(uri)
            total += size
    if failed:
        raise IncompleteStoreError(f"{next(iter(failed.values()))}. All that does not rest on it was copied")
    runs = [uri for uri in copied if uri.startswith("runs/")]
    named = {one for uri in runs for one in try_manifest(archive.root / uri)[0][RESTS_ON]}
    both = [(uri, own) for uri in asked if uri not in copied and (own := digest_of(archive.root / uri))]
    digests = some_at_a_time(digest_there, [uri for uri, _ in both])
    others = [uri for (uri, own), other in zip(both, digests, strict=True) if other not in (None, own)]
    missing = sorted(uri for uri in named if not is_known(archive.root / uri))
    there = len(asked) - len(copied) - len(others)
    return Copied(copied, total, there, others, missing, sorted(objects.bad_names))


def _send(folder: Path, uri: str, objects: Objects) -> tuple[int | None, bytes]:
    """Send one store or run, its manifest last; return the bytes of its files, and the manifest.

    Where another writer was first, return None and the manifest of that writer.
    """
    check_store(folder)
    kind, text = _manifest_name(folder), manifest_bytes(folder)
    files = parse_manifest(text)["files"] if kind == MANIFEST else {}
    try:
        some_at_a_time(lambda name: objects.write(_address(uri, text, name), folder / name, files[name][1]), files)
    except (FileNotFoundError, IncompleteStoreError) as error:  # it is cleared or made again meanwhile, or damaged
        if kind == _manifest_name(folder) and text == manifest_bytes(folder):
            raise damage(folder, f"a file of it has changed while it was sent ({error})") from error
    check_store(folder)
    if kind != _manifest_name(folder) or text != manifest_bytes(folder):  # cleared, or made again
        return _send(folder, uri, objects)
    winner = objects.create(f"{uri}/{kind}", text)
    return sum(size for size, _ in files.values()) if winner == text else None, winner


def fetch_store(uri: str, kind: str, objects: Objects, archive: Archive) -> int | None:
    """Fetch one store or run into the archive; return the bytes of its files, None where it is here or gone."""
    text = objects.read(f"{uri}/{kind}", parse_manifest)
    if text is None:  # another machine has removed it meanwhile
        return None
    if kind == OF_CLEARED:
        return 0 if archive.adopt(uri, text) else None
    files = parse_manifest(text)["files"]

    def fetch(part: Path) -> None:
        write_new(part / MANIFEST, text)
        some_at_a_time(lambda name: objects.fetch(_address(uri, text, name), part / name, *files[name]), files)

    return sum(size for size, _ in files.values()) if archive.adopt(uri, fetch) else None


def _of_run(objects: Objects, run: str, there: Iterable[str]) -> list[str]:
    """Return the addresses of the stores that a run names, and of the run."""
    runs = sorted(uri for uri in there if uri.startswith("runs/"))
    uri = f"runs/{run.removeprefix('runs/')}"
    if run == LATEST:
        uri = next((one for one in reversed(runs) if not lies_ahead(one.removeprefix("runs/"), "", warns=True)), uri)
    text = objects.read(f"{uri}/{MANIFEST}", parse_manifest) if uri in runs else None
    if text is None:
        known = ", ".join(name.removeprefix("runs/") for name in runs[-5:]) or "none"
        raise ArchiveError(f"{objects.url} has no run {run!r}; its latest are {known}")
    return [*sorted(parse_manifest(text)[RESTS_ON].keys() & set(there)), uri]


def _published(listed: Iterable[str]) -> dict[str, str]:
    """Return the name of the manifest of each store and run in the bucket, by address."""
    ends = sorted(name.rpartition("/") for name in listed)  # cleared.json, then manifest.json, which wins
    return {uri: kind for uri, _, kind in ends if kind in KINDS[uri[:5] == "runs/" :] and uri_of(uri) == uri}


def _manifest_name(folder: Path) -> str:
    return OF_CLEARED if is_cleared(folder) else MANIFEST


def _address(uri: str, manifest: bytes, name: str) -> str:
    """Return the name of the object of a file that a manifest lists."""
    return f"{uri}/{hashlib.sha256(manifest).hexdigest()[:16]}/{name}"


def _check_conditional_puts(objects: Objects) -> None:
    """Check that a second conditional put of one name is refused."""
    objects.create(PROBE, b"")
    if objects.create(PROBE, mark := secrets.token_bytes(8)) == mark:
        raise ArchiveError(
            f"{objects.url}: this store ignores conditional puts (If-None-Match), without which two machines "
            "would overwrite each other; use one that has them"
        )

"""Published folders on their way to a bucket and back.

``<address>/manifest.json`` is what publishes a folder, byte for byte as it is on a disk; it is put last, and only where
there is none. The folder's files lie below ``<address>/<attempt>/``, the attempt being the beginning of the SHA-256 of
the manifest that lists them: two writers never mix theirs, and which files count follows from the manifest alone.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive.manifests import check_files, read_manifest
from storage.archive.staging import MANIFEST_NAME, check_name, remove_tree, retire, sync_path
from storage.remote.object_stores import Objects, some_at_a_time

ATTEMPT_LETTERS = 16
ATTEMPT = re.compile(rf"[0-9a-f]{{{ATTEMPT_LETTERS}}}")
ASIDE = ".fetch"  # in the working copy: what is being fetched
DEAD_S = 86400.0  # what was being fetched so long ago is of a process that was killed
BEGUN = "begun"  # in a run's folder in the bucket: its name is taken
WITHDRAWN = ".withdrawn"  # in the bucket: manifests that a repair under way has taken away


def attempt_of(manifest: bytes) -> str:
    """Name of the folder of the files that a manifest lists."""
    return hashlib.sha256(manifest).hexdigest()[:ATTEMPT_LETTERS]


def attempts_in(listed: Iterable[str]) -> dict[str, frozenset[str]]:
    """Runs among the names of objects by their addresses, and the attempts of which files are there."""
    found: dict[str, set[str]] = {}
    for parts in (name.split("/") for name in listed):
        if len(parts) > 2:
            attempts = found.setdefault("/".join(parts[:2]), set())
            attempts.update([parts[2]] if ATTEMPT.fullmatch(parts[2]) else [])
    return {uri: frozenset(attempts) for uri, attempts in found.items()}


def is_address(uri: str) -> bool:
    """Whether an object's name can be an address in an archive: what a bucket lists is not trusted."""
    try:
        for part in uri.split("/"):
            check_name(part)
    except ArchiveError:
        return False
    return True


def files_at(uri: str, manifest: bytes) -> str:
    """Address of the files of a folder."""
    return f"{uri}/{attempt_of(manifest)}"


def send_folder(objects: Objects, uri: str, folder: Path) -> bytes:
    """Upload a published folder, its manifest last; gives the manifest that stands, which is whoever's came first.

    What is there of an upload that was broken off is not sent again. Raises IncompleteStoreError: a file of the folder
    is not as published any more; nothing is published then. UnreachableError: the bucket refuses or does not answer.
    """
    text = (folder / MANIFEST_NAME).read_bytes()
    standing = objects.read(f"{uri}/{MANIFEST_NAME}")
    if standing is not None:
        return standing
    _send_files(objects, uri, folder, text)
    return objects.claim(f"{uri}/{MANIFEST_NAME}", text)


def send_extension(objects: Objects, uri: str, folder: Path, standing: bytes) -> None:
    """Upload a run that something was added to in the place of the one that stands: its files, then its manifest.

    The files of the one of which ``standing`` is the manifest go last; killed before, `gc` clears them away. Raises
    IncompleteStoreError: a file of the folder is not as published any more; nothing is changed then. UnreachableError:
    the bucket refuses or does not answer.
    """
    text = (folder / MANIFEST_NAME).read_bytes()
    _send_files(objects, uri, folder, text)
    objects.write(f"{uri}/{MANIFEST_NAME}", text)
    objects.remove(objects.listing(files_at(uri, standing)))


def _send_files(objects: Objects, uri: str, folder: Path, text: bytes) -> None:
    check_files(folder, hashes=True)
    place, files = files_at(uri, text), read_manifest(folder)["files"]
    there = {name: found.size for name, found in objects.listing(place).items()}
    waiting = [name for name, entry in files.items() if there.get(f"{place}/{name}") != entry["size"]]
    some_at_a_time(lambda name: objects.write(f"{place}/{name}", folder / name), waiting)


def fetch_folder(objects: Objects, root: Path, uri: str, only: Iterable[str] | None = None) -> None:
    """Bring the files that a folder of the working copy lacks (of ``only`` these names), each checked by its hash.

    Raises IncompleteStoreError: an object is missing or has changed; what was fetched before it is kept.
    """
    folder = root / uri
    files = read_manifest(folder)["files"]
    place = files_at(uri, (folder / MANIFEST_NAME).read_bytes())
    wanted = files if only is None else {name: files[name] for name in only if name in files}
    waiting = [name for name, entry in wanted.items() if _size(folder / name) != entry["size"]]
    if not waiting:
        return
    with aside_in(root) as aside:

        def fetch(name: str) -> None:
            objects.fetch(f"{place}/{name}", folder / name, wanted[name]["sha256"], aside / secrets.token_hex(8))

        some_at_a_time(fetch, waiting)
    for inner in {(folder / name).parent for name in waiting}:
        sync_path(inner)


def is_here(folder: Path) -> bool:
    """Whether every file of a folder of the working copy is there, by its size."""
    return all(_size(folder / name) == entry["size"] for name, entry in read_manifest(folder)["files"].items())


def lay_manifest(root: Path, uri: str, manifest: bytes, changed: datetime) -> None:
    """Write a manifest into the working copy, with the date of the object; a folder of other files is replaced.

    Files that both manifests list alike stay.
    """
    folder = root / uri
    folder.parent.mkdir(parents=True, exist_ok=True)
    with aside_in(root) as aside:
        made = aside / folder.name
        made.mkdir()
        (made / MANIFEST_NAME).write_bytes(manifest)
        os.utime(made / MANIFEST_NAME, (changed.timestamp(), changed.timestamp()))
        sync_path(made / MANIFEST_NAME)
        sync_path(made)
        try:
            alike = folder.exists() and read_manifest(folder)["files"] == read_manifest(made)["files"]
        except IncompleteStoreError:
            alike = False
        if alike:
            (made / MANIFEST_NAME).replace(folder / MANIFEST_NAME)
            sync_path(folder)
        else:
            retire(folder)
            made.rename(folder)
    sync_path(folder.parent)


@contextmanager
def aside_in(root: Path) -> Iterator[Path]:
    """Give a folder of the working copy for what is not whole yet, and take it away again."""
    for old in (root / ASIDE).glob("*"):
        with suppress(FileNotFoundError):
            if time.time() - old.stat().st_mtime > DEAD_S:
                remove_tree(old)
    folder = root / ASIDE / secrets.token_hex(8)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        remove_tree(folder)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return -1

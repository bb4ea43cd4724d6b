"""Objects below an archive's prefix: read, written, listed and removed, each of them as a whole.

Files of a folder travel a few at a time. What was asked and moved is counted, so that a rerun can show that it was
nothing.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import obstore
from obstore.exceptions import AlreadyExistsError
from obstore.store import S3Store

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive.staging import sync_path
from storage.remote.object_places import ObjectPlace, answers_of

AT_ONCE = 8  # objects on their way
PART_BYTES = 8 << 20  # of a large object's parts, and of what is held of it
_TRIES = 3

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Listed:
    """What a listing says of one object; ``changed`` is by the store's clock."""

    size: int
    changed: datetime


@dataclass
class Traffic:
    """Requests made (a part of a large object is not counted on its own) and bytes of content moved."""

    requests: int = 0
    sent: int = 0
    received: int = 0


class Objects:
    """The objects of one place; names are relative to it.

    Every method raises UnreachableError where the bucket refuses or does not answer.
    """

    def __init__(self, place: ObjectPlace, store: S3Store) -> None:
        self.place, self.store, self.traffic = place, store, Traffic()
        self._counting = threading.Lock()

    def read(self, name: str) -> bytes | None:
        """Content of a small object, None where there is none."""
        return None if (found := self.read_dated(name)) is None else found[0]

    def read_dated(self, name: str) -> tuple[bytes, datetime] | None:
        """Content of a small object and when it was written, by the store's clock."""
        with self._asking():
            try:
                answer = obstore.get(self.store, name)
                content = bytes(answer.bytes())
            except FileNotFoundError as error:
                if "NoSuchBucket" in str(error):
                    raise
                return None
        self._count(received=len(content))
        return content, answer.meta["last_modified"]

    def create(self, name: str, content: bytes) -> bool:
        """Write an object unless there is one of this name (``If-None-Match: *``); tells whether it was written."""
        with self._asking():
            try:
                obstore.put(self.store, name, content, mode="create", use_multipart=False)
            except AlreadyExistsError:
                return False
        self._count(sent=len(content))
        return True

    def claim(self, name: str, content: bytes) -> bytes:
        """Write an object unless there is one, and give what stands there then: that of whoever came first.

        A request that is sent again because its answer was lost finds its own content, and so has come first.
        """
        for _ in range(_TRIES):
            if self.create(name, content):
                return content
            standing = self.read(name)
            if standing is not None:
                return standing
        raise ArchiveError(f"{self.place.url}/{name} comes and goes: somebody removes what is being written; run again")

    def write(self, name: str, source: Path | bytes) -> None:
        """Write an object from a file, whatever was there; nobody sees a part of it."""
        with self._asking():
            obstore.put(self.store, name, source, chunk_size=PART_BYTES, max_concurrency=2)
        self._count(sent=source.stat().st_size if isinstance(source, Path) else len(source))

    def blocks(self, name: str) -> Iterator[memoryview]:
        """Content of an object, some MB at a time (FileNotFoundError: there is none)."""
        with self._asking():
            for block in obstore.get(self.store, name).stream(PART_BYTES):
                self._count(received=len(block))
                yield memoryview(block)

    def save(self, name: str, path: Path) -> str:
        """Write an object into a new file; gives its SHA-256 (FileNotFoundError: there is none)."""
        digest = hashlib.sha256()
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            for block in self.blocks(name):
                digest.update(block)
                file.write(block)
        return digest.hexdigest()

    def fetch(self, name: str, path: Path, sha256: str, aside: Path) -> None:
        """Bring an object to ``path``, by way of the file ``aside``, if every byte of it is as it was published.

        Raises
        ------
        IncompleteStoreError : it is missing or has changed; nothing has come to ``path``.
        """
        advice = f"restore it from a copy, or run verify on {self.place.url}"
        try:
            try:
                found = self.save(name, aside)
            except FileNotFoundError:
                raise IncompleteStoreError(f"{self.place.url}/{name} is missing; {advice}") from None
            if found != sha256:
                raise IncompleteStoreError(
                    f"{self.place.url}/{name} has changed since it was published (its SHA-256 differs); {advice}"
                )
            sync_path(aside)
            path.parent.mkdir(parents=True, exist_ok=True)
            aside.replace(path)
        finally:
            with suppress(OSError):
                aside.unlink(missing_ok=True)

    def measure(self, name: str) -> tuple[int, str]:
        """Size and SHA-256 of an object, read to its end (FileNotFoundError: there is none)."""
        digest, size = hashlib.sha256(), 0
        for block in self.blocks(name):
            digest.update(block)
            size += len(block)
        return size, digest.hexdigest()

    def children(self, folder: str) -> list[str]:
        """Names of what lies in a folder and is one itself."""
        with self._asking():
            found = obstore.list_with_delimiter(self.store, folder)
        return sorted(prefix.rstrip("/").rpartition("/")[2] for prefix in found["common_prefixes"])

    def listing(self, folder: str | None = None) -> dict[str, Listed]:
        """Every object below a folder, or below the prefix, by its name."""
        found: dict[str, Listed] = {}
        with self._asking():
            for batch in obstore.list(self.store, folder, chunk_size=1000):
                found |= {one["path"]: Listed(one["size"], one["last_modified"]) for one in batch}
        return found

    def remove(self, names: Iterable[str]) -> None:
        """Remove objects; those that are not there are no matter."""
        waiting = list(names)
        if waiting:
            with self._asking(), suppress(FileNotFoundError):
                obstore.delete(self.store, waiting)

    @contextmanager
    def _asking(self) -> Iterator[None]:
        self._count(requests=1)
        with answers_of(self.place):
            yield

    def _count(self, requests: int = 0, sent: int = 0, received: int = 0) -> None:
        with self._counting:
            self.traffic.requests += requests
            self.traffic.sent += sent
            self.traffic.received += received


def some_at_a_time(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Do work that waits for the network on a few items at a time; results in their order, the first error raised."""
    waiting = list(items)
    if len(waiting) < 2:
        return [work(item) for item in waiting]
    with ThreadPoolExecutor(min(AT_ONCE, len(waiting))) as pool:
        futures = [pool.submit(work, item) for item in waiting]
        try:
            return [future.result() for future in futures]
        except BaseException:
            for future in futures:
                future.cancel()
            raise

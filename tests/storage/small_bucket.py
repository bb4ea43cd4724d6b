"""Helpers for an archive in a bucket that two machines share: stores of two files, and damaged objects."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.remote.object_archive import ObjectArchive

Machine = Callable[..., ObjectArchive]  # type of the fixture: it opens the archive for a named machine
FIRST, SECOND = "first", "second"  # the folders of the working copies of two machines


def make(archive: Archive, content: bytes = b"light", **params: int) -> tuple[StageRef, bool]:
    """Make (or find) a store of two files."""

    def build(path: Path) -> None:
        (path / "deep").mkdir()
        (path / "deep" / "a.bin").write_bytes(content)
        (path / "b.json").write_text("{}")

    return archive.produce("rectify", build, version=1, params=params)


def rot(archive: ObjectArchive, name: str, at: int = -1) -> None:
    """Flip one bit of an object."""
    content = bytearray(archive.objects.read(name) or b"")
    content[at] ^= 4
    archive.objects.write(name, bytes(content))


def object_of(archive: ObjectArchive, ref: StageRef, file: str) -> str:
    """Return the name of the object that holds a file of a store."""
    return next(name for name in archive.objects.listing(ref.uri) if name.endswith(f"/{file}"))

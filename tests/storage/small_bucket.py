"""An archive in a bucket as two machines see it, and stores of two files in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.remote.object_archive import ObjectArchive

Machine = Callable[..., ObjectArchive]  # of the fixture: opens the archive, by the name of a machine
FIRST, SECOND = "first", "second"  # two machines, by the folder of their working copies


def make(archive: Archive, content: bytes = b"light", **params: int) -> tuple[StageRef, bool]:
    """Make (or find) a store of two files."""

    def build(path: Path) -> None:
        (path / "deep").mkdir()
        (path / "deep" / "a.bin").write_bytes(content)
        (path / "b.json").write_text("{}")

    return archive.produce("rectify", build, version=1, params=params)


def rot(archive: ObjectArchive, name: str, at: int = -1) -> None:
    """Let one bit of an object flip."""
    content = bytearray(archive.objects.read(name) or b"")
    content[at] ^= 4
    archive.objects.write(name, bytes(content))


def object_of(archive: ObjectArchive, ref: StageRef, file: str) -> str:
    """The object that holds a file of a store."""
    return next(name for name in archive.objects.listing(ref.uri) if name.endswith(f"/{file}"))

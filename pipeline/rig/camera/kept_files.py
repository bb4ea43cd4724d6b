"""Files on a device and what is held of them here: the words that listings, transfers and readers share."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from pipeline.errors import RigError

_UNFIT = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")
Progress = Callable[[str, int, int], None]  # file, bytes held, bytes in all


@dataclass(frozen=True)
class RemoteFile:
    """An entry of a listing."""

    name: str  # whole path
    size: int | None  # bytes; None where the camera does not say
    folder: bool
    most: int | None = None  # bytes that it can have; None where nothing is known


def check_remote_name(name: str) -> None:
    """Refuse a name that cannot stand in a line of text, as files are asked for (RigError)."""
    if _UNFIT.search(name):
        raise RigError(
            f"the camera names a file {name!r:.200}, expected no line ends or control characters in a name; give it "
            "another name there"
        )


class Kept(Protocol):
    """Where fetched bytes go: files named as on the camera, of which a part may be there already."""

    def size(self, name: str) -> int:
        """Bytes held of a file; 0 of one that is not there."""

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Some of the bytes held."""

    def append(self, name: str, data: bytes) -> None:
        """Add bytes at the end."""

    def drop(self, name: str) -> None:
        """Hold no byte of a file any more."""


@dataclass
class KeptInMemory:
    """Files held in memory, for tests and for captures that fit."""

    files: dict[str, bytearray] = field(default_factory=dict)

    def size(self, name: str) -> int:
        """Bytes held of a file; 0 of one that is not there."""
        return len(self.files.get(name, b""))

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Some of the bytes held."""
        return bytes(self.files.get(name, bytearray())[start:stop])

    def append(self, name: str, data: bytes) -> None:
        """Add bytes at the end."""
        self.files.setdefault(name, bytearray()).extend(data)

    def drop(self, name: str) -> None:
        """Hold no byte of a file any more."""
        self.files.pop(name, None)

"""What became of every due run of a field: one file of JSON lines for each field, that only grows.

::

    schedule/<field>.jsonl

A line is on the disk before the call that wrote it returns. A line that a power cut tore is passed over, and the next
one begins below it. Each line has a checksum: one that has changed is passed over too, and `verify` tells its number.
Lines of earlier versions have none, and are read as they are. In an archive on S3 the ledgers lie in its working copy,
on the machine that surveys.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.errors import ArchiveError
from pipeline.json_lines import read_checked, with_check
from storage.archive.staging import is_name, open_plain, read_plain, refusals, sync_path

FOLDER = "schedule"
SUFFIX = ".jsonl"


class Ledger:
    """The ledger of one field. Readers need no lock; writers that look before they write take `held`."""

    def __init__(self, root: Path, field: str) -> None:
        if not is_name(field):
            raise ArchiveError(f"{field!r} cannot be a field's name; use letters, digits, '_', '-' and '.'")
        self.field, self.path = field, root / FOLDER / f"{field}{SUFFIX}"
        self._root = root

    def lines(self) -> list[dict[str, Any]]:
        """Every line that can be believed, oldest first; none of a field that was never scheduled.

        Raises ArchiveError: the file is there and cannot be read.
        """
        try:
            content = read_plain(self.path)
        except FileNotFoundError:
            return []
        except OSError as error:
            raise ArchiveError(f"cannot read the ledger {self.path}: {error.strerror}; check its rights") from error
        return [line.content for line in read_checked(content) if line.content is not None]

    def append(self, line: Mapping[str, Any]) -> None:
        """Add one line, for good.

        Raises ArchiveError: the disk refuses; what was there stays.
        """
        content = with_check(json.dumps(line, ensure_ascii=False, allow_nan=False).encode())
        with refusals(self._root, "write to the archive"):
            fresh = not self.path.exists()
            self.path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = open_plain(self.path, os.O_RDWR | os.O_CREAT)
            try:
                end = os.lseek(descriptor, 0, os.SEEK_END)
                torn = end > 0 and os.pread(descriptor, 1, end - 1) != b"\n"
                try:
                    waiting = memoryview(b"\n" + content if torn else content)
                    while waiting:
                        waiting = waiting[os.write(descriptor, waiting) :]
                    os.fsync(descriptor)
                except OSError:  # what the disk takes half of is taken back
                    os.ftruncate(descriptor, end)
                    raise
            finally:
                os.close(descriptor)
            if fresh:
                for folder in (self.path.parent, self._root):
                    sync_path(folder)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep other writers out while the block runs; a process that dies lets go."""
        with refusals(self._root, "write to the archive"):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.path.parent, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                yield
            finally:
                os.close(descriptor)


def ledgers(root: Path) -> list[Ledger]:
    """The ledgers of an archive, by the names of their fields."""
    found = sorted((root / FOLDER).glob(f"*{SUFFIX}"))
    return [Ledger(root, path.name.removesuffix(SUFFIX)) for path in found if is_name(path.name.removesuffix(SUFFIX))]

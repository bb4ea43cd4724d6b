"""Publish the folder of one run: receipt, report and pictures."""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from storage.archive.keys import plain
from storage.archive.manifests import write_manifest
from storage.archive.staging import (
    MANIFEST_NAME,
    check_name,
    files_below,
    refusals,
    remove_tree,
    rename_into_place,
    sync_path,
)

_AT_FDCWD = -100  # names are absolute, or of the working folder
_RENAME_EXCHANGE = 2
_UNSUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP)


class RunDraft:
    """The folder of one run while it is written; published as a whole or abandoned."""

    def __init__(self, run_id: str, folder: Path, root: Path, release: Callable[[], None]) -> None:
        self.id = run_id
        self.folder = folder
        self.send: Callable[[str], None] | None = None  # called with the address of the published run
        self._root = root
        self._release = release
        self._done = False

    @property
    def published(self) -> Path:
        """Return the run's folder once it is published."""
        return self.folder.with_name(self.id)

    def __enter__(self) -> RunDraft:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        try:
            if isinstance(error, OSError):  # of a file that the block wrote by itself
                with refusals(self._root, "write to the archive"):
                    raise error
            if kind is None and not self._done:
                self.publish()
        finally:
            self.abandon()

    def write_file(self, name: str, content: str | bytes) -> Path:
        """Write one file of the run, such as ``receipt.json``, and return its path."""
        check_name(name)
        with refusals(self._root, "write to the archive"):
            path = self.folder / name
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def publish(self, *, rests_on: Mapping[str, str] | None = None, **facts: Any) -> Path:
        """Publish the run below ``runs`` and return its folder; ``facts`` go into the manifest.

        ``rests_on`` is the result of `Archive.manifest_hashes` for the run's products. `gc` keeps these stores even
        where the receipt is damaged.
        """
        final = self.published
        with refusals(self._root, "write to the archive"):
            write_manifest(self.folder, {"run": self.id, "rests_on": dict(rests_on or {}), **plain(facts)})
            rename_into_place(self.folder, final)
        self._done = True
        if self.send is not None:
            self.send(f"runs/{self.id}")
        self._release()
        return final

    def abandon(self) -> None:
        """Remove an unpublished draft and release its lock; may be called again."""
        if not self._done:  # another process may have a draft of this name by now
            remove_tree(self.folder)
        self._release()


def take_its_place(part: Path, final: Path) -> None:
    """Replace a folder by a complete one, and remove it.

    If the file system cannot exchange two folders, the files are replaced one by one, the manifest last. A folder
    counts as damaged if the process is killed meanwhile.
    """
    sync_path(final.parent)
    if not try_exchange(part, final):
        old = set(files_below(final))
        for path in (*files_below(part), part / MANIFEST_NAME):
            new = final / path.relative_to(part)
            new.parent.mkdir(parents=True, exist_ok=True)
            path.replace(new)
            old.discard(new)
        for path in old:
            path.unlink()
        sync_path(final)
    remove_tree(part)


def try_exchange(one: Path, other: Path) -> bool:
    """Exchange the names of two folders in one step and sync them.

    Linux does so (renameat2) on local file systems. Elsewhere, as on most network file systems, nothing is changed and
    the result is False.
    """
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    failed = call(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), ctypes.c_uint(_RENAME_EXCHANGE))
    error = ctypes.get_errno() if failed else 0
    if error in _UNSUPPORTED:
        return False
    if error:
        raise OSError(error, os.strerror(error), str(one))
    for parent in {one.parent, other.parent}:
        sync_path(parent)
    return True

"""Publish the folder of one run: receipt, report and pictures; and replace it as a whole when something is added.

When the accuracy is known, a new folder replaces the old one in one step, under the same name and date. Its manifest
names the earlier one. Wherever the process is killed, one of the two is there and complete.
"""

from __future__ import annotations

import ctypes
import errno
import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from storage.archive.keys import plain
from storage.archive.manifests import (
    extended_facts,
    manifest_sha256,
    manifests_before,
    read_manifest,
    try_manifest,
    write_manifest,
)
from storage.archive.staging import (
    PART_SUFFIX,
    bytes_below,
    check_name,
    refusals,
    remove_tree,
    rename_into_place,
    sync_path,
    take_lock,
)

_AT_FDCWD = -100  # names are absolute, or of the working folder
_RENAME_EXCHANGE = 2
_UNSUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP)


class RunDraft:
    """The folder of one run while it is written; published as a whole or abandoned.

    A draft that ``extends`` a published run replaces it only when `publish` is called.
    """

    def __init__(
        self, run_id: str, folder: Path, root: Path, release: Callable[[], None], *, extends: bool = False
    ) -> None:
        self.id = run_id
        self.folder = folder
        self.extends = extends
        self.send: Callable[[str], None] | None = None  # called with the address of the published run
        self._root = root
        self._release = release

    @property
    def published(self) -> Path:
        """Return the run's folder once it is published."""
        return self.folder.with_name(self.id)

    def __enter__(self) -> RunDraft:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if isinstance(error, OSError):  # of a file that the block wrote by itself
                with refusals(self._root, "write to the archive"):
                    raise error
            if kind is None and not self.extends and self.folder.exists():
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
            self._write_manifest(rests_on, facts)
            if self.extends:
                take_its_place(self.folder, final)
            else:
                rename_into_place(self.folder, final)
        self._release()
        if self.send is not None:
            self.send(f"runs/{self.id}")
        return final

    def bytes_published(self, *, rests_on: Mapping[str, str] | None = None, **facts: Any) -> int:
        """Return the bytes of the folder, manifest included, if it were published now with these facts."""
        with refusals(self._root, "write to the archive"):
            self._write_manifest(rests_on, facts)
            return bytes_below(self.folder)

    def _write_manifest(self, rests_on: Mapping[str, str] | None, facts: Mapping[str, Any]) -> None:
        """Write the manifest; its size depends on files and facts alone."""
        final = self.published
        content = {"run": self.id, "rests_on": dict(rests_on or {}), **plain(facts)}
        if self.extends:
            content |= extended_facts(read_manifest(final), manifest_sha256(final))
        write_manifest(self.folder, content)

    def abandon(self) -> None:
        """Remove an unpublished draft and release its lock; may be called again."""
        remove_tree(self.folder)
        self._release()


def take_its_place(part: Path, final: Path) -> None:
    """Replace a folder by a complete one, and remove it.

    Some file systems cannot exchange two folders: there the run has its unfinished name for a moment. If the process is
    killed then, `finish_extensions` completes the exchange.
    """
    sync_path(final.parent)
    away = part
    if not try_exchange(part, final):
        away = final.with_name(f"{final.name}-{secrets.token_hex(4)}{PART_SUFFIX}")
        try:
            final.rename(away)
            part.rename(final)
        except BaseException:
            if not final.exists():
                away.rename(final)
            raise
        sync_path(final.parent)
    remove_tree(away)


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


def unfinished_extensions(root: Path) -> Iterator[Path]:
    """Yield complete folders that were about to replace a run, and whose run has no name."""
    for part in sorted((root / "runs").glob(f"*{PART_SUFFIX}")):
        facts, problem = try_manifest(part)
        named = part.name.removesuffix(PART_SUFFIX)
        whole = problem is None and bool(manifests_before(facts)) and facts.get("run") == named
        if whole and not (root / "runs" / named).exists():
            yield part


def finish_extensions(root: Path) -> None:
    """Give the runs of `unfinished_extensions` their names, unless a running process does."""
    for part in unfinished_extensions(root):
        release = take_lock(root / ".locks" / f"runs-{part.stem}.lock", wait=False)
        if release is not None:
            try:
                if part.exists() and not part.with_suffix("").exists():
                    rename_into_place(part, part.with_suffix(""))
            finally:
                release()

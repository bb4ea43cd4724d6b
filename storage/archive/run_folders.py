"""Publish the folder of one run: receipt, report and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from spectralzoom.storage.archive.keys import plain
from spectralzoom.storage.archive.manifests import write_manifest
from spectralzoom.storage.archive.staging import check_name, refusals, remove_tree, rename_into_place


class RunDraft:
    """The folder of one run while it is written; published as a whole or abandoned."""

    def __init__(self, run_id: str, folder: Path, root: Path, release: Callable[[], None]) -> None:
        self.id = run_id
        self.folder = folder
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
        self._release()
        return final

    def abandon(self) -> None:
        """Remove an unpublished draft and release its lock; may be called again."""
        if not self._done:  # another process may have a draft of this name by now
            remove_tree(self.folder)
        self._release()

"""The folder of one run: receipt, report and pictures, published together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Any

from storage.addresses import published_runs
from storage.keys import plain
from storage.manifests import write_manifest
from storage.records import read_run
from storage.staging import MANIFEST_NAME, check_name, refusals, remove_tree, rename_into_place


def date_of_store(root: Path, uri: str) -> str:
    """When a store is made: now, or just after the last run that knows one of this address, if the clock was set back.

    By its date `verify` tells a store that was made anew from one whose manifest somebody wrote.
    """
    now = datetime.now(UTC)
    folders = published_runs(root)
    if any((folder / MANIFEST_NAME).lstat().st_mtime >= now.timestamp() for folder in folders):
        runs = (read_run(folder, {}) for folder in folders)
        for known in (run.created for run in runs if uri in run.recorded):
            try:
                now = max(now, datetime.fromisoformat(known) + timedelta(milliseconds=1))
            except (ValueError, TypeError, OverflowError):
                continue  # it does not say when it was published
    return now.isoformat(timespec="milliseconds")


class RunDraft:
    """The folder of one run while it is written. Published as a whole, or abandoned."""

    def __init__(self, run_id: str, folder: Path, root: Path, release: Callable[[], None]) -> None:
        self.id = run_id
        self.folder = folder
        self._root = root
        self._release = release

    def __enter__(self) -> RunDraft:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if isinstance(error, OSError):  # of a file that the block wrote by itself
                with refusals(self._root, "write to the archive"):
                    raise error
            if kind is None and self.folder.exists():
                self.publish()
        finally:
            self.abandon()

    def write_file(self, name: str, content: str | bytes) -> Path:
        """Write one file of the run, such as ``receipt.json``, and give its path."""
        check_name(name)
        with refusals(self._root, "write to the archive"):
            path = self.folder / name
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def publish(self, *, rests_on: Mapping[str, str] | None = None, **facts: Any) -> Path:
        """Make the run seen under ``runs``; gives its folder. ``facts`` go into the manifest.

        ``rests_on`` is what `Archive.manifest_hashes` gives of the run's products: by it `verify` knows that their
        manifests, too, are as they were, and `gc` what to keep, even where the receipt is damaged.
        """
        final = self.folder.with_name(self.id)
        with refusals(self._root, "write to the archive"):
            write_manifest(self.folder, {"run": self.id, "rests_on": dict(rests_on or {}), **plain(facts)})
            rename_into_place(self.folder, final)
        self._release()
        return final

    def abandon(self) -> None:
        """Remove what is not published; harmless afterwards."""
        remove_tree(self.folder)
        self._release()

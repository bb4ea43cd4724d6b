"""Addresses in an archive: of stores and runs, and how they are told apart from what merely lies there."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from storage.archive.staging import MANIFEST_NAME, PART_SUFFIX, check_name, is_name

STORE_URI = re.compile(r"stages/([^/\s]+)/([^/\s]+)")
SECOND = len("20261120T101701")  # of a run's name: when it was begun


@dataclass(frozen=True)
class StageRef:
    """Address of one published store: what tasks hand to each other instead of arrays."""

    stage: str
    key: str
    path: Path

    @property
    def uri(self) -> str:
        """Address relative to the archive."""
        return f"stages/{self.stage}/{self.key}"


def store_at(root: Path, stage: str, key: str) -> StageRef:
    """Address of a store, whether it is there or not (ArchiveError: no such names can be)."""
    check_name(stage)
    check_name(key)
    return StageRef(stage, key, root / "stages" / stage / key)


def published_stores(root: Path, stage: str | None = None) -> list[StageRef]:
    """Every published store (of one stage), by stage and key."""
    folders = sorted((root / "stages").glob(f"{stage or '*'}/*"))
    return [StageRef(path.parent.name, path.name, path) for path in folders if _is_published(path)]


def published_runs(root: Path) -> list[Path]:
    """Folders of the published runs, oldest first: by the second in their names, then by when they were written."""
    folders = [path for path in (root / "runs").glob("*") if _is_published(path)]
    ages = {path: (path / MANIFEST_NAME).lstat().st_mtime_ns for path in folders}
    return sorted(ages, key=lambda folder: (folder.name[:SECOND], ages[folder], folder.name))


def _is_published(folder: Path) -> bool:
    """Whether a folder has a manifest, be it a damaged one, or a link."""
    return not folder.name.endswith(PART_SUFFIX) and os.path.lexists(folder / MANIFEST_NAME)


def without_manifest(root: Path) -> list[Path]:
    """What lies among stores and runs and is neither: folders that lost their manifest, and other people's files."""
    inside = [*root.glob("stages/*/*"), *root.glob("runs/*")]
    loose = [path for path in root.glob("stages/*") if not path.is_dir()]
    return sorted(path for path in (*inside, *loose) if not path.name.endswith(PART_SUFFIX) and not _is_published(path))


def in_text(text: str) -> str | None:
    """The store's address that a text such as ``stages/rectify/<key>/mosaic.zarr`` begins with, or None."""
    found = STORE_URI.match(text)
    if found is None or not all(is_name(part) for part in found.groups()):  # stages/../.. leads out of the archive
        return None
    return found.group(0)

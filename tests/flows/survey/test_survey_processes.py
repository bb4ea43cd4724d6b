"""A survey whose blocks processes make."""

from __future__ import annotations

import hashlib
from pathlib import Path

from tests.conftest import Survey


def test_processes_make_the_same_archive(tmp_path: Path, survey_png: Survey) -> None:
    """A whole survey by two processes publishes the same keys and the same bytes as one by threads."""
    roots = tmp_path / "threads", tmp_path / "processes"
    survey_png(roots[0])
    survey_png(roots[1], scheduler="processes", workers=2)
    kept = [
        {path.relative_to(root): hashlib.sha256(path.read_bytes()).hexdigest() for path in files_of(root)}
        for root in roots
    ]
    assert kept[0] == kept[1]


def files_of(root: Path) -> list[Path]:
    """What stages made, but for the times in manifests."""
    return [path for path in (root / "stages").rglob("*") if path.is_file() and path.name != "manifest.json"]

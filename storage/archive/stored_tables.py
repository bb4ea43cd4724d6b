"""Small tables of JSON in published stores: plans, records and figures, read only as they were published."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.errors import IncompleteStoreError
from storage.archive.manifests import CURE, file_problem, read_manifest
from storage.archive.plain_files import read_plain


def read_table(path: Path) -> dict[str, Any]:
    """Content of a file directly in a published store's folder.

    Raises
    ------
    IncompleteStoreError : the store's manifest does not list the file, or not one of these bytes.
    """
    entry = read_manifest(path.parent)["files"].get(path.name)
    problem = "is in no manifest" if entry is None else file_problem(path, entry, hashes=True)
    if problem is not None:
        raise IncompleteStoreError(f"{path} {problem}; {CURE}")
    table: dict[str, Any] = json.loads(read_plain(path))
    return table


def write_table(path: Path, content: Mapping[str, Any]) -> None:
    """Write plain values in their own order; numpy's numbers become floats."""
    path.write_text(json.dumps(content, indent=1, default=float) + "\n")

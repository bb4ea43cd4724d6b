"""Tables of published stores are read as they were published, or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.errors import IncompleteStoreError
from storage.archive.archive import Archive
from storage.archive.manifests import read_table


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """A table in a store."""

    def build(path: Path) -> None:
        (path / "plan.json").write_text('{"seats": [1, 2], "share": 0.25}')

    return Archive.open(tmp_path).produce("attend", build, version=1, params={})[0].path / "plan.json"


def test_a_table_comes_back(table: Path) -> None:
    """As it was written."""
    assert read_table(table) == {"seats": [1, 2], "share": 0.25}


@pytest.mark.parametrize("content", ['{"seats": [1, 3], "share": 0.25}', '{"seats": [1, 2], "share": 0.25', ""])
def test_a_changed_table_is_not_read(table: Path, content: str) -> None:
    """One other digit is as bad as what is no JSON."""
    table.write_text(content)
    with pytest.raises(IncompleteStoreError, match=r"plan\.json has .*verify --repair"):
        read_table(table)


def test_a_missing_or_foreign_table_is_not_read(table: Path) -> None:
    """Neither what is gone, nor what somebody put there."""
    (table.parent / "other.json").write_text("{}")
    with pytest.raises(IncompleteStoreError, match=r"other\.json is in no manifest"):
        read_table(table.parent / "other.json")
    table.unlink()
    with pytest.raises(IncompleteStoreError, match=r"plan\.json cannot be read: it is missing"):
        read_table(table)

"""The folder of one run: its files lie in it and nowhere else, and its name is free as soon as it is published."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.errors import ArchiveError
from storage.archive.archive import Archive
from storage.archive.run_folders import try_exchange


@pytest.mark.parametrize("name", ["../receipt.json", "/tmp/receipt.json", "a/b", "", ".", "x.part"])
def test_files_of_a_run_stay_in_it(tmp_path: Path, name: str) -> None:
    """What could lie elsewhere is refused, and the run is as before."""
    with Archive.open(tmp_path / "archive").new_run("farm") as draft:
        with pytest.raises(ArchiveError, match="cannot be a name"):
            draft.write_file(name, "x")
        assert list(draft.folder.iterdir()) == []
    assert [path.name for path in tmp_path.iterdir()] == ["archive"]


def test_a_published_run_holds_nothing(tmp_path: Path) -> None:
    """Also where nobody leaves a block; to abandon it then does nothing."""
    draft = Archive.open(tmp_path).new_run("farm")
    draft.write_file("receipt.json", "{}")
    folder = draft.publish()
    assert list((tmp_path / ".locks").iterdir()) == []
    draft.abandon()
    assert (folder / "receipt.json").read_text() == "{}"


def test_a_block_that_fails_publishes_nothing(tmp_path: Path) -> None:
    """And leaves no folder."""
    archive = Archive.open(tmp_path)
    with pytest.raises(TypeError), archive.new_run("farm") as draft:
        draft.write_file("receipt.json", "{}")["no"]  # type: ignore[index]
    assert archive.runs() == []
    assert list((tmp_path / "runs").iterdir()) == []


def test_folders_exchange_their_names(tmp_path: Path) -> None:
    """Each has what the other had; a name that leads nowhere is the system's own error."""
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "who").write_text(name)
    assert try_exchange(tmp_path / "a", tmp_path / "b")
    assert [(tmp_path / name / "who").read_text() for name in "ab"] == ["b", "a"]
    with pytest.raises(FileNotFoundError):
        try_exchange(tmp_path / "a", tmp_path / "c")

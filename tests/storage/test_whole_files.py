"""Exported files appear whole or not at all; settings in TOML are read or refused with a clear error."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from spectralzoom.pipeline.errors import ArchiveError, SceneError
from spectralzoom.pipeline.toml_files import MOST_BYTES, read_toml
from spectralzoom.storage import whole_files
from spectralzoom.storage.readers.scene_toml import load_scene_settings
from spectralzoom.storage.whole_files import remove_leftovers, write_whole, written_aside


def _files(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def test_files_appear_together_and_replace_the_old(tmp_path: Path) -> None:
    """A missing folder is created, and other files in it stay."""
    folder = tmp_path / "a" / "b"
    for text in ("old", "new"):
        with written_aside(folder, ["x", "y"]) as aside:
            assert aside.parent == folder
            for name in ("x", "y", "scrap"):
                (aside / name).write_text(text)
        (folder / "mine").write_text("mine")
    assert _files(folder) == {"x": "new", "y": "new", "mine": "mine"}


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (KeyboardInterrupt(), pytest.raises(KeyboardInterrupt)),
        (OSError(errno.ENOSPC, "No space left"), pytest.raises(ArchiveError, match="the disk is full")),
    ],
)
def test_a_failed_write_keeps_the_old_files(tmp_path: Path, error: BaseException, told: Any) -> None:
    """Half-written files are removed; a full disk raises an error that says so."""
    write_whole(tmp_path / "x", "old")
    with told, written_aside(tmp_path, ["x"]) as aside:
        (aside / "x").write_text("half")
        raise error
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
    assert _files(tmp_path) == {"x": "old"}


def test_old_and_new_files_are_never_mixed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process killed between the renames leaves no old second file beside a new first one."""
    for name in ("x", "y"):
        (tmp_path / name).write_text("old")
    true = Path.replace
    seen = []

    def watched(self: Path, target: Path) -> Path:
        seen.append(_files(tmp_path))
        return true(self, target)

    monkeypatch.setattr(Path, "replace", watched)
    with written_aside(tmp_path, ["x", "y"]) as aside:
        for name in ("x", "y"):
            (aside / name).write_text("new")
    assert seen == [{"x": "old"}, {"x": "new"}]
    assert _files(tmp_path) == {"x": "new", "y": "new"}


def test_files_are_synced_before_they_are_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder is synced after the last rename."""
    events: list[str] = []
    monkeypatch.setattr(whole_files, "sync", lambda path: events.append(f"sync {Path(path).name}"))
    true = Path.replace

    def replace(self: Path, target: Path) -> Path:
        events.append(f"name {self.name}")
        return true(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    with written_aside(tmp_path / "out", ["x", "y"]) as aside:
        for name in ("x", "y"):
            (aside / name).write_text("new")
    assert events == ["sync x", "sync y", "name x", "name y", "sync out"]


def test_write_refuses_a_file_in_place_of_the_folder(tmp_path: Path) -> None:
    """A file above the folder and a relative path are refused too; the file stays as it is."""
    (tmp_path / "mine").write_text("mine")
    here = Path(os.path.relpath(tmp_path / "mine"))
    for folder in (tmp_path / "mine", tmp_path / "mine" / "below", here):
        with pytest.raises(ArchiveError, match="is or lies below a file, expected a folder; choose another --out"):
            write_whole(folder / "x", "")
    assert (tmp_path / "mine").read_text() == "mine"


def test_remove_leftovers_deletes_only_folders_of_killed_writers(tmp_path: Path) -> None:
    """Other folders stay, even those whose names begin or end like a leftover's."""
    for name in (".export-abc.part", "mine.part", ".export-mine"):
        (tmp_path / name).mkdir()
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".export-mine", "mine.part"]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"seed = " + b"9" * 5000, "4300 digits"),
        (b"seed = " + b"[" * 10_000 + b"]" * 10_000, "nested too deeply"),
        (b"seed = ", "Invalid value"),
        (b"name = '\xff'", "can't decode byte 0xff"),
        (b"#" * (MOST_BYTES + 1), "settings have a few thousand"),
        (None, "no plain file"),
    ],
)
def test_unreadable_toml_raises_a_clear_error(tmp_path: Path, content: bytes | None, why: str) -> None:
    """Huge integers, deep nesting and a pipe without a writer raise these errors; none of them hangs."""
    path = tmp_path / "scene.toml"
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=why):
        read_toml(path)
    with pytest.raises(SceneError, match="cannot be read as TOML"):
        load_scene_settings(path)

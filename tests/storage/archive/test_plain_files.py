"""What is no file is refused by what it is, at once, and before it is opened."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from pipeline.errors import SceneError
from storage.archive.staging import MOST_BYTES, NotPlainError, kind_of, open_plain, plain_size, read_plain, read_toml
from storage.readers.scene_toml import load_scene_settings


def make(kind: str, path: Path) -> None:
    """Put something of a kind at a path."""
    if kind == "a link":
        path.with_name("target").write_bytes(b"elsewhere")
        path.symlink_to("target")
    elif kind == "a folder":
        path.mkdir()
    elif kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a socket":
        bound = socket.socket(socket.AF_UNIX)
        bound.bind(str(path))
        bound.close()
    else:
        path.write_bytes(b"content")


@pytest.mark.parametrize("kind", ["a link", "a folder", "a pipe", "a socket"])
@pytest.mark.parametrize("use", [read_plain, plain_size, lambda path: open_plain(path, os.O_RDWR | os.O_CREAT)])
def test_what_is_no_file_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, use: object) -> None:
    """Its kind in words, whatever it is opened for; nothing is read, made or waited for."""
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    make(kind, Path("x"))
    assert kind_of(Path("x")) == kind
    with pytest.raises((NotPlainError, IsADirectoryError)) as told:
        use(Path("x"))  # type: ignore[operator]
    assert "expected a file" in str(told.value.strerror) or kind == "a folder"


def test_a_device_is_not_even_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some act on that, and it may give bytes without end."""
    monkeypatch.setattr(os, "open", lambda *given: pytest.fail("it was opened"))
    with pytest.raises(NotPlainError, match="it is a device, expected a file"):
        read_plain(Path("/dev/zero"))


def test_a_file_is_read(tmp_path: Path) -> None:
    """Also through folders that are links: what is not followed is the last name."""
    (tmp_path / "real").mkdir()
    make("a file", tmp_path / "real" / "x")
    (tmp_path / "linked").symlink_to("real")
    assert read_plain(tmp_path / "linked" / "x") == b"content"
    assert plain_size(tmp_path / "linked" / "x") == 7
    assert kind_of(tmp_path / "linked") == "a link"
    assert kind_of(tmp_path / "nothing") is None


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"seed = " + b"9" * 5000, "a number of more than 4300 digits"),
        (b"seed = " + b"[" * 10_000 + b"]" * 10_000, "nested too deeply"),
        (b"seed = ", "Invalid value"),
        (b"name = '\xff'", "can't decode byte 0xff"),
        (b"#" * (MOST_BYTES + 1), "settings have a few thousand"),
        (None, "no plain file"),
    ],
)
def test_what_cannot_be_read_is_said_in_a_sentence(tmp_path: Path, content: bytes | None, why: str) -> None:
    """Endless digits, nesting without end, a pipe that nobody writes to: none hangs, none is another error."""
    path = tmp_path / "scene.toml"
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=why):
        read_toml(path)
    with pytest.raises(SceneError, match="cannot be read as TOML"):
        load_scene_settings(path)


def test_a_byte_order_mark_is_passed_over(tmp_path: Path) -> None:
    """Some editors write one."""
    path = tmp_path / "survey.toml"
    path.write_bytes(b"\xef\xbb\xbfseed = 1\r\n")
    assert read_toml(path) == {"seed": 1}


def test_a_device_is_no_file() -> None:
    """It would never end."""
    with pytest.raises(ValueError, match="no plain file"):
        read_toml(Path("/dev/zero"))

"""Settings in TOML: each file is read, or refused in one sentence."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pipeline.errors import SceneError
from storage.archive.staging import MOST_BYTES, read_toml
from storage.readers.scene_toml import load_scene_settings


def test_a_byte_order_mark_is_read_over(tmp_path: Path) -> None:
    """Some editors write one."""
    (tmp_path / "survey.toml").write_bytes(b"\xef\xbb\xbfseed = 1\r\n")
    assert read_toml(tmp_path / "survey.toml") == {"seed": 1}


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

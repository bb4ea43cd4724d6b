"""Scenes with another file at each visit, by its date."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from spectralzoom.flows.cli.serve_command import load_fields
from spectralzoom.flows.opening.scene import scene_of_visit
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.pipeline.errors import NoSceneYet, SettingsError

JUNE = datetime(2026, 6, 1, 12, tzinfo=UTC)


def write_scene(folder: Path, name: str) -> Path:
    """Write a small picture; return its path."""
    folder.mkdir(exist_ok=True)
    values = np.random.default_rng(len(name)).integers(0, 255, (32, 40, 3), dtype=np.uint8)
    Image.fromarray(values).save(folder / name)
    return folder / name


def asked(tmp_path: Path, pattern: str) -> Settings:
    """Return the settings of a survey of a pattern in the folder ``scenes``."""
    return load_settings(
        None, {"scene": str(tmp_path / "scenes" / pattern), "out": str(tmp_path / "a"), "engine": "plain"}
    )


def test_the_date_of_the_visit_names_the_file(tmp_path: Path) -> None:
    """Any strftime format is allowed."""
    names = {"{date:%Y-%m-%d}.png": "2026-06-01.png", "T32_{date:%Y%m%d}_b.png": "T32_20260601_b.png"}
    for pattern, name in names.items():
        wanted = write_scene(tmp_path / "scenes", name)
        assert scene_of_visit(asked(tmp_path, pattern), JUNE).scene == str(wanted)
    with pytest.raises(NoSceneYet, match=r"no file .*2026-06-02.png yet, which --scene .*date"):
        scene_of_visit(asked(tmp_path, "{date:%Y-%m-%d}.png"), JUNE.replace(day=2))


def test_a_scene_without_a_pattern_is_kept(tmp_path: Path) -> None:
    """Braces may be part of a file's name."""
    settings = asked(tmp_path, "field{1}.png")
    assert scene_of_visit(settings, JUNE) is settings
    with pytest.raises(SettingsError, match=r"braces are \{date:%Y-%m-%d\}$"):
        scene_of_visit(asked(tmp_path, "{date:%Y}/{field}.png"), JUNE)


def test_a_schedule_may_begin_without_a_scene(
    field_file: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A message says so."""
    pattern = {"scene": str(tmp_path / "scenes" / "{date:%Y-%m-%d}.png"), "source": None, "budget": None}
    (field,) = load_fields([field_file("north", **pattern)]).values()
    assert field.scene == pattern["scene"]
    assert "each due run looks for it again" in capsys.readouterr().err

"""Scenes with another file at each visit: by its date, or the newest that was not surveyed."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flows.cli.serve_command import load_fields
from flows.settings.load import load_settings
from flows.settings.survey_settings import Settings
from flows.survey_command import run_survey
from flows.tasks.scene import scene_of_visit
from pipeline.errors import NoSceneYet, NothingToMend, SettingsError, WeightsError
from tests.conftest import QUIET

JUNE = datetime(2026, 6, 1, 12, tzinfo=UTC)


def write_scene(folder: Path, name: str, written_s: float = 0.0) -> Path:
    """Write a small picture with a modification time so many seconds after the others; return its path."""
    folder.mkdir(exist_ok=True)
    values = np.random.default_rng(len(name)).integers(0, 255, (32, 40, 3), dtype=np.uint8)
    Image.fromarray(values).save(folder / name)
    os.utime(folder / name, (1e9 + written_s, 1e9 + written_s))
    return folder / name


def asked(tmp_path: Path, pattern: str, **more: Any) -> Settings:
    """Return the settings of a survey of a pattern in the folder ``scenes``."""
    return load_settings(
        None, {"scene": str(tmp_path / "scenes" / pattern), "out": str(tmp_path / "a"), "engine": "plain", **more}
    )


def test_the_date_of_the_visit_names_the_file(tmp_path: Path) -> None:
    """Any strftime format is allowed, and {new} stands for the rest of the name."""
    names = {"{date:%Y-%m-%d}.png": "2026-06-01.png", "T32_{date:%Y%m%d}_{new}.png": "T32_20260601_b.png"}
    for pattern, name in names.items():
        wanted = write_scene(tmp_path / "scenes", name)
        assert scene_of_visit(asked(tmp_path, pattern), JUNE).scene == str(wanted)
    with pytest.raises(NoSceneYet, match=r"no file .*2026-06-02.png yet, which --scene .*date"):
        scene_of_visit(asked(tmp_path, "{date:%Y-%m-%d}.png"), JUNE.replace(day=2))


def test_a_scene_without_a_pattern_is_kept(tmp_path: Path) -> None:
    """Braces may be part of a file's name."""
    settings = asked(tmp_path, "field{1}.png")
    assert scene_of_visit(settings, JUNE) is settings
    with pytest.raises(SettingsError, match=r"braces are \{date:%Y-%m-%d\} or \{new\}"):
        scene_of_visit(asked(tmp_path, "{date:%Y}/{field}.png"), JUNE)


def test_new_scenes_are_surveyed_newest_first_until_none_is_left(tmp_path: Path, weights: Path) -> None:
    """Order is by modification time without label files; then the latest run remains until another file comes."""
    folder = tmp_path / "scenes"
    with pytest.raises(NoSceneYet, match="no file yet that --scene"):
        scene_of_visit(asked(tmp_path, "{new}.png"), JUNE)
    write_scene(folder, "z.png", 1)
    newest = write_scene(folder, "a.png", 2)
    write_scene(folder, "a_mask.png", 3)
    more = {"weights": str(weights), "name": "north"}
    for wanted in (newest, folder / "z.png"):
        published = run_survey(asked(tmp_path, "{new}.png", **more), QUIET)
        assert published.receipt["settings"]["scene"] == str(wanted)
    with pytest.raises(NothingToMend, match=r"nothing new: .*-north surveyed .*a.png") as told:
        run_survey(asked(tmp_path, "{new}.png", **more), QUIET)
    assert (tmp_path / "a" / "runs" / told.value.run).is_dir()
    later = write_scene(folder, "b.png", 4)
    assert scene_of_visit(asked(tmp_path, "{new}.png", **more), JUNE).scene == str(later)


def test_a_schedule_may_begin_without_a_scene(
    field_file: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A message says so; unusable weights are refused at once."""
    pattern = {"scene": str(tmp_path / "scenes" / "{new}.png"), "source": None, "budget": None}
    (field,) = load_fields([field_file("north", **pattern)])
    assert field.settings.scene == pattern["scene"]
    assert "each due run looks for it again" in capsys.readouterr().err
    with pytest.raises(WeightsError):
        load_fields([field_file("south", **pattern, weights=str(tmp_path / "none.safetensors"))])

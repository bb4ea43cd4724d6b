"""Three fields that one emulated rig looks at, and one visit of one of them: in this process, or in one to kill.

``python -m tests.soak.serving FOLDER FIELD MOMENT`` surveys a field for its due time.
"""

from __future__ import annotations

import logging
import sys
import tomllib
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from flows.settings.parameters import at_due_time

FIELDS = {"north": 1, "south": 2, "west": 3}  # with the seeds of their scenes
BANDS = ",".join(map(str, range(8, 264, 16)))  # 16 of the farm's 270
SCENE: dict[str, Any] = {
    "scene": "farm",
    "size": "128x128",
    "bands": BANDS,
    "day": 172,
    "camera": {"exposure_ms": 9.0, "readout_ms": 1.0},
}


def scene_settings() -> dict[str, dict[str, Any]]:
    """What stands before the rig, for each field."""
    return {name: {**SCENE, "seed": seed} for name, seed in FIELDS.items()}


def write_fields(folder: Path, archive: Path, rig: Mapping[str, Any]) -> None:
    """Write the settings of each field, NAME.toml."""
    for name, scene in scene_settings().items():
        told = {
            "name": name,
            **scene,
            "source": "rig",
            "out": str(archive),
            "engine": "plain",
            "controls": False,
            "budget": 0.8,
            "rig": dict(rig),
        }
        tables = {key: value for key, value in told.items() if isinstance(value, dict)}
        lines = [f"{key} = {_toml(value)}" for key, value in told.items() if key not in tables]
        for table, values in tables.items():
            lines += [f"[{table}]", *(f"{key} = {_toml(value)}" for key, value in values.items())]
        text = "\n".join([*lines, ""])
        tomllib.loads(text)
        (folder / f"{name}.toml").write_text(text)


def _toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else str(value)


def survey_due(folder: Path, name: str, due: datetime) -> Path:
    """Survey a field for a due time; gives the folder of the published run."""
    return run_survey(at_due_time(load_settings(folder / f"{name}.toml"), due), Console(quiet=True)).folder


if __name__ == "__main__":
    logging.disable(logging.ERROR)
    survey_due(Path(sys.argv[1]), sys.argv[2], datetime.fromisoformat(sys.argv[3]))

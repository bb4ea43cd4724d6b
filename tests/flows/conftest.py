"""The command line in this process, and a Prefect that keeps to a folder of its own."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from flows.cli.main import main
from flows.schedule.served import NAMED_BY
from flows.survey.prefect_engine import PASSWORD, QUIET

CommandLine = Callable[..., "Ended"]


@dataclass(frozen=True)
class Ended:
    """How a command ended and what it wrote."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """The messages that begin with ``error:``."""
        return [line.removeprefix("error: ") for line in self.err.splitlines() if line.startswith("error: ")]


@pytest.fixture
def command_line(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    """Run ``spectralzoom`` with the given words in this process."""

    def run(*words: object) -> Ended:
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit_:
            main([str(word) for word in words])
        return Ended(int(exit_.value.code or 0), *capfd.readouterr())

    return run


@pytest.fixture(scope="session", autouse=True)
def prefect_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Prefect's files in a folder of their own. Set before any test imports it, as it reads its settings only then."""
    home = tmp_path_factory.mktemp("prefect")
    with pytest.MonkeyPatch.context() as patch:
        known = {"PREFECT_API_AUTH_STRING": PASSWORD, "PREFECT_SERVER_API_AUTH_STRING": PASSWORD}
        for name, value in {**QUIET, **known, "PREFECT_HOME": str(home)}.items():
            patch.setenv(name, value)
        yield home


@pytest.fixture
def field_file(tmp_path: Path, scene_files: Path, weights: Path) -> Callable[..., Path]:
    """Write a field's settings, with other lines before them."""

    def write(stem: str = "north", lines: str = "", **changes: str | None) -> Path:
        values: dict[str, str | None] = {
            "scene": str(scene_files / "scene.png"),
            "weights": str(weights),
            "budget": "0.8",
            "out": str(tmp_path / "archive"),
            **changes,
        }
        path = tmp_path / f"{stem}.toml"
        told = "\n".join(f'{key} = "{value}"' for key, value in values.items() if value is not None)
        path.write_text(f"{lines}\n{told}\n")
        return path

    return write


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Say what scheduled flows of this test may survey, as `serve` does."""

    def say(*files: Path, **words: object) -> Path:
        path = tmp_path / "served.json"
        path.write_text(json.dumps({"files": [str(file) for file in files], "timezone": "UTC", **words}))
        monkeypatch.setenv(NAMED_BY, str(path))
        return path

    return say

"""The command line in this process, Prefect with a folder of its own, and archives of tiny surveys."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from spectralzoom.flows.cli.main import main
from spectralzoom.flows.local_server import CONSOLE, local_server
from spectralzoom.flows.stage import Stage
from spectralzoom.storage.arrays.class_maps import load_class_map
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive
from tests.conftest import Flags, Survey
from tests.flows.small_fields import write_field
from tests.prior_work import without_effects
from tests.source_paths import PYTHON_PATH

CommandLine = Callable[..., "Ended"]
FEW_BANDS = ",".join(map(str, range(4, 270, 9)))  # of the farm: the fewest that give all the shipped weights' columns


@dataclass(frozen=True)
class Ended:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """Return the messages that begin with ``error:``."""
        return [line.removeprefix("error: ") for line in self.err.splitlines() if line.startswith("error: ")]

    def refused(self, code: int, pattern: str) -> None:
        """Assert that the command ended with this code, one message that matches, and no traceback."""
        assert (self.code, len(self.errors)) == (code, 1), self.err
        assert re.search(pattern, self.errors[0]), self.errors[0]
        assert "Traceback" not in self.err


def problems(out: Path) -> list[str]:
    """Return the problems that a full verification of an archive finds."""
    return [f"{one.uri} {one.problem}" for one in verify_everything(Archive.open(out)) if one.problem]


def class_map(out: Path) -> np.ndarray:
    """Return the only class map of an archive."""
    (ref,) = Archive.open(out).refs("segment")
    return load_class_map(ref.path / "class_map.zarr").classes


class Page(HTMLParser):
    """Parser of a page that checks the order of closing tags; collects links, loaded addresses and scripts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.open: list[str] = []
        self.scripts: list[str] = []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect addresses; void tags are not opened, and frames and external scripts are refused."""
        assert tag not in ("link", "iframe")
        data = tag == "script" and ("type", "application/json") in attrs  # data does not run
        assert tag != "script" or data or not attrs
        found = [str(value) for name, value in attrs if name in ("src", "href", "srcset", "action", "xlink:href")]
        if tag == "a":
            self.links += found
        self.loaded += [one for one in found if tag != "a" and not one.startswith("#")]  # except parts of the page
        if tag not in ("meta", "img", "input"):
            self.open.append("data" if data else tag)

    def handle_data(self, data: str) -> None:
        """Collect the text of scripts."""
        if self.open and self.open[-1] == "script":
            self.scripts.append(data)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect addresses and close the tag at once."""
        self.handle_starttag(tag, attrs)
        if tag not in ("meta", "img", "input"):
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        """Assert that the innermost open tag closes."""
        assert self.open.pop() in (tag, "data" if tag == "script" else tag)


RECORDED_S = 30.0  # time for a server to record the end of a task


def newest_run(flow: str, count: int) -> tuple[Any, dict[str, Any]]:
    """Return the newest run of a flow and its ``count`` task runs by name, as soon as the server has them ended.

    The server records tasks by events, the last one after the flow has ended.
    """
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import (
        FlowFilter,
        FlowFilterName,
        FlowRunFilter,
        FlowRunFilterId,
        FlowRunFilterStartTime,
    )
    from prefect.client.schemas.sorting import FlowRunSort

    with get_client(sync_client=True) as client:
        named = FlowFilter(name=FlowFilterName(any_=[flow]))
        begun = FlowRunFilter(start_time=FlowRunFilterStartTime(is_null_=False))  # other runs have deployments here
        (run,) = client.read_flow_runs(
            flow_filter=named, flow_run_filter=begun, sort=FlowRunSort.START_TIME_DESC, limit=1
        )
        of_it = FlowRunFilter(id=FlowRunFilterId(any_=[run.id]))
        latest = time.monotonic() + RECORDED_S
        tasks = client.read_task_runs(flow_run_filter=of_it)
        while time.monotonic() < latest and not (
            len(tasks) >= count and all(task.state is not None and task.state.is_final() for task in tasks)
        ):
            time.sleep(0.2)
            tasks = client.read_task_runs(flow_run_filter=of_it)
    return run, {task.name: task for task in tasks}


def turned(scene: Path, to: Path) -> Path:
    """Write a picture turned by 180 degrees, as another field of the same size, and return its path."""
    with Image.open(scene) as image:
        image.transpose(Image.Transpose.ROTATE_180).save(to)
    return to


def python(code: str, *words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code of this project in another process and return the result."""
    known = {**os.environ, "PYTHONPATH": PYTHON_PATH, **environment}
    command = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(command, env=known, capture_output=True, text=True, check=False)


def stages() -> dict[str, Stage[Any]]:
    """Return the stages of a survey by name."""
    from spectralzoom.flows import survey

    return {name: one for name, one in vars(survey).items() if isinstance(one, Stage)}


def act_instead(patch: pytest.MonkeyPatch, name: str, act: Callable[..., Any]) -> None:
    """Call ``act`` in place of a stage of the survey."""
    patch.setattr(f"spectralzoom.flows.survey.{name}", act)


def be_version(patch: pytest.MonkeyPatch, product: str, version: int) -> None:
    """Make all stages of a product write another version of it."""
    for name, stage in stages().items():
        if stage.product == product:
            act_instead(patch, name, replace(stage, version=version))


@pytest.fixture
def command_line(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    """Return a function that runs ``spectralzoom`` with the given words in this process."""

    def run(*words: object) -> Ended:
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit_:
            main([str(word) for word in words])
        return Ended(int(exit_.value.code or 0), *capfd.readouterr())

    return run


@pytest.fixture(scope="session", autouse=True)
def prefect_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield a folder for Prefect's files, set before the first import of Prefect, which reads its settings once."""
    home = tmp_path_factory.mktemp("prefect")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {CONSOLE: "CRITICAL", "DO_NOT_TRACK": "1", "PREFECT_HOME": str(home)}.items():
            patch.setenv(name, value)
        yield home


@contextmanager
def server_for_all(home: Path, **options: bool) -> Iterator[str]:
    """Run a server and name it in the environment, for commands of this process and for others; yield its API."""
    with local_server(home, **options) as api, pytest.MonkeyPatch.context() as patch:
        patch.setenv("PREFECT_API_URL", api)
        patch.setenv("PREFECT_API_AUTH_STRING", (home / "password").read_text().strip())
        yield api


@pytest.fixture(scope="module")
def server(prefect_home: Path) -> Iterator[str]:
    """Yield the API address of a Prefect server that all flows of a module share."""
    with server_for_all(prefect_home) as api:
        yield api


@pytest.fixture
def field_file(tmp_path: Path, flags_png: Flags) -> Callable[..., Path]:
    """Return a function that writes a field's settings, with other lines before them."""

    def write(stem: str = "north", lines: str = "", **changes: str | None) -> Path:
        values = flags_png(tmp_path / "archive", budget="0.8") | changes
        path = tmp_path / f"{stem}.toml"
        told = "\n".join(f'{key} = "{value}"' for key, value in values.items() if value is not None)
        path.write_text(f"{lines}\n{told}\n")
        return path

    return write


@pytest.fixture(scope="session")
def two_budgets(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> Path:
    """Return an archive of two surveys of one scene with budgets of 0.8 and 0.7; do not change it."""
    folder = tmp_path_factory.mktemp("two_budgets") / "archive"
    with without_effects():
        for budget in ("0.8", "0.7"):
            survey_png(folder, budget=budget)
    return folder


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of three small frames for all evaluations."""
    return write_field(tmp_path_factory.mktemp("evaluate") / "field")

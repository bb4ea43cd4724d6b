"""Advice of messages: its flags exist, and the program accepts them for the very input that it was printed for."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spectralzoom.flows.cli.main import VERBS, build_app
from spectralzoom.flows.settings.flags import KEYS
from spectralzoom.flows.settings.load import flag_of
from tests.flows.conftest import command_line

__all__ = ["command_line"]

ROOT = Path(__file__).parents[2]
ROOMS = ("flows", "models", "pipeline", "storage")
COMMAND = re.compile(r"spectralzoom ((?:rig )?[a-z]+)((?: [^ ;.,`]+)*)")
FLAG = re.compile(r"(?<![\w/-])--([a-z][a-z.-]*[a-z])")
OF_OTHERS = {"create-namespace"}  # of other programs


def texts() -> Iterator[tuple[str, str]]:
    """Yield the place and the text of every message in the source, with braces for what is filled in."""
    for path in (path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))):
        tree = ast.parse(path.read_text())
        inner = {id(part) for one in ast.walk(tree) if isinstance(one, ast.JoinedStr) for part in one.values}
        docs = {id(one.value) for one in ast.walk(tree) if isinstance(one, ast.Expr)}
        for one in ast.walk(tree):
            if isinstance(one, ast.JoinedStr):
                parts = (part.value if isinstance(part, ast.Constant) else "{}" for part in one.values)
                yield f"{path.relative_to(ROOT)}:{one.lineno}", "".join(map(str, parts))
            elif isinstance(one, ast.Constant) and isinstance(one.value, str) and not {id(one)} & (inner | docs):
                yield f"{path.relative_to(ROOT)}:{one.lineno}", one.value


def flags_of(verb: str) -> set[str]:
    """Return the flags of a verb, and the negative ones."""
    app = build_app(listed=False)
    for word in verb.split():
        app = app[word]
    names = {name for one in app.assemble_argument_collection() for name in one.names if name.startswith("--")}
    return {name.removeprefix("--") for name in names}


def test_every_flag_and_command_of_a_message_exists() -> None:
    """A flag stands behind a verb that has it, or alone where some verb has it."""
    known = {verb: flags_of(verb) for verb in VERBS}
    known["survey"] |= {flag_of(key).removeprefix("--") for key in KEYS}
    every = set().union(*known.values()) | {"help", "version"}
    wrong, count = [], 0
    for place, text in texts():
        count += len(FLAG.findall(text))
        wrong += [f"{place}: --{flag}" for flag in FLAG.findall(text) if flag not in every | OF_OTHERS]
        for verb, rest in COMMAND.findall(text):
            behind = {flag for flag in FLAG.findall(rest) if flag not in known.get(verb, set()) | {"help"}}
            wrong += [f"{place}: {verb} --{flag}" for flag in behind]
    assert wrong == []
    assert count > 100


@pytest.fixture
def field(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, with a cube of four bands."""
    np.save(tmp_path / "cube.npy", np.random.default_rng(0).uniform(20, 200, (24, 32, 4)).astype(np.float32))
    (tmp_path / "scene.toml").write_text("wavelengths_nm = [460, 550, 640, 800]\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("flags", ["", "--source sim", "--source sim --macs 50%", "--bands 0,1,2 --source sim"])
@pytest.mark.usefixtures("field")
def test_the_mosaic_that_is_advised_without_weights_is_accepted(flags: str, command_line: Any) -> None:
    """The flags of the message, behind the same words, plan a mosaic."""
    words = ["plan", "--scene", "cube.npy", *flags.split()]
    refused = command_line(*words)
    refused.refused(2, "--weights is missing")
    advice = refused.errors[0].partition("A mosaic needs none: ")[2].split()
    assert advice[:2] == ["--until", "mosaic"]
    assert command_line(*words, *advice).code == 0


@pytest.mark.parametrize(
    "flags", ["--source sim --budget .5", "--source sim --seconds 20", "--source sim --zoom always"]
)
@pytest.mark.usefixtures("field")
def test_no_mosaic_is_advised_where_it_would_be_refused(flags: str, command_line: Any) -> None:
    """A time budget is spent by the record of weights, so that no flag can be added for a mosaic without any."""
    ended = command_line("plan", "--scene", "cube.npy", *flags.split())
    ended.refused(2, "--weights is missing")
    assert "--until" not in ended.errors[0]

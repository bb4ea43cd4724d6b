"""The command line's own process: what it settles before anything is computed."""

from __future__ import annotations

import json
import os
import signal
import sys
from functools import reduce
from typing import Any

import pytest

from flows.cli import main as cli
from flows.cli.app import GOES_ON, VERBS, build_app
from flows.cli.survey_verbs import IN_TABLES
from flows.settings.load import SURVEY, TABLES
from flows.terminal.progress import print_json
from tests.flows.conftest import python

ONE_THREAD = """
import os, sys
from flows.cli.main import main
assert "numpy" not in sys.modules, "numpy has read its number of threads already"
try:
    main(["--version"])
except SystemExit:
    print(os.environ["OPENBLAS_NUM_THREADS"])
"""


def test_a_process_begins_with_one_thread_and_ends_as_it_would_have() -> None:
    """Sums split among threads round otherwise; SIGTERM has no effect once the exit code stands."""
    ended = python(ONE_THREAD, OPENBLAS_NUM_THREADS="2")
    assert (ended.returncode, ended.stdout.split()[-1]) == (0, "1"), ended.stderr
    ended = python(ENDING)
    assert (ended.returncode, ended.stderr) == (0, "")


def _flags(verb: str) -> dict[str, str | None]:
    """What a verb takes, and what its help says of each."""
    named = reduce(lambda found, word: found[word], verb.split(), build_app(listed=False))
    found = named.assemble_argument_collection(parse_docstring=True)
    return {argument.name: argument.parameter.help for argument in found if argument.name != "*"}


def test_help_lists_every_verb_and_loads_none(capsys: pytest.CaptureFixture[str]) -> None:
    """With the first sentence of each verb's own help; a verb's own help is whole."""
    script = (
        "import sys\nfrom flows.cli.main import main\ntry:\n    main(sys.argv[1:])\nfinally:\n    print(*sys.modules)"
    )
    ended = python(script, "--help")
    shown, loaded = ended.stdout.rsplit("\n", 2)[0], ended.stdout.split()
    assert not {"numpy", "torch", "prefect", "matplotlib", *VERBS.values()} & set(loaded)
    assert all(verb.split()[0] in shown for verb in VERBS)
    assert "that they were not" in " ".join(shown.split())  # of evaluate
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    assert "OUT.checkpoint" in capsys.readouterr().out


@pytest.mark.parametrize("verb", ["survey", "plan"])
def test_a_survey_can_be_planned_by_its_own_words(verb: str) -> None:
    """Every setting that is in no table has its flag, in both verbs."""
    assert {f"--{name.replace('_', '-')}" for name in {*SURVEY, *IN_TABLES} - set(TABLES)} <= set(_flags(verb))


@pytest.mark.parametrize("verb", VERBS)
def test_every_flag_says_what_it_is(verb: str) -> None:
    """Nobody has to guess."""
    assert [name for name, words in _flags(verb).items() if not words] == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["survy"], 'Unknown command "survy". Did you mean "survey"?; see spectralzoom --help'),
        (["survey", "--budgt", "1"], "Unknown option: --budgt. Did you mean --budget?; see spectralzoom survey --help"),
    ],
)
def test_a_wrong_word_is_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    """With the nearest right one, or why it went, and where all of them stand; no list that is cut off."""
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"error: {message}\n"


def test_printed_json_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    """What is not finite has no place in it."""
    content: dict[str, Any] = {"a": float("nan"), "b": [1.5, float("inf")], "name": "ü"}
    print_json(content)
    assert json.loads(capsys.readouterr().out, parse_constant=pytest.fail) == {"a": None, "b": [1.5, None], "name": "ü"}


def test_closed_streams_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    """A service may start without them; a file that is opened later must not take the place of one."""
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    with pytest.raises(SystemExit) as left:
        cli.main(["--version"])
    assert left.value.code == 0
    for stream in (sys.stdin, sys.stdout, sys.stderr):
        assert stream.name == os.devnull
        stream.close()


@pytest.mark.parametrize("verb", VERBS)
def test_sigterm_ends_any_verb(verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """143 and one sentence, which says whether the same command goes on; afterwards SIGTERM is what it was before."""

    def terminated() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("SIGTERM was not heard")

    monkeypatch.setattr(f"{VERBS[verb]}.{verb.split()[-1]}", terminated)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as left:
        cli.main(verb.split())
    goes_on = "; run the same command to resume" if verb in GOES_ON else ""
    assert (left.value.code, capsys.readouterr().err.strip()) == (143, f"terminated{goes_on}")
    assert signal.getsignal(signal.SIGTERM) is before


ENDING = """
import atexit, os, signal, sys
from flows.cli.main import main
atexit.register(lambda: os.kill(os.getpid(), signal.SIGTERM))
sys.argv[1:] = ["--version"]
main()
"""

"""The process of the command line: threads, help, usage errors and signals."""

from __future__ import annotations

import os
import re
import signal
import sys
from functools import reduce

import pytest

from spectralzoom.flows.cli import main as cli
from spectralzoom.flows.cli.main import GOES_ON, VERBS, build_app
from spectralzoom.flows.settings.flags import GROUPS, KEYS
from tests.flows.conftest import python

ONE_THREAD = """
import os, sys
from spectralzoom.flows.cli.main import main
assert "numpy" not in sys.modules, "numpy has read its number of threads already"
try:
    main(["--version"])
except SystemExit:
    print(os.environ["OPENBLAS_NUM_THREADS"])
"""


def test_a_process_has_one_thread_and_ignores_a_late_sigterm() -> None:
    """Sums over threads round differently; SIGTERM at the end does not change the exit code."""
    ended = python(ONE_THREAD, OPENBLAS_NUM_THREADS="2")
    assert (ended.returncode, ended.stdout.split()[-1]) == (0, "1"), ended.stderr
    ended = python(ENDING)
    assert (ended.returncode, ended.stderr) == (0, "")


def _flags(verb: str) -> dict[str, str | None]:
    """Return the flags of a command, each with its help."""
    named = reduce(lambda found, word: found[word], verb.split(), build_app(listed=False))
    found = named.assemble_argument_collection(parse_docstring=True)
    return {argument.name: argument.parameter.help for argument in found if argument.name != "*"}


def test_help_lists_every_command_and_imports_none(capsys: pytest.CaptureFixture[str]) -> None:
    """The list has the first sentence of each command's help; a command's own help is complete."""
    called = "try:\n    main(sys.argv[1:])\nfinally:\n    print(*sys.modules)"
    script = f"import sys\nfrom spectralzoom.flows.cli.main import main\n{called}"
    ended = python(script, "--help")
    shown = ended.stdout.rsplit("\n", 2)[0]
    assert not {"numpy", "torch", "prefect", "matplotlib", *VERBS.values()} & set(ended.stdout.split())
    assert all(verb.split()[0] in shown for verb in VERBS)
    assert "that they were not" in " ".join(shown.split())  # from the help of evaluate
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    assert "OUT.checkpoint" in capsys.readouterr().out


@pytest.mark.parametrize("verb", ["survey", "plan"])
def test_survey_and_plan_have_a_flag_for_every_setting(verb: str) -> None:
    """Those of tables have the name of their table: --camera.exposure-ms."""
    assert {f"--{key.replace('_', '-')}" for key in KEYS} <= set(_flags(verb))


def test_the_first_page_of_help_is_short(capsys: pytest.CaptureFixture[str]) -> None:
    """It has at most 25 flags in groups; --help-all has the flag of every setting."""
    with pytest.raises(SystemExit):
        cli.main(["survey", "--help"])
    page = capsys.readouterr().out
    assert len(re.findall(r"^│ --", page, re.MULTILINE)) <= 25
    assert [page.index(f"─ {group} ─") for group in GROUPS] == sorted(page.index(f"─ {group} ─") for group in GROUPS)
    with pytest.raises(SystemExit):
        cli.main(["survey", "--help-all"])
    shown = capsys.readouterr().out.split()
    assert {f"--{key.replace('_', '-')}" for key in KEYS} - set(shown) == {"--accuracy", "--rig.white-at-rest"}
    assert {"--no-accuracy", "--rig.no-white-at-rest"} <= set(shown)


@pytest.mark.parametrize("verb", VERBS)
def test_every_flag_has_help(verb: str) -> None:
    """No help text is empty."""
    assert [name for name, words in _flags(verb).items() if not words] == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["survy"], 'Unknown command "survy". Did you mean "survey"?; see spectralzoom --help'),
        (
            ["survey", "--exposure-ms", "5"],
            "Unknown option: --exposure-ms. Settings of tables have the name of the table: --camera.exposure-ms; see "
            "spectralzoom survey --help",
        ),
        (["survey", "--budgt", "1"], "Unknown option: --budgt. Did you mean --budget?; see spectralzoom survey --help"),
    ],
)
def test_a_misspelt_word_gives_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    """It names the most similar word and the help; the line is not cut off."""
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"error: {message}\n"


def test_closed_streams_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    """A service may start without them; a file opened later must not get the number of one."""
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    with pytest.raises(SystemExit) as left:
        cli.main(["--version"])
    assert left.value.code == 0
    for stream in (sys.stdin, sys.stdout, sys.stderr):
        assert stream.name == os.devnull
        stream.close()


@pytest.mark.parametrize("verb", VERBS)
def test_sigterm_ends_commands(verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """It exits with 143 and one sentence, which tells if the command can resume; then the old handler is restored."""

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
from spectralzoom.flows.cli.main import main
atexit.register(lambda: os.kill(os.getpid(), signal.SIGTERM))
sys.argv[1:] = ["--version"]
main()
"""

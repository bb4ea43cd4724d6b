"""Bad input at the command line: one clear message or success, the right exit code, and an unchanged archive."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from spectralzoom.storage.store import Archive
from tests.flows.conftest import FEW_BANDS, CommandLine, act_instead, class_map, problems, stages

NM = "460,500,550,600,620,640"
RAN = "Report: "
CAMERA = "[camera]\nsamples = 64\n"  # narrow: most of a small survey's time goes into samples outside of the field


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, scene_files: Path, weights: Path, make_weights: Any) -> Path:
    """Return a folder of usual and unusual files."""
    here = tmp_path_factory.mktemp("bad")
    for path in scene_files.iterdir():
        shutil.copy(path, here)
    shutil.copy(weights, here / "w.safetensors")
    shutil.copy(make_weights(names=("soil", "crop", "tree")), here / "named.safetensors")
    (here / "camera.toml").write_text(CAMERA)
    picture = np.asarray(Image.open(here / "scene.png"))
    for name, values in {"tiny": picture[:5, :6], "black": np.zeros_like(picture[:32, :48])}.items():
        Image.fromarray(values).save(here / f"{name}.png")
    cube = np.load(here / "cube.npy")
    np.save(here / "one.npy", cube[..., :1])
    cube[3:9, 5:20] = cube[20, 20, 2] = np.nan
    np.save(here / "gaps.npy", cube)
    return here


@pytest.fixture(scope="module")
def surveyed(folder: Path, surveyed_png: Any) -> Path:
    """Return an archive with one survey."""
    surveyed_png(folder / "archive")
    return folder / "archive"


def contents(root: Path) -> dict[str, bytes | None] | None:
    """Return every file and folder below a path, or None if it does not exist."""
    if not root.exists():
        return None
    return {str(path.relative_to(root)): path.read_bytes() if path.is_file() else None for path in root.rglob("*")}


REFUSED = {
    "labels without names": (
        1,
        "--labels labels.png --weights named.safetensors",
        r"class 'class_0', .* table \[classes\] of the scene.toml beside the scene's file: soil = 0$",
    ),
    "budget below the coarse pass": (
        2,
        "--budget 0.1",
        r"a --budget of 0.1, \d.*below the time of the first pass of every 4th.*, or take one uniform scan \(without",
    ),
    "a first pass that others cannot halve": (
        2,
        "--zoom always --seconds 20 --scan-step 5",
        r"--scan-step = 5: the first of two passes takes every 4th or 8th line; give 4 or 8, or leave it out",
    ),
    "seconds below the fastest first pass": (
        2,
        "--scene farm --size 160x128 --weights farm --zoom always --seconds 1",
        r"--seconds 1 is below .* first pass of every 8th line, 1\.92 s of the full scan's 15\.15 s; give more",
    ),
    "farm beyond memory": (2, "--scene farm --size 60000x60000", "takes about .* GB of memory, this machine has"),
    "memory for no process": (
        2,
        "--memory 900MiB --budget 1 --scheduler processes",
        "exceeds --memory 900 MiB: .* each of two processes 512 MiB; give at least --memory 10.. MiB",
    ),
}


def survey_words(more: str, out: str = "archive") -> list[str]:
    """Return a working survey command with flags added or replaced."""
    words = ["--scene", "scene.png", "--source", "sim", "--weights", "w.safetensors", "--engine", "plain"]
    words += ["--out", out]
    given = more.split()
    for flag in given[::2]:
        if flag in words:
            place = words.index(flag)
            del words[place : place + 2]
    return ["survey", *words, *given]


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_is_refused_with_one_message(
    case: str, folder: Path, surveyed: Path, command_line: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exit code is right, the message has a remedy, there is no traceback, and no archive is made or changed."""
    code, words, message = REFUSED[case]
    monkeypatch.chdir(folder)
    before = contents(surveyed)
    out = "archive" if list(REFUSED).index(case) % 2 else "never_made"
    ended = command_line(*survey_words(words, out))
    ended.refused(code, message)
    assert ended.out == ""
    assert contents(surveyed) == before
    assert not (folder / "never_made").exists()


WORKS = {
    "one band": ("--scene one.npy --wavelengths 550 --scan-step 1", "wavelengths stated: 550 nm"),
    "wavelengths out of order": ("--scene cube.npy --wavelengths 640,460,500,550,620,600 --scan-step 1", "640, 460"),
    "scene smaller than a patch": ("--scene tiny.png --budget 1", RAN),
    "NaN pixels": (f"--scene gaps.npy --wavelengths {NM} --scan-step 1", "given their band's median: 1 "),
    "all black": ("--scene black.png --scan-step 1", RAN),
}


@pytest.mark.parametrize("case", WORKS)
def test_unusual_input_works(
    case: str, folder: Path, tmp_path: Path, command_line: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The survey exits with 0 and notes its assumptions; every pixel with a value has a class; the archive verifies."""
    words, says = WORKS[case]
    monkeypatch.chdir(folder)
    flags = "--effects", "rotation,shot", "camera.toml"
    ended = command_line(*survey_words(words, str(tmp_path / "archive")), *flags)
    assert (ended.code, ended.errors) == (0, [])
    assert says in " ".join(ended.err.split())
    assert problems(tmp_path / "archive") == []
    drawn = class_map(tmp_path / "archive")
    assert np.count_nonzero(drawn == 255) == (90 if case == "NaN pixels" else 0)
    assert set(np.unique(drawn)) <= {0, 1, 2, 255}


def test_a_survey_without_a_valid_spectrum_is_refused(
    folder: Path, tmp_path: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long exposure saturates every pixel; the captured lines are kept."""
    monkeypatch.chdir(folder)
    (tmp_path / "bright.toml").write_text(CAMERA)
    words = survey_words("--scan-step 1 --scan-exposure-ms 10000 --effects shot", str(tmp_path / "archive"))
    ended = command_line(*words, str(tmp_path / "bright.toml"))
    ended.refused(1, "no spectrum of the sweeps is valid: .* saturated .* shorter exposure")
    assert Archive.open(tmp_path / "archive").refs("capture")


def test_later_surveys_run_after_a_failed_one(
    command_line: CommandLine, field_file: Callable[..., Path], tmp_path: Path
) -> None:
    """The message names the file of the failed survey, whose exit code is used; a missing file stops all surveys."""
    few = {"scene": "farm", "size": "32x32", "source": None, "weights": None, "budget": None, "engine": "plain"}
    files = [field_file(stem, seconds=seconds, **few) for stem, seconds in (("a", "9"), ("b", "0.1"), ("c", "9"))]
    ended = command_line("survey", *files, "--bands", FEW_BANDS, "--no-accuracy", "--json")
    assert (ended.code, len(ended.errors)) == (2, 1)
    assert ended.errors[0].startswith(f"{files[1]}: ")
    told = json.loads(ended.out)["surveys"]
    assert [one.get("survey") for one in told] == ["farm", None, "farm"]
    assert (told[1]["settings"], f"{files[1]}: {told[1]['error']}") == (str(files[1]), ended.errors[0])
    assert f"survey 3 of 3: {files[2]}" in ended.err.replace("\n", "")
    archive = Archive.open(tmp_path / "archive")
    assert [run.name.split("-")[1] for run in archive.runs()] == ["farm"] * 2  # farm-2 within one second
    assert command_line("survey", files[0], tmp_path / "d.toml").code == 2
    assert len(archive.runs()) == 2


def test_receipts_of_finished_surveys_are_printed_after_an_interrupt(
    command_line: CommandLine, monkeypatch: pytest.MonkeyPatch, field_file: Callable[..., Path]
) -> None:
    """After Ctrl-C in the second survey the JSON object has the first one."""
    published = Mock(side_effect=[Mock(receipt={"survey": "a"}), KeyboardInterrupt])
    monkeypatch.setattr("spectralzoom.flows.survey_command.run_survey", published)
    ended = command_line("survey", field_file("a"), field_file("b"), "--json")
    assert (ended.code, json.loads(ended.out)) == (130, {"surveys": [{"survey": "a"}]})


def test_an_interrupted_survey_resumes(
    folder: Path, command_line: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Ctrl-C in a stage exits with 130 and one line; the same command then uses the stored lines."""
    monkeypatch.chdir(folder)
    words = survey_words("--budget 0.7 --effects none", str(tmp_path / "archive"))

    def interrupted(*given: Any, **facts: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        act_instead(patch, "score", replace(stages()["score"], build=interrupted))
        ended = command_line(*words)
    assert (ended.code, ended.out) == (130, "")
    assert "interrupted; run the same command to resume" in ended.err
    ended = command_line(*words)
    assert ended.code == 0
    assert "capture: 100% cached" in ended.err

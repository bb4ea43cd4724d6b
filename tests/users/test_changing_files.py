"""Another process writes to the user's files while a survey reads them: it is refused, and the rerun works."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.errors import SceneError, SurveyStopped
from tests.conftest import QUIET, patchy_scene
from tests.users.test_recorded_sweeps import write_pushbroom

WRITER = """
import os, sys
path, how = sys.argv[1:]
first = open(path, "rb").read()
other = first[:-2000] + bytes(byte ^ 1 for byte in first[-2000:])
about = os.stat(path)
for number in range(10**9):
    content = (first, other)[number % 2]
    if how == "in place":
        with open(path, "r+b") as file:
            file.write(content)
    else:
        open(path + ".new", "wb").write(content)
    name = path if how == "in place" else path + ".new"
    os.utime(name, ns=(about.st_atime_ns, about.st_mtime_ns))
    if how != "in place":
        os.replace(name, path)
    if number == 1:
        print("writing", flush=True)
"""


@contextmanager
def written_again_and_again(path: Path, how: str) -> Iterator[None]:
    """Let another process write two contents in turn, with one size and time; the first stays at the end."""
    content = path.read_bytes()
    command = [sys.executable, "-c", WRITER, str(path), how]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "writing\n"
        try:
            yield
        finally:
            writer.kill()
    path.write_bytes(content)


@pytest.mark.usefixtures("no_effects")
@pytest.mark.parametrize("how", ["in place", "by rename"])
@pytest.mark.parametrize("flag", ["scene", "sweeps"])
@pytest.mark.parametrize("name", ["scan.img", "a.npy"])
def test_a_survey_beside_a_writer(tmp_path: Path, flag: str, name: str, how: str) -> None:
    """One message, and no store: neither of the old nor of the new content. Then the same command maps the field."""
    values = (patchy_scene((96, 64), 3, 3)[0] * 12 + 60).astype(np.uint16)
    folder = write_pushbroom(tmp_path / "drone", values)
    address = folder / "scan.hdr"
    more: dict[str, Any] = {}
    if name == "a.npy":
        np.save(address := folder / name, values)
        more = {"wavelengths": "460,550,640"}
    path = folder / name
    usual = {"engine": "plain", "until": "mosaic", "out": str(tmp_path / "out"), flag: str(address), **more}
    asked = load_settings(None, usual)
    with written_again_and_again(path, how), pytest.raises(SceneError, match=f"{path.name} changed while it was read"):
        run_survey(asked, QUIET)
    assert not list((tmp_path / "out").glob("stages/*/*"))
    with pytest.raises(SurveyStopped, match="stopped after mosaic"):
        run_survey(asked, QUIET)
    with pytest.raises(SurveyStopped):
        run_survey(asked.but(out=str(tmp_path / "undisturbed")), QUIET)
    stores, undisturbed = (
        {
            path.relative_to(out): path.read_bytes()
            for path in sorted(out.glob("stages/*/*/*.zarr/**/*"))
            if path.is_file()
        }
        for out in (tmp_path / "out", tmp_path / "undisturbed")
    )
    assert stores
    assert stores == undisturbed

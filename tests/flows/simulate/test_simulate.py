"""`spectralzoom simulate`: raw cubes, their manifest as table and JSON, an interrupted scan, and refused input."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import pytest
import xarray as xr
from rich.console import Console

from spectralzoom.flows.publish.receipt_table import print_effects
from spectralzoom.pipeline.simulator.render import EFFECTS
from spectralzoom.pipeline.simulator.scenes.scene import SceneRaster
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from tests.flows.conftest import python

SAMPLES = 192  # samples of a line; a narrow camera is quick to simulate


def narrow(folder: Path) -> list[str]:
    """Write settings of a narrow camera to a folder and return the flags that name them."""
    file = folder / "camera.toml"
    file.write_text(f"[camera]\nsamples = {SAMPLES}\n")
    return ["--settings", str(file)]


def words(scene_files: Path, out: Path, *more: str) -> list[str]:
    """Return a command that scans the small picture coarsely."""
    given = ["-o", str(out), "--coarse", "--effects", "rotation,vignetting,shot,read-noise", *narrow(out.parent)]
    return ["simulate", str(scene_files / "scene.png"), *given, *more]


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the archive for the scan of this module."""
    return tmp_path_factory.mktemp("simulated") / "scan"


@pytest.fixture
def scan(command_line: Any, scene_files: Path, archive: Path) -> Any:
    """Return the scan's record; the first test makes the scan, the others find it."""
    return json.loads(command_line(*words(scene_files, archive, "--json")).out)


def test_simulated_cubes_have_a_manifest(scan: Any, archive: Path) -> None:
    """Every cube opens with plain xarray and records its effects; the scan's record has the figures of all cubes."""
    (cube,) = [xr.open_zarr(archive / name, consolidated=False) for name in scan["cubes"]]
    assert cube["dn"].dims == ("line", "sample", "band")
    assert scan["lines"] == cube.sizes["line"]
    assert scan["px_bands"] == cube.sizes["line"] * SAMPLES * 3
    assert scan["effects_total"].pop("saved_s") > 0  # of this run, and not in the cube
    assert cube.attrs["simulation"] == {"effects": scan["effects"], "total": scan["effects_total"]}
    assert [row["name"] for row in scan["effects"]] == [effect.name for effect in EFFECTS]


def test_a_stored_scan_reads_no_scene(
    scan: Any, command_line: Any, scene_files: Path, archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is cached, with the same cubes; the table is printed all the same, one effect a row and the sums below."""
    monkeypatch.setattr(SceneRaster, "thinned", Mock(side_effect=AssertionError("the scene was looked at")))
    ended = command_line(*words(scene_files, archive))
    assert (ended.code, ended.out) == (0, "")
    there = [one["name"] for one in scan["effects"] if one["reason"] != "absent"]
    for name in (*there, "already there", "Effects computed: 6 of 33", "coarse-0.zarr"):
        assert name in " ".join(ended.err.split())
    again = json.loads(command_line(*words(scene_files, archive, "--json")).out)
    assert again["cached"]
    assert again["cpu_s"] is None
    assert again["effects_total"]["saved_s"] == 0
    assert again["cubes"] == scan["cubes"]


@pytest.mark.parametrize(("workers", "begun"), [("1", [0, 7]), ("2", [0])])
def test_an_interrupted_scan_resumes_at_its_line(
    command_line: Any, scene_files: Path, tmp_path: Path, scan: Any, archive: Path, workers: str, begun: list[int]
) -> None:
    """Captured lines are not captured again and the cube is the same, also with two workers for the rest."""
    real = SimulatedSource.lines
    firsts = []

    def breaking(self: SimulatedSource, sweep: Any, first: int = 0) -> Iterator[Any]:
        firsts.append(first)
        for line in real(self, sweep, first):
            if line.number == 7 and len(firsts) == 1:
                raise KeyboardInterrupt
            yield line

    with patch.object(SimulatedSource, "lines", breaking):
        ended = command_line(*words(scene_files, tmp_path, "--workers", "1"))
        assert (ended.code, "run the same command to resume" in ended.err) == (130, True)
        again = json.loads(command_line(*words(scene_files, tmp_path, "--workers", workers, "--json")).out)
    assert (firsts, again["cubes"]) == (begun, scan["cubes"])
    cubes = (xr.open_zarr(root / scan["cubes"][0], consolidated=False) for root in (archive, tmp_path))
    np.testing.assert_array_equal(*(cube["dn"].values for cube in cubes))


def test_bad_flag_refused(command_line: Any, scene_files: Path, tmp_path: Path) -> None:
    """There is one message, the exit code is 2, and no archive is made."""
    ended = command_line("simulate", scene_files / "scene.png", "-o", tmp_path / "none", "--size", "64x64")
    ended.refused(2, "size is for built-in scenes")
    assert not (tmp_path / "none").exists()


def test_unusual_files_are_scanned_or_refused(command_line: Any, tmp_path: Path) -> None:
    """One band and 10 s of exposure are scanned; pixels without a value are refused.

    The scan's own sweeps decide on effects: lines of a first pass are stationary, so smear is absent.
    """
    np.save(tmp_path / "one.npy", np.random.default_rng(0).uniform(0.1, 1, (20, 30, 1)).astype(np.float32))
    out = tmp_path / "scan"
    ended = command_line(
        "simulate", tmp_path / "one.npy", "-o", out, *narrow(tmp_path), "--coarse", "--wavelengths", "650", "--json"
    )
    rows = {row["name"]: row for row in json.loads(ended.out)["effects"]}
    assert (rows["smile"]["reason"], rows["smear"]["reason"]) == ("absent", "absent")
    rows = np.zeros((64, 80, 3), np.float32)
    rows[1::2] = 1
    np.save(tmp_path / "rows.npy", rows)
    flags = ["--wavelengths", "640,550,460", "--camera.exposure-ms", "10000", "-o", str(tmp_path / "scan"), "--json"]
    record = json.loads(command_line("simulate", str(tmp_path / "rows.npy"), *narrow(tmp_path), *flags).out)
    assert record["lines"] == 67
    assert {row["name"]: row["reason"] for row in record["effects"]}["smear"] == "absent"
    assert record["effects_total"]["within"]
    values = np.ones((20, 30, 4), np.float32)
    values[3, 4, 2] = np.nan
    values[7, 8, 2] = np.inf
    np.save(tmp_path / "gaps.npy", values)
    given = ["simulate", tmp_path / "gaps.npy", "-o", tmp_path / "none", "--bands", "1,2", "--wavelengths", "550,650"]
    command_line(*given).refused(1, "has 2 pixels without a finite value")
    assert not (tmp_path / "none").exists()


WITHOUT = """
import sys
from spectralzoom.flows.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit as ended:
    assert ended.code == 0
assert "numba" in sys.modules
assert "torch" not in sys.modules
"""


def test_simulate_does_not_import_torch(tmp_path: Path) -> None:
    """Its import takes seconds, and no effect needs it."""
    np.save(tmp_path / "some.npy", np.random.default_rng(0).uniform(0.1, 1, (20, 30, 3)).astype(np.float32))
    flags = ["-o", str(tmp_path / "scan"), "--coarse", "--effects", "all", "--wavelengths", "460,550,650"]
    ended = python(WITHOUT, "simulate", tmp_path / "some.npy", *narrow(tmp_path), *flags)
    assert ended.returncode == 0, ended.stderr


ROW = {"name": "smile", "state": "on", "variant": "cubic", "bound": 0.0, "cost_ns": 0.9}
ROW |= {"reason": "needed", "left_out": 1.4, "magnitude": "smile: 0.3 nm", "unit": "sigma"}
TOTAL = {"asked": "auto", "tolerance": 0.1, "unit": "sigma", "bound": 0.0, "within": True}
TOTAL |= {"on": 1, "off": 1, "saved_s": 1.0}


@pytest.mark.parametrize("width", [72, 100])
def test_the_table_fits_the_terminal(width: int) -> None:
    """Figures are not wrapped; absent effects have no row."""
    said = io.StringIO()
    absent = ROW | {"name": "wind", "state": "off", "reason": "absent", "magnitude": "the air is calm"}
    long = ROW | {"name": "thermal-drift", "variant": "positions", "magnitude": "a way of words " * 12}
    print_effects([ROW, long, absent], TOTAL, Console(file=said, width=width))
    lines = said.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    (row,) = [line for line in lines if line.split()[:2] == ["smile", "cubic"]]
    assert row.split()[2:] == ["needed", "0.3", "nm", "0"]
    assert "wind" not in said.getvalue()

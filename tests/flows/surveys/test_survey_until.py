"""A survey stops when the stage of `until` is stored, and the same survey without it goes on with these stores."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.errors import SurveyStopped
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.readers.scene_files import open_scene_file
from spectralzoom.storage.store import Archive
from tests.conftest import QUIET, patchy_scene
from tests.flows.conftest import CommandLine
from tests.users.test_recorded_sweeps import write_pushbroom

pytestmark = pytest.mark.usefixtures("no_effects")
UNIFORM = {"scan_step": "2", "scan_exposure_ms": "10"}
TWICE = {"budget": "0.8"}


def small(out: Path, **given: Any) -> Settings:
    """Return settings of a tiny survey of the farm."""
    usual = {"size": "128x128", "bands": "40,90,150,200", "engine": "plain", "controls": False, "out": str(out)}
    return load_settings(None, usual | given)


def stages(archive: Path) -> set[str]:
    """Return the stages of which the archive has a store."""
    return {folder.name for folder in (archive / "stages").iterdir()}


def test_another_machine_goes_on_over_a_bucket(command_line: CommandLine, tmp_path: Path, bucket: str) -> None:
    """The machine of the rig pushes the lines it has captured; the other one pulls and maps them, and captures none."""
    asked = small(tmp_path / "rig", **UNIFORM)
    with pytest.raises(SurveyStopped, match="stopped after capture"):
        run_survey(asked.but(until="capture"), QUIET)
    assert command_line("push", tmp_path / "rig", bucket).code == 0
    assert command_line("pull", bucket, tmp_path / "office").code == 0
    published = run_survey(asked.but(out=str(tmp_path / "office"), keep="raw"), QUIET)
    states = {stage["name"]: stage["state"] for stage in published.receipt["stages"]}
    assert (states["capture_coarse"], states["segment"]) == ("cached", "ran")


@pytest.mark.parametrize(("scan", "engine"), [(UNIFORM, "plain"), (TWICE, "prefect")], ids=["uniform", "twice"])
def test_a_stopped_survey_goes_on(tmp_path: Path, scan: dict[str, str], engine: str) -> None:
    """Lines are captured once, and the map equals that of a survey in one go; no network reads a uniform mosaic."""
    asked = small(tmp_path / "a", **scan, engine=engine)
    with pytest.raises(SurveyStopped, match=r"stopped after capture: stored in .*; the same command without --until"):
        run_survey(asked.but(until="capture"), QUIET)
    shutil.copytree(tmp_path / "a" / "stages", tmp_path / "copy" / "stages")  # as on another machine
    asked = asked.but(out=str(tmp_path / "copy"))
    archive = Archive.open(tmp_path / "copy")
    before = {ref.uri: ref.path.stat().st_mtime_ns for ref in archive.refs("capture")}
    assert len(before) == (1 if scan is UNIFORM else 2)
    assert "segment" not in stages(tmp_path / "copy")
    with pytest.raises(SurveyStopped, match="stopped after mosaic"):
        run_survey(asked.but(until="mosaic", keep="raw"), QUIET)
    assert (stages(tmp_path / "copy") & {"score", "segment"}) == (set() if scan is UNIFORM else {"score"})
    published = run_survey(asked.but(keep="raw"), QUIET)
    assert {ref.uri: ref.path.stat().st_mtime_ns for ref in archive.refs("capture")} == before
    whole = run_survey(asked.but(out=str(tmp_path / "b")), QUIET)
    assert published.receipt["products"]["class_map"] == whole.receipt["products"]["class_map"]


@pytest.mark.parametrize("source", ["recorded", "raster"])
def test_a_mosaic_for_labelling_needs_no_weights(command_line: CommandLine, tmp_path: Path, source: str) -> None:
    """The message has the command that exports all bands and a picture, with the pixels of the mosaic."""
    values = (patchy_scene((96, 64), 3, 3)[0] * 12 + 60).astype(np.uint16)
    field = write_pushbroom(tmp_path / "drone", values) / "scan.hdr"
    asked = ("--sweeps", str(field)) if source == "recorded" else ("--scene", str(field))
    ended = command_line("survey", *asked, "--engine", "plain", "--until", "mosaic", "--out", tmp_path / "a")
    assert ended.code == 0, ended.err
    advice = ended.err.replace("\n", " ").rpartition("To label it: spectralzoom ")[2].split()
    assert "farm.safetensors" not in ended.err
    exported = command_line(*advice[:-1], tmp_path / "out")
    assert exported.code == 0, exported.err
    bands, picture = map(rasterio.open, map(str, sorted((tmp_path / "out").rglob("*.tif"))))
    assert (bands.count, picture.count, bands.shape, picture.shape) == (3, 3, (96, 64), (96, 64))
    assert [bands.tags(band)["wavelength"] for band in (1, 2, 3)] == ["460", "550", "640"]
    (store,) = (tmp_path / "a" / "stages").glob("*/*/mosaic.zarr")
    np.testing.assert_array_equal(bands.read(1), open_mosaic(store).values(slice(None), slice(None), [2])[..., 0])
    assert open_scene_file(bands.name).shape == (96, 64)


def test_a_map_of_own_sweeps_needs_weights(command_line: CommandLine, tmp_path: Path) -> None:
    """The message says how to train some, and that a mosaic needs none; its advice is enough."""
    field = write_pushbroom(tmp_path / "drone", np.full((8, 8, 3), 900, np.uint16)) / "scan.hdr"
    ended = command_line("survey", "--sweeps", str(field), "--engine", "plain", "--out", tmp_path / "a")
    ended.refused(2, "--weights is missing.*A mosaic needs none: --until mosaic$")
    rig = load_settings(None, {"source": "rig", "scene": "field", "until": "mosaic"})
    assert [rig.ends_unread, rig.but(scan_step=1).ends_unread] == [False, True]


def test_the_command_says_what_is_stored(command_line: CommandLine, tmp_path: Path) -> None:
    """The exit code is 0, and no run is published."""
    flags = ("--size", "128x128", "--bands", "40,90", "--seconds", "2", "--engine", "plain", "--until", "capture")
    ended = command_line("survey", *flags, "--out", tmp_path / "a")
    assert ended.code == 0
    assert "stopped after capture" in ended.err
    assert not list((tmp_path / "a").glob("runs/*"))

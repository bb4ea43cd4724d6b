"""Somebody surveys sweeps that were taken before: the same map as the rig's own, fewer lines, and what goes wrong."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

import storage.readers.recordings
from flows.publish.run_folder import Published
from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from pipeline.errors import NotRecordedError
from pipeline.simulator.scenes.scene import RasterScene, raster_from_values
from storage.archive.archive import Archive
from storage.archive.keys import array_digest
from storage.arrays.class_maps import load_class_map
from storage.arrays.cubes import open_raw_cube
from storage.export.recorded_files import write_recorded_files
from storage.remote.opening import verify_archive
from tests.conftest import patchy_scene
from tests.flows.conftest import CommandLine
from tests.flows.tasks.test_survey_rig import emulated

pytestmark = pytest.mark.usefixtures("no_effects")
QUIET = Console(quiet=True)
SIZE = (128, 96)  # x, y
NARROW = {"camera.samples": 80}  # two strips for the field
PASSES: dict[str, dict[str, Any]] = {
    "two passes": {"budget": 0.8, "policy": "entropy"},
    "every line": {"scan_step": 1},
    "every second line, shorter": {"scan_step": 2, "scan_exposure_ms": 25},
}


def field() -> RasterScene:
    """A field of three classes before the emulated rig."""
    camera = load_settings(None, dict(NARROW)).camera
    values = patchy_scene(SIZE[::-1], 3, 1)[0]
    return raster_from_values(values, camera, name="x", wavelength_nm=np.array([640.0, 550.0, 460.0]))


def rig_settings(out: Path, weights: Path, **asked: Any) -> Any:
    """Settings of a survey of the field through the rig."""
    told = {
        **{"source": "rig", "scene": "field", "size": f"{SIZE[0]}x{SIZE[1]}", "wavelengths": "640,550,460"},
        **{"rig.port": f"rig-{os.getpid()}", "rig.pulses": "position", "visit": "first", "engine": "plain"},
        **{"weights": str(weights), "out": str(out), **NARROW, **asked},
    }
    return load_settings(None, told)


def survey_sweeps(out: Path, sweeps: Path | str, **asked: Any) -> Published:
    """Survey recorded sweeps, as the command does."""
    return run_survey(load_settings(None, {"sweeps": str(sweeps), "engine": "plain", "out": str(out), **asked}), QUIET)


def digest_of_map(out: Path, published: Published) -> tuple[str, str]:
    """Hashes of class numbers and confidences."""
    found = load_class_map(out / published.receipt["products"]["class_map"])
    return array_digest(np.asarray(found.classes)), array_digest(np.asarray(found.confidence))


def write_sweeps(out: Path, published: Published, folder: Path) -> Path:
    """Write the raw cubes of a survey as ENVI files with a pointing table each."""
    products = published.receipt["products"]
    for product in ("raw_coarse", "raw_fine"):
        for path in sorted((out / products[product]).glob("*.zarr")) if product in products else ():
            write_recorded_files(open_raw_cube(path), folder)
    return folder


@pytest.mark.parametrize("asked", PASSES.values(), ids=PASSES)
def test_sweeps_of_the_rig_give_its_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path, asked: dict[str, Any]
) -> None:
    """Written as ENVI and CSV and surveyed as a recording, or out of the archive itself: the class map by hash."""
    settings = rig_settings(tmp_path / "rig", weights, **asked)
    with emulated(settings, {}, monkeypatch, scene=field()):
        published = run_survey(settings, QUIET)
    expected = digest_of_map(tmp_path / "rig", published)
    assert len(np.unique(load_class_map(tmp_path / "rig" / published.receipt["products"]["class_map"]).classes)) > 1
    folder = write_sweeps(tmp_path / "rig", published, tmp_path / "sweeps")
    plan = asked if "budget" in asked else {}
    size = f"{SIZE[0]}x{SIZE[1]}"
    of_files = survey_sweeps(tmp_path / "files", folder, weights=str(weights), size=size, **plan)
    assert digest_of_map(tmp_path / "files", of_files) == expected
    of_run = survey_sweeps(tmp_path / "again", published.folder)
    assert digest_of_map(tmp_path / "again", of_run) == expected
    for one in (of_files, of_run):
        told = one.receipt["recording"]
        assert (one.receipt["source"], told["lines_read"]) == ("recorded", told["lines_recorded"])
        assert "lines" not in one.receipt
    assert {finding.kind for finding in verify_archive(Archive.open(tmp_path / "files"))} == {"whole"}

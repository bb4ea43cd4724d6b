"""A survey through an emulated rig: it gives the class map of the simulated source, and bad input gets one message."""

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
import zarr

import flows.tasks.prefect_tasks
import flows.tasks.rig_field
import flows.terminal.progress
from flows.publish.run_folder import Published
from flows.settings.load import load_settings
from flows.settings.survey_settings import Settings
from flows.survey_command import run_survey
from flows.tasks.run import make_source, open_run
from flows.tasks.scene import open_scene
from flows.tasks.stages.effects import chosen_effects
from pipeline.errors import PoseError, RigError, SettingsError
from pipeline.rig.device_settings import SurveyRig
from pipeline.rig.emulator.emulated_rig import EmulatedRig, FastClock
from pipeline.rig.emulator.mirror_device import Mode
from pipeline.rig.transports import DeviceGone
from pipeline.simulator.scenes.scene import RasterScene, raster_from_values
from storage.archive.archive import Archive
from storage.arrays.class_maps import load_class_map
from storage.arrays.cubes import open_raw_cube
from storage.remote.opening import verify_archive
from tests.conftest import QUIET, patchy_scene
from tests.pipeline.rig.camera_faults import CameraFault, FaultyRig
from tests.pipeline.rig.in_process import InProcessRig, ManualClock
from tests.pipeline.simulator.small_scenes import effects_on
from tests.prior_work import without_effects

SMALL: dict[str, Any] = {
    "size": "128x128",
    "bands": "40,90,150,200",
    "engine": "plain",
    "budget": 0.8,
    "rig.white_reference": 0.99,  # of the farm's white reference
    "rig.pulses": "position",
    "effects": "rotation,slit,smear,vignetting,shot,read-noise",
}


def small_settings(out: Path, **changed: Any) -> Settings:
    """Return settings of a tiny survey; the port names this process, as two tests may use rigs at the same time."""
    return load_settings(None, {**SMALL, "rig.port": f"rig-{os.getpid()}", "out": str(out), **changed})


@contextmanager
def emulated(
    settings: Settings, effects: Any, patch: pytest.MonkeyPatch, *, scene: RasterScene | None = None
) -> Iterator[FaultyRig]:
    """Yield an emulated rig, with effects, as the devices of surveys; its scene is that of the settings by default."""
    seen = open_scene(settings)[0] if scene is None else scene
    source = replace(make_source(seen, settings), chosen=effects)
    whole = FaultyRig(source, ManualClock(10.0), wired=settings.rig.pulses)
    with InProcessRig(whole) as line:
        patch.setattr(flows.tasks.rig_field, "open_devices", line.devices_of)
        yield whole


def coarse_captures(rig: EmulatedRig) -> int:
    """Return the number of capture commands for coarse lines that the camera received."""
    return sum(said.startswith("capture(") and "coarse" in said for said in rig.camera.commands)


def class_map_of(published: Published, out: Path) -> np.ndarray[Any, Any]:
    """Return the classes of the survey's map, (y, x)."""
    return np.asarray(load_class_map(out / published.receipt["products"]["class_map"]).classes)


def arrays_of(archive: Path, published: Published, product: str) -> dict[str, bytes]:
    """Return the bytes of a store's arrays by name, read with zarr alone."""
    group = zarr.open_group(archive / published.receipt["products"][product], mode="r")
    return {name: np.asarray(array[...]).tobytes() for name, array in group.arrays()}


def rows_of(archive: Path, published: Published) -> dict[str, Any]:
    """Return the values of all lines of a survey, by stage and sweep."""
    found = {}
    for name, folder in published.receipt["products"].items():
        for path in sorted((archive / folder).glob("*.zarr")) if name.startswith("raw_") else ():
            cube = open_raw_cube(path)
            assert cube.valid_line.all()
            found[f"{name} {path.stem}"] = cube.read(0, cube.sweep.lines)
    assert found
    return found


def test_the_rig_gives_the_lines_of_the_simulation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A survey by Prefect has equal raw lines in coarse and fine sweeps, equal mosaic and equal class map."""
    with without_effects():  # except those that it names
        simulated = run_survey(small_settings(tmp_path / "sim", visit="first", keep="raw"), QUIET)
    effects = chosen_effects(next(ref for ref in Archive.open(tmp_path / "sim").refs("effects")))
    settings = small_settings(tmp_path / "rig", source="rig", visit="first", engine="prefect", keep="raw")
    with emulated(settings, effects, monkeypatch):
        published = run_survey(settings, QUIET)
    expected, found = rows_of(tmp_path / "sim", simulated), rows_of(tmp_path / "rig", published)
    assert list(found) == list(expected)
    assert len({name.split()[0] for name in found}) == 2
    for name, rows in expected.items():
        np.testing.assert_array_equal(found[name], rows, err_msg=name)
    for product in ("mosaic", "class_map"):
        rig, sim = (
            arrays_of(tmp_path / folder, one, product) for folder, one in (("rig", published), ("sim", simulated))
        )
        assert rig == sim, product


def test_a_mounting_that_cannot_reach_the_field_is_refused(tmp_path: Path) -> None:
    """The mirror's range ends before the field does; the error comes before anything moves."""
    beside = {"rig.mirror_offset_x": 0.5, "rig.mirror_offset_y": 0.5, "size": "6400x6400"}
    with pytest.raises(PoseError, match=r"as mounted \(offset 0.5; 0.5\), .* outside the unit disk"):
        open_run(small_settings(tmp_path, source="rig", **beside), planning=True)


@pytest.mark.usefixtures("no_effects")
def test_a_rig_with_default_settings_is_surveyed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Without pulses and CRC the mirror's log gives line positions; over 90 % of the map equals the simulation."""
    usual = SurveyRig()
    told = {"rig.pulses": usual.pulses, "rig.with_crc": usual.with_crc, "effects": "none", "keep": "raw"}
    settings = small_settings(tmp_path, source="rig", visit="first", **told)
    simulated = run_survey(small_settings(tmp_path / "sim", effects="none"), QUIET)
    with emulated(settings, {}, monkeypatch) as rig:
        published = run_survey(settings, QUIET)
        assert (rig.camera.wired, rig.mirror.mode) == ("none", Mode.PRO)
    for name in ("raw_coarse", "raw_fine"):
        record = json.loads((tmp_path / published.receipt["products"][name] / "rig.json").read_text())
        assert {one["method"] for one in record["captures"]} == {"log"}
    alike = class_map_of(published, tmp_path) == class_map_of(simulated, tmp_path / "sim")
    assert alike.mean() > 0.9, alike.mean()


def test_a_broken_visit_resumes_and_a_new_one_is_captured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """After the camera failed, the same command resumes the survey; another visit is captured again.

    The receipt has no simulated effects and no password; the camera's files go with the spool.
    """
    settings = small_settings(tmp_path, source="rig", visit="first", **{"rig.password": "secret", "budget": 0.5})
    with emulated(settings, {}, monkeypatch) as rig:
        rig.camera.faults.left.update({CameraFault.REFUSES_FILES: 3})
        rig.camera.faults.passes = 6  # files: four of the references, two of the coarse sweep
        with pytest.raises(DeviceGone, match="camera's file server"):
            run_survey(settings, QUIET)
        published = run_survey(settings, QUIET)
        assert coarse_captures(rig) == 1
        assert "effects" not in published.receipt
        assert published.receipt["source"] == "rig"
        assert published.receipt["settings"]["visit"] == "first"
        assert "secret" not in (published.folder / "receipt.json").read_text()
        assert not list((tmp_path / "spool").iterdir())
        with flows.tasks.rig_field.rig_to_oneself(settings.rig.port):  # by another survey: stored lines need no rig
            assert run_survey(settings, QUIET).receipt["products"]["mosaic"] == published.receipt["products"]["mosaic"]
            with pytest.raises(RigError, match="in use by another survey"):
                run_survey(replace(settings, visit="second"), QUIET)
        run_survey(replace(settings, visit="second"), QUIET)
        assert coarse_captures(rig) == 2
        run_survey(replace(settings, name="west"), QUIET)  # another field of the same settings
        assert coarse_captures(rig) == 3
        run_survey(replace(settings, rig=replace(settings.rig, mirror_axes="-x,-y")), QUIET)  # another mounting
        assert coarse_captures(rig) == 4
        white = replace(settings, rig=replace(settings.rig, white_reference=0.5))  # another calibration
        assert run_survey(white, QUIET).receipt["products"]["mosaic"] != published.receipt["products"]["mosaic"]
    assert {finding.kind for finding in verify_archive(Archive.open(tmp_path))} == {"whole"}


def test_field_without_a_picture_is_surveyed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path):
    """Only size and bands of the field are known: the rig's lines are mapped, and no accuracy is computed."""
    told = {"scene": "field", "bands": None, "wavelengths": "640,550,460", "weights": str(weights), "effects": None}
    settings = small_settings(tmp_path, source="rig", **told)
    values = patchy_scene((128, 128), 3, 1)[0]
    scene = raster_from_values(values, settings.camera, name="x", wavelength_nm=np.array([640.0, 550.0, 460.0]))
    with emulated(settings, {}, monkeypatch, scene=scene):
        published = run_survey(settings, QUIET)
    assert len(np.unique(class_map_of(published, tmp_path))) > 1
    assert published.receipt["scene"].startswith("field/")
    assert published.receipt["settings"]["visit"]  # the date, so that a later survey is another visit


def test_survey_over_a_pty_and_sockets_gives_the_same_lines(tmp_path: Path):
    """Devices behind a real pty, a control socket and FTP with a fast clock give the simulated lines."""
    asked = {"source": "rig", "visit": "first", "budget": 0.5, "keep": "raw"}
    settings = small_settings(tmp_path, **asked)
    scene, _ = open_scene(settings)
    source = replace(make_source(scene, settings), chosen=effects_on("rotation", "slit", "smear", "shot"))
    with EmulatedRig(source, FastClock(40)).serve() as served:
        told = {"rig.port": served.port, "rig.host": served.host, "rig.control_port": served.camera_port}
        told["rig.file_port"] = served.file_port
        published = run_survey(small_settings(tmp_path, **asked, **told), QUIET)
    cube = open_raw_cube(tmp_path / published.receipt["products"]["raw_coarse"] / "coarse-0.zarr")
    np.testing.assert_array_equal(cube.read(0, cube.sweep.lines), source.render(cube.sweep, range(cube.sweep.lines)))
    assert cube.valid_line.all()
    told = json.loads((tmp_path / published.receipt["products"]["raw_coarse"] / "rig.json").read_text())
    assert [one["method"] for one in told["captures"]] == ["trigger"]
    assert told["rig"]["provenance"] == "assumed"


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "unknown key": ({"rig.prot": "/dev/ttyUSB0"}, r"unknown setting .*prot.*did you mean 'rig.port'"),
    "axes": ({"rig.mirror_axes": "x,x"}, r"'rig.mirror_axes' must be one of x,y  x,-y .* -y,-x; got 'x,x'"),
    "memory": ({"source": "rig", "cost.vector_pairs": 9000}, r"cost.vector_pairs = 9000: .* at most 8191 pairs"),
    "size": ({"source": "rig", "scene": "field", "bands": None, "size": None, "weights": "x"}, r"give its size"),
    "no rig": ({"scene": "field", "source": "sim", "bands": None}, r"scene 'field' is what stands before a rig"),
}


@pytest.mark.parametrize(("changed", "message"), BAD.values(), ids=BAD)
def test_bad_setting_is_refused_in_one_message(tmp_path: Path, changed: dict[str, Any], message: str, weights: Path):
    """The message comes before a device is opened and says what is allowed; no archive is made."""
    told = {**changed, **({"weights": str(weights)} if "weights" in changed else {})}
    with pytest.raises(SettingsError, match=message):
        run_survey(small_settings(tmp_path / "out", **told), QUIET)
    assert not (tmp_path / "out").exists()

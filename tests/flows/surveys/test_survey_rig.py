"""A survey through a fake rig: it gives the class map of the simulated source, and bad input gets one message."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import zarr

from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.opening.rig_field import rig_to_oneself
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.errors import PoseError, RigError, SettingsError
from spectralzoom.pipeline.rig.fakes import FakeCamera
from spectralzoom.pipeline.rig.transports import DeviceGone
from spectralzoom.storage.arrays.class_maps import load_class_map
from spectralzoom.storage.arrays.cubes import open_raw_cube
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive, stage_key
from tests.conftest import QUIET

FAKE = {"rig.mirror_driver": "fake", "rig.camera_driver": "fake"}
SMALL: dict[str, Any] = {
    "size": "128x128",
    "bands": "40,90,150,200",
    "engine": "plain",
    "budget": 0.8,
    "visit": "first",
    "effects": "none",
}
SOME = "rotation,slit,smear,vignetting,shot,read-noise,drift,jitter"


def small_settings(out: Path, **changed: Any) -> Settings:
    """Return settings of a tiny survey of the farm."""
    return load_settings(None, {**SMALL, "out": str(out), **changed})


def fake_settings(out: Path, **changed: Any) -> Settings:
    """Return settings of a tiny survey through a fake rig."""
    return small_settings(out, source="rig", **{**FAKE, **changed})


def arrays_of(archive: Path, published: Published, product: str) -> dict[str, bytes]:
    """Return the bytes of a store's arrays by name, read with zarr alone."""
    group = zarr.open_group(archive / published.receipt["products"][product], mode="r")
    return {name: np.asarray(array[...]).tobytes() for name, array in group.arrays()}


def rows_of(archive: Path, published: Published) -> dict[str, Any]:
    """Return the values and positions of all lines of a survey, by stage and sweep."""
    found = {}
    for name, folder in published.receipt["products"].items():
        for path in sorted((archive / folder).glob("*.zarr")) if name.startswith("raw_") else ():
            cube = open_raw_cube(path)
            assert cube.valid_line.all()
            found[f"{name} {path.stem}"] = cube.read(0, cube.sweep.lines), cube.position
    assert found
    return found


@pytest.mark.parametrize(("seed", "engine"), [(0, "prefect"), (1, "plain"), (2, "plain")])
def test_the_rig_gives_the_lines_of_the_simulation(tmp_path: Path, seed: int, engine: str) -> None:
    """Raw lines of coarse and fine sweeps, mosaic and class map are equal, bit for bit."""
    told = {"effects": SOME, "keep": "raw", "seed": seed}
    simulated = run_survey(small_settings(tmp_path / "sim", **told), QUIET)
    published = run_survey(fake_settings(tmp_path / "rig", **told | {"engine": engine}), QUIET)
    expected, found = rows_of(tmp_path / "sim", simulated), rows_of(tmp_path / "rig", published)
    assert list(found) == list(expected)
    assert len({name.split()[0] for name in found}) == 2
    for name, (rows, positions) in expected.items():
        np.testing.assert_array_equal(found[name][0], rows, err_msg=name)
        np.testing.assert_array_equal(found[name][1], positions, err_msg=name)
    for product in ("mosaic", "class_map"):
        assert arrays_of(tmp_path / "rig", published, product) == arrays_of(tmp_path / "sim", simulated, product)
    record = json.loads((tmp_path / "rig" / published.receipt["products"]["raw_fine"] / "rig.json").read_text())
    assert {one["residual_px"] for one in record["captures"]} == {0.0}
    assert record["rig"]["provenance"] == "assumed"
    assert published.receipt["source"] == "rig"


def test_a_mounting_that_cannot_reach_the_field_is_refused(tmp_path: Path) -> None:
    """The mirror's range ends before the field does; the error comes before anything moves."""
    beside = {"rig.mirror_offset_x": 0.5, "rig.mirror_offset_y": 0.5, "size": "6400x6400"}
    with pytest.raises(PoseError, match=r"as mounted \(offset 0.5; 0.5\), .* outside the unit disk"):
        plan_survey(open_field(fake_settings(tmp_path, **beside), planning=True))


def test_a_broken_visit_resumes_and_a_new_one_is_captured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the camera failed, the same command resumes the survey; another visit is captured again.

    The receipt has no password; the camera's files go with the spool.
    """
    settings = fake_settings(tmp_path, **{"rig.password": "secret", "budget": 0.5})
    captures = Mock(wraps=FakeCamera.capture)
    monkeypatch.setattr(FakeCamera, "capture", lambda *given, **named: captures(*given, **named))

    def coarse() -> int:
        return sum("coarse" in one.kwargs.get("prefix", "") for one in captures.call_args_list)

    with monkeypatch.context() as patch:
        patch.setattr(FakeCamera, "fetch", Mock(side_effect=DeviceGone("the camera's file server is not there")))
        with pytest.raises(DeviceGone, match="camera's file server"):
            run_survey(settings, QUIET)
    published = run_survey(settings, QUIET)
    assert coarse() == 1
    assert published.receipt["settings"]["visit"] == "first"
    assert "secret" not in (published.folder / "receipt.json").read_text()
    assert not list((tmp_path / "spool").iterdir())
    others = {"visit": "second"}, {"name": "west"}, {"rig": replace(settings.rig, mirror_axes="-x,-y")}
    for count, other in enumerate(others, 2):  # another visit, another field of the same settings, another mounting
        run_survey(settings.but(**other), QUIET)
        assert coarse() == count
    assert {finding.kind for finding in verify_everything(Archive.open(tmp_path))} == {"whole"}


def test_a_rig_on_hardware_is_for_one_survey(tmp_path: Path) -> None:
    """Stored lines need no rig, and a fake mirror no lock. A real mirror is used by one survey at a time."""
    settings = fake_settings(tmp_path, **{"rig.port": f"/dev/tty{tmp_path.name}"})
    with rig_to_oneself(settings.rig.port):  # by another survey
        run_survey(settings, QUIET)
        real = settings.but(visit="second", rig=replace(settings.rig, mirror_driver=""))
        with pytest.raises(RigError, match="in use by another survey"):
            run_survey(real, QUIET)
        assert run_survey(real.but(visit="first"), QUIET).receipt["products"]["mosaic"]


def test_field_without_a_picture_is_surveyed(tmp_path: Path, weights: Path) -> None:
    """Only size and bands of the field are known: the rig's lines are mapped, and no accuracy is computed."""
    told = {"scene": "field", "bands": None, "wavelengths": "640,550,460", "weights": str(weights), "visit": None}
    published = run_survey(fake_settings(tmp_path, **told), QUIET)
    drawn = np.asarray(load_class_map(tmp_path / published.receipt["products"]["class_map"]).classes)
    assert drawn.shape == (128, 128)
    assert "accuracy" not in published.receipt
    assert published.receipt["scene"].startswith("field/")
    assert published.receipt["settings"]["visit"]  # the date, so that a later survey is another visit


@pytest.mark.parametrize(("camera_driver", "keys"), [("", 1), ("fake", 2)])
def test_lines_of_a_real_rig_do_not_depend_on_the_seed(
    tmp_path: Path, weights: Path, camera_driver: str, keys: int
) -> None:
    """Another seed finds the captures of a real camera again; a fake camera sees other noise."""
    told = {"scene": "field", "bands": None, "wavelengths": "640,550,460", "weights": str(weights)}
    asked = [fake_settings(tmp_path, **told, **{"rig.camera_driver": camera_driver, "seed": one}) for one in (1, 2)]
    views = [open_field(settings, planning=True).view for settings in asked]
    assert len({stage_key("capture", 1, {"view": view}) for view in views}) == keys


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "axes": ({"rig.mirror_axes": "x,x"}, r"--rig.mirror-axes must be one of x,y  x,-y .* -y,-x; got 'x,x'"),
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

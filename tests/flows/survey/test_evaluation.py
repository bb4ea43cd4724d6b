"""Labels, controls and gains under a mirror that looks beside the plan: each put right the right way round."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flows.survey.stages import accuracy as evaluation
from flows.survey.stages import registration as placement
from flows.survey.stages import registration as pointing_stage
from models.evaluation.metrics import confusion
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import UNLABELLED
from pipeline.rectify.registration.illumination import LightRatio
from pipeline.simulator.effects.pointing import CommonOffset, PointingErrors
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import raster_from_values
from pipeline.simulator.simulated import SimulatedSource
from storage.archive.archive import Archive
from storage.archive.keys import StageRef

OFF = np.array([2.2, -1.4])  # along the line and the scan [px]


@pytest.mark.parametrize(("along", "down", "right"), [("x", -1, 2), ("y", 2, -1)])
def test_labels_move_to_where_the_map_shows_them(along: str, down: int, right: int) -> None:
    """The map's pixel p shows what lies at p + offset, to the nearest pixel; beyond the labels nothing is known."""
    labels = np.arange(30, dtype=np.uint8).reshape(5, 6)
    run: Any = SimpleNamespace(labels=labels, plan=SimpleNamespace(along=along))
    moved = evaluation._moved(run, OFF)
    for row, column in np.ndindex(5, 6):
        at = row + down, column + right
        known = 0 <= at[0] < 5 and 0 <= at[1] < 6
        assert moved[row, column] == (labels[at] if known else UNLABELLED)


def test_a_false_class_is_listed_with_its_pixels() -> None:
    """What a map shows and the labels lack has pixels and no IoU, and does not count in the mean."""
    run: Any = SimpleNamespace(weights=SimpleNamespace(class_names=("soil", "crop", "tree")))
    labels, drawn = np.array([0, 0, 0, 1, UNLABELLED], np.uint8), np.array([0, 0, 2, 1, 2], np.uint8)
    found = evaluation._figures(run, confusion(labels, drawn, 3))
    assert found["false_classes"] == {"tree": 1}
    assert found["per_class_iou"] == pytest.approx({"soil": 2 / 3, "crop": 1.0, "tree": np.nan}, nan_ok=True)
    assert found["miou"] == pytest.approx(5 / 6)
    assert found["miou_of_shown_classes"] == pytest.approx(5 / 9)


def _registration(archive: Path, record: dict[str, Any]) -> StageRef:
    """A published registration."""

    def build(path: Path) -> None:
        (path / "registration.json").write_text(json.dumps(record))

    return Archive.open(archive).produce("register", build, version=1, params={})[0]


def test_controls_look_where_the_map_does(tmp_path: Path) -> None:
    """The offset is that of the sweep which registration held, and controls scan with the same one everywhere."""
    scene = raster_from_values(np.ones((8, 8, 1)), LineCamera(), name="t", wavelength_nm=np.array([500.0]))
    errors = PointingErrors(9.0, 0.0, 4)
    run: Any = SimpleNamespace(simulated=SimulatedSource(scene, Rig(), pointing=errors))
    off = evaluation._map_offset(run, [_registration(tmp_path, {"reference": "coarse-3"})])
    np.testing.assert_array_equal(off, errors.offset("coarse-3"))
    assert evaluation._sure_source(run, off).pointing == CommonOffset((float(off[0]), float(off[1])))
    assert (evaluation._map_offset(run, []) == 0).all()


def test_brighter_sweep_is_turned_down(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two sweeps one of which was lit four times as much, either gain is what its values are multiplied by."""
    ratio = LightRatio(0, 1, np.log([4.0, 4.0]), np.zeros(2))
    monkeypatch.setattr(pointing_stage, "overlap_light", lambda *_: [ratio])
    placed: Any = [SimpleNamespace(lines=SimpleNamespace(sweep=SimpleNamespace(name=name))) for name in "ab"]
    run: Any = SimpleNamespace(camera=None, scene=SimpleNamespace(wavelength_nm=np.array([500.0, 600.0])))
    found: Any = SimpleNamespace(windows=[SimpleNamespace(window=None, measured=True)])
    gains = pointing_stage._gains(run, found, placed)
    np.testing.assert_allclose(gains["a"], 2.0, rtol=1e-6)
    np.testing.assert_allclose(gains["b"], 0.5, rtol=1e-6)


def test_corrections_are_read_as_they_were_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Offset, drift and gain of a sweep reach its placing unchanged; a sweep that is not named has none."""
    record = {"a": {"offset_px": [1.0, -2.0], "drift_px_per_line": [0.5, 0.0], "gain": [0.5, 2.0]}}
    ref = _registration(tmp_path, {"sweeps": record})
    cubes = [SimpleNamespace(sweep=SimpleNamespace(name=name), time_s=np.arange(3.0)) for name in "ab"]
    monkeypatch.setattr(placement, "captured", lambda _: cubes)
    run: Any = SimpleNamespace(camera=LineCamera())
    one, other = placement.sighted(run, ref, ref)
    np.testing.assert_array_equal(one.shift_px, [[0.5, -2.0], [1.0, -2.0], [1.5, -2.0]])
    np.testing.assert_array_equal(one.gain, [0.5, 2.0])
    assert (other.shift_px == 0).all()
    assert other.gain is None

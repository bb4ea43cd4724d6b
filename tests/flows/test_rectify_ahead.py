"""The coarse mosaic of a rig's survey, begun while its lines arrive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows import placement
from flows.publish import Published
from flows.run import open_run
from flows.survey import STAGES, StageRunner
from flows.survey_command import run_survey
from pipeline.errors import RigError
from pipeline.rig.capture.rig_source import RigSource
from pipeline.scan import Sweep
from pipeline.source import Line
from storage.archive import Archive, StageRef
from storage.garbage import plan_clearance
from storage.mosaic_ahead import MosaicAhead
from storage.mosaics import load_mosaic
from tests.flows.test_survey_rig import QUIET, emulated, small_settings

Tiles = list[Sequence[tuple[int, int]]]


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> Tiles:
    """Tiles that each mosaic took over."""
    found: Tiles = []
    real = placement.take_mosaic

    def watched(*given: Any) -> Sequence[tuple[int, int]]:
        found.append(real(*given))
        return found[-1]

    monkeypatch.setattr(placement, "take_mosaic", watched)
    return found


def needed(ref: StageRef | None) -> StageRef:
    """The store of a stage that has something to do."""
    assert ref is not None
    return ref


def mosaic_of(published: Published, out: Path) -> np.ndarray[Any, Any]:
    """The survey's coarse mosaic, (y, x, band)."""
    (stage,) = [stage for stage in published.receipt["stages"] if stage["name"] == "rectify"]
    values = load_mosaic(out / "stages" / "rectify" / stage["key"] / "mosaic.zarr").values
    return np.asarray(values)


def test_mosaic_is_the_one_made_afterwards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taken: Tiles) -> None:
    """Tiles made while a rig's lines arrived are those that are made when all have; nothing stays behind."""
    made = []
    for out in (tmp_path / "ahead", tmp_path / "after"):
        settings = small_settings(out, source="rig", visit="first", budget=0.5)
        with emulated(settings, {}, monkeypatch), monkeypatch.context() as patch:
            if out.name == "after":
                patch.setattr(placement, "take_mosaic", lambda *_: [])
            made.append(mosaic_of(run_survey(settings, QUIET), out))
        assert not list((out / "spool").iterdir())
    assert [len(tiles) for tiles in taken] == [1]
    np.testing.assert_array_equal(*made)


NOT_AHEAD: dict[str, dict[str, Any]] = {
    "no pulse steps the mirror": {"rig.pulses": "none"},
    "the mirror's log says where it was": {"rig.log_pulses": True},
    "seams are to be registered": {"pointing_px": 4.0, "size": "96x96"},
}


@pytest.mark.parametrize("changed", NOT_AHEAD.values(), ids=NOT_AHEAD)
def test_nothing_is_made_ahead_of_lines_that_may_lie_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: dict[str, Any]
) -> None:
    """Tiles that cannot be taken over are not worth their work."""
    settings = small_settings(tmp_path, source="rig", visit="first", budget=1.0, **changed)
    begun: list[str] = []
    monkeypatch.setattr(MosaicAhead, "arrived", lambda ahead, name, count: begun.append(name))
    with emulated(settings, {}, monkeypatch):
        step = StageRunner(open_run(settings))
        step("capture_coarse", needed(step("choose_effects")))
    assert begun == []


def test_a_capture_does_not_fail_for_want_of_room_for_what_is_ahead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taken: Tiles
) -> None:
    """Where it cannot be begun the mosaic is made in its turn."""

    def full(*_: object, **named: object) -> None:
        raise OSError("No space left on device")

    settings = small_settings(tmp_path, source="rig", visit="first", budget=0.5)
    with emulated(settings, {}, monkeypatch), monkeypatch.context() as patch:
        patch.setattr("flows.rectify_ahead.MosaicAhead", full)
        run_survey(settings, QUIET)
    assert [len(tiles) for tiles in taken] == [0]


def test_a_frame_that_the_camera_dropped_has_all_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taken: Tiles
) -> None:
    """Where a line is missing tiles made of its zeros are not taken over."""
    settings = small_settings(tmp_path, source="rig", visit="first", budget=0.5)
    real = RigSource.lines

    def dropped(source: RigSource, sweep: Sweep, first: int = 0) -> Iterator[Line]:
        for line in real(source, sweep, first):
            yield replace(line, valid=line.valid and line.number != 7)

    monkeypatch.setattr(RigSource, "lines", dropped)
    with emulated(settings, {}, monkeypatch):
        run_survey(settings, QUIET)
    assert [len(tiles) for tiles in taken] == [0]
    assert not list((tmp_path / "spool").iterdir())


def test_sweeps_are_blended_in_the_order_that_they_are_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taken: Tiles
) -> None:
    """A field that takes two coarse sweeps: its tiles are those made afterwards, where they overlap as well."""
    made = []
    for out in (tmp_path / "ahead", tmp_path / "after"):
        told = {"size": "128x192", "camera.samples": 96, "budget": 0.5}
        settings = small_settings(out, source="rig", visit="first", **told)
        with emulated(settings, {}, monkeypatch), monkeypatch.context() as patch:
            if out.name == "after":
                patch.setattr(placement, "take_mosaic", lambda *_: [])
            run = open_run(settings)
            assert len(run.plan.coarse) > 1
            made.append(mosaic_of(run_survey(settings, QUIET), out))
    assert [len(tiles) for tiles in taken] == [1]
    np.testing.assert_array_equal(*made)


def test_what_a_broken_survey_made_ahead_is_cleared_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taken: Tiles
) -> None:
    """A survey that ends between capture and mosaic leaves tiles ahead: the next one takes them, gc removes them."""

    def broken(*_: object) -> None:
        raise RigError("no more")

    real = STAGES["locate"]
    settings = small_settings(tmp_path, source="rig", visit="first", budget=0.5)
    with emulated(settings, {}, monkeypatch):
        monkeypatch.setitem(STAGES, "locate", broken)
        with pytest.raises(RigError, match="no more"):
            run_survey(settings, QUIET)
        monkeypatch.setitem(STAGES, "locate", real)
        archive = Archive.open(tmp_path)
        (left,) = [path.name for path in (tmp_path / "spool").iterdir()]
        assert f"spool/{left}" in {removal.uri for removal in plan_clearance(archive).removals}
        run_survey(settings, QUIET)
    assert [len(tiles) for tiles in taken] == [1]
    assert not list((tmp_path / "spool").iterdir())

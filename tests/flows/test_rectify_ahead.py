"""The coarse mosaic of a rig's survey, begun while its lines arrive."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows import placement
from flows.publish import Published
from flows.survey import STAGES
from flows.survey_command import run_survey
from pipeline.errors import RigError
from storage.archive import Archive
from storage.garbage import plan_clearance
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


def test_nothing_is_made_ahead_where_no_pulse_steps_the_mirror(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taken: Tiles
) -> None:
    """Lines tied by the mirror's log lie where that says, which nobody knows before."""
    settings = small_settings(tmp_path, source="rig", visit="first", **{"rig.pulses": "none", "budget": 0.5})
    with emulated(settings, {}, monkeypatch):
        run_survey(settings, QUIET)
    assert [len(tiles) for tiles in taken] == [0]


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

"""Stages as records: a module in the folder is a stage of the survey, in its place."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from flows.survey import stages
from flows.survey.stage import all_stages
from storage.archive.keys import StageRef

ADDED = """
from flows.survey.stage import Product, Wanted, stage

@stage("count_pixels", "pixels counted", Product("count", 1), of=("draw_map",), after=("ground",), unit="pixels")
def count_pixels(run, class_map):
    return Wanted(lambda path: None, {}, [class_map])
"""


def test_stages_run_once_what_they_are_made_of_has() -> None:
    """The order of a survey follows from the records; what judges comes last."""
    order = list(all_stages())
    for name, one in all_stages().items():
        assert all(order.index(before) < order.index(name) for before in (*one.of, *one.after))
    assert [name for name, one in all_stages().items() if one.judges] == order[-1:]


def test_a_module_is_all_that_a_stage_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is found and stands after what it names; nothing else had to know of it."""
    (tmp_path / "counting.py").write_text(ADDED)
    monkeypatch.setattr(stages, "__path__", [*stages.__path__, str(tmp_path)])
    found = all_stages.__wrapped__()
    monkeypatch.delitem(sys.modules, "flows.survey.stages.counting")
    assert set(found) - set(all_stages()) == {"count_pixels"}
    assert list(found).index("count_pixels") > list(found).index("ground")
    assert found["count_pixels"].addresses(StageRef("count", "abc", tmp_path)) == {"count_pixels": "stages/count/abc"}


def test_every_stage_says_once_what_receipts_call_its_store() -> None:
    """No two stages share a name in receipts, and each has one at least."""
    named = [one.addresses(StageRef(one.product.name, "abc", Path())) for one in all_stages().values()]
    assert all(named)
    assert len({name for one in named for name in one}) == sum(map(len, named))

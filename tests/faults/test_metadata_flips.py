"""One flipped bit in any metadata file of an archive is named, or changes no number; never another number.

``python tests/faults metadata_flips`` tries all of them.
"""

from __future__ import annotations

from pathlib import Path

from tests.faults import metadata_flips
from tests.faults.whole_survey import Whole


def test_drawn_flips_are_named_or_change_no_number(whole: Whole, tmp_path: Path) -> None:
    """16 random bits, in each kind of store alike; survey, package and export are asked after each."""
    flips = metadata_flips.drawn_flips(whole, 16, seed=0)
    found = metadata_flips.try_flips(whole, flips, tmp_path, exported=4, cured=8)
    assert found.wrong == []
    assert sum(found.tried.values()) == 16
    assert found.refused["survey"] > 8


def test_aimed_flips_are_named_and_removed(whole: Whole, tmp_path: Path) -> None:
    """Scale, shape, type, names and others are changed in each kind of store; after `gc --damaged` all is as before."""
    flips = metadata_flips.each_kind(metadata_flips.aimed_flips(whole), 1)
    found = metadata_flips.try_flips(whole, flips, tmp_path, exported=4, cured=4)
    assert found.wrong == []
    assert {flip.uri for flip in flips} == {*whole.stores, whole.run}
    assert len(found.tried) >= 10

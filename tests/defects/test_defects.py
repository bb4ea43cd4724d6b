"""The list of seeded defects fits the source: each text occurs once, the changed file compiles, its tests exist."""

from __future__ import annotations

import pytest

from tests.defects.seeded import ROOT, Defect, read_defects

DEFECTS = read_defects()


def test_there_are_sixty_defects_of_different_names() -> None:
    assert len({one.name for one in DEFECTS}) == len(DEFECTS) >= 60


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda one: one.name)
def test_a_defect_changes_its_file_in_one_place(defect: Defect) -> None:
    """A change of the source that moves the text updates the list; a named test function is still defined."""
    assert defect.problem(ROOT) is None
    assert defect.new != defect.old
    compile(defect.applied((ROOT / defect.file).read_text(encoding="utf-8")), defect.file, "exec")
    for file, _, function in (test.partition("::") for test in defect.tests):
        assert f"def {function.partition('[')[0]}" in (ROOT / file).read_text(encoding="utf-8")

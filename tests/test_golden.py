"""Each of the eight tiny surveys gives its row of golden.json; a changed value is reported by its name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.golden import SURVEYS, complaint, differences, load, machine, row

ROW: dict[str, Any] = {
    **{"mosaic sha256": "a1", "mosaic step": 0.5, "component 00 mean": 1.0, "component 00 std": 30.0},
    **{"px weed": 100, "px soil": 9900, "effect shot": "gaussian", "savings.lines.done": 104, "accuracy.miou": 0.8},
}


@pytest.mark.parametrize("name", SURVEYS)
def test_survey_gives_its_golden_row(name: str, tmp_path: Path) -> None:
    """Exactly on the machine that wrote the file, elsewhere within tolerances."""
    golden = load()
    wrong = differences(golden["surveys"][name], row(name, tmp_path), exact=golden["machine"] == machine())
    assert not wrong, complaint(name, wrong, golden)


def test_the_file_has_the_rows_of_the_surveys() -> None:
    """A row without a survey, or a survey without a row, compares nothing."""
    assert list(load()["surveys"]) == list(SURVEYS)


@pytest.mark.parametrize(
    ("change", "exact", "elsewhere"),
    [
        ({"mosaic sha256": "b2"}, "mosaic sha256: expected a1, found b2", None),
        ({"component 00 mean": 1.2}, "component 00 mean: expected 1.0, found 1.2", None),
        ({"component 00 std": 31.0}, *["component 00 std: expected 30.0, found 31.0"] * 2),
        ({"px weed": 110}, "px weed: expected 100, found 110", None),
        ({"px weed": 120}, *["px weed: expected 100, found 120"] * 2),
        ({"savings.lines.done": 106}, *["savings.lines.done: expected 104, found 106"] * 2),
        ({"accuracy.miou": 0.805}, "accuracy.miou: expected 0.8, found 0.805", None),
        ({"effect shot": "poisson"}, *["effect shot: expected gaussian, found poisson"] * 2),
        ({"plan.lines": 3}, *["plan.lines: new, 3"] * 2),
    ],
)
def test_a_changed_value_is_named(change: dict[str, Any], exact: str, elsewhere: str | None) -> None:
    """Rounding passes on another machine alone; other changes pass nowhere."""
    assert differences(ROW, ROW | change, exact=True) == [exact]
    assert differences(ROW, ROW | change, exact=False) == ([] if elsewhere is None else [elsewhere])


def test_a_missing_value_is_named() -> None:
    """A figure that is removed has to lose its line."""
    found = {name: value for name, value in ROW.items() if name != "px soil"}
    assert differences(ROW, found, exact=False) == ["px soil: missing, 9900"]


def test_the_complaint_names_the_survey_and_the_command() -> None:
    """With the reason for a comparison within tolerances."""
    golden = {"machine": machine() | {"numpy": "1.0"}}
    said = complaint("pose", ["mosaic step: expected 0.5, found 1.0"], golden)
    assert "survey 'pose' differs" in said
    assert "within tolerances, as the file is of another machine (numpy 1.0 there" in said
    assert said.endswith("write it by `python tests/golden.py --only 'pose'`, and say why in the commit.")

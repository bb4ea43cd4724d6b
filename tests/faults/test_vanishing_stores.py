"""Commands beside `gc` of another process end well or with one message, and nothing is damaged.

``python tests/faults vanishing_stores`` tries more.
"""

from __future__ import annotations

from pathlib import Path

from tests.faults import vanishing_stores
from tests.faults.small_survey import Subject


def test_commands_end_well_while_gc_removes_stores(subject: Subject, tmp_path: Path) -> None:
    """Survey, gc, verify, ls and explain are started while 30 stores go: 54 commands, and the gc."""
    found = vanishing_stores.start_beside_gc(subject, tmp_path, 3, 3)
    assert found.wrong == []
    assert found.removed == 3 * vanishing_stores.STORES
    assert found.tried == 3 * (5 * 3 + 3)


def test_commands_end_well_when_stores_vanish_before_any_call(subject: Subject, tmp_path: Path) -> None:
    """All stores that no run names go at once, before a random call that looks at a file."""
    found = vanishing_stores.vanish_at_calls(subject, tmp_path, 15, seed=0)
    assert found.wrong == []
    assert found.removed >= 10 * vanishing_stores.STORES  # else the calls were not met

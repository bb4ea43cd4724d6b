"""A template: how to test a flow of your own. Copy it beside your flow and change the parts marked (1) to (4).

What a flow does belongs into plain functions, which need no server: test these first, as everything else here is.
Then run the flow itself once, on a throw-away Prefect server that asks nothing of the network.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.errors import RigError
from storage.archive.archive import Archive
from tests.flows.conftest import problems


# (1) What your flow does, as plain functions: arrays and files stay in here, an address and a key go out.
def count_lines(out: str) -> int:
    """How many sweeps an archive holds; your own work goes here."""
    return len(Archive.open(out).refs("capture"))


def check_rig(answers: bool) -> None:
    """Refuse to go on without a rig."""
    if not answers:
        raise RigError("no reply from the rig; is it on?")


# (2) A server for the tests: the fixture ``server`` (conftest.py) runs one in this process for all tests of a module,
# its files in a folder that goes away.


# (3) First without a server: a task's function is there as it is.
def test_the_work_itself(tmp_path: Path) -> None:
    """An archive without captures has no sweeps."""
    assert count_lines(str(tmp_path / "archive")) == 0
    with pytest.raises(RigError, match="is it on"):
        check_rig(answers=False)


# (4) Then the flow, once when all is well and once for each stage that may fail: state, message, and what it left.
def test_the_flow(server: str, tmp_path: Path) -> None:
    """It completes with what the functions give, and a failed stage fails it with that stage's message."""
    from prefect import flow, task

    @flow(name="my-flow", persist_result=False)
    def my_flow(out: str, answers: bool = True) -> int:
        task(check_rig, retries=0, persist_result=False)(answers)
        return task(count_lines, persist_result=False)(out)

    assert my_flow(str(tmp_path / "archive")) == 0
    state = my_flow(str(tmp_path / "archive"), answers=False, return_state=True)
    assert state.is_failed()
    with pytest.raises(RigError, match="is it on"):
        state.result()
    assert problems(tmp_path / "archive") == []

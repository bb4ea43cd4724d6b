"""One small survey that nothing has disturbed, for all tests here."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.faults.nursery import Nursery
from tests.faults.small_survey import Subject, prepare


@pytest.fixture(scope="session")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Subject]:
    """A small survey to disturb, and where to run it."""
    with Nursery(tmp_path_factory.mktemp("faults")) as nursery:
        yield prepare(nursery)

"""One small undisturbed survey for all tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.faults.nursery import Nursery
from tests.faults.small_survey import Subject, prepare


@pytest.fixture(scope="session")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Subject]:
    """Yield a small survey to disturb, with the process that runs it."""
    with Nursery(tmp_path_factory.mktemp("faults")) as nursery:
        yield prepare(nursery)

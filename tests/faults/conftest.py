"""Small undisturbed surveys for all tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.faults.nursery import Nursery
from tests.faults.small_survey import Subject, prepare
from tests.faults.whole_survey import Whole, survey_whole


@pytest.fixture(scope="session")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Subject]:
    """Yield a small survey to disturb, with the process that runs it."""
    with Nursery(tmp_path_factory.mktemp("faults")) as nursery:
        yield prepare(nursery)


@pytest.fixture(scope="session")
def whole(subject: Subject) -> Whole:
    """Return an archive with every kind of store, and all that it has and gives."""
    return survey_whole(subject)

"""A small data set that all evaluations judge on."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.flows.small_fields import write_field


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three small frames."""
    return write_field(tmp_path_factory.mktemp("evaluate") / "field")

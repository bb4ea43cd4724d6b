"""Archives of real, tiny surveys that the tests of this room look at, and copy before they change them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Survey


@pytest.fixture(scope="session")
def two_budgets(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> Path:
    """An archive of two surveys of one scene with different budgets, 0.8 and 0.7; not to be changed."""
    folder = tmp_path_factory.mktemp("two_budgets") / "archive"
    for budget in ("0.8", "0.7"):
        survey_png(folder, budget=budget)
    return folder


@pytest.fixture(scope="session")
def one_survey(tmp_path_factory: pytest.TempPathFactory, survey_png: Any) -> tuple[Path, Any]:
    """An archive with one survey of the small picture, not to be changed, and what it published."""
    out = tmp_path_factory.mktemp("one_survey") / "archive"
    return out, survey_png(out)

"""Bounds of all effects in the light on some random scenes and rigs; on 200 in `python tests/benchmarks effects`."""

from __future__ import annotations

import pytest

from tests.pipeline.simulator.bound_trials import trials
from tests.pipeline.simulator.random_cases import random_case

ROUGH_SLIT = pytest.mark.xfail(reason="variants of the slit err by more than the probe measured", strict=False)
CASES = [pytest.param(number, marks=[ROUGH_SLIT] if number in (9, 11) else []) for number in range(12)]


@pytest.mark.parametrize("number", CASES)
def test_no_change_exceeds_what_the_decision_counts(number: int):
    """Each effect left out, and each variant taken, beside all others exact."""
    broken = [trial for trial in trials(random_case(number)) if trial.is_broken]
    assert broken == []

"""Bounds of all effects in the light on some random scenes and rigs; on 200 in `python tests/benchmarks effects`."""

from __future__ import annotations

import pytest

from tests.pipeline.simulator.bound_trials import trials
from tests.pipeline.simulator.random_cases import random_case

CASES = (1, 5, 6, 8, 10, 11)  # the fewest of the first twelve that find each of the 174 low bounds that those find


@pytest.mark.parametrize("number", CASES)
def test_no_change_exceeds_what_the_decision_counts(number: int):
    """Each effect left out, and each variant taken, beside all others exact, as samples and in sums of 2 to 8.

    The last, in sums of 4, has a mirror that swings within its exposures: that is left out with the smear.
    """
    broken = [trial for trial in trials(random_case(number), (1, 2 + (number + 5) % 7)) if trial.is_broken]
    assert broken == []

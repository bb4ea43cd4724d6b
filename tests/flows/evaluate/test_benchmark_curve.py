"""One number for a curve of mIoU over cost: worked cases."""

from __future__ import annotations

import pytest

from flows.evaluate.series import curve_figures


def test_a_straight_line_in_the_logarithm_closes_half():
    """Without a point between, the area is that of the straight way from none to all."""
    found = curve_figures((1.0, 0.5), [], (100.0, 0.7))
    assert found.auc_gap == pytest.approx(0.5)
    assert found.hypervolume == pytest.approx(0)
    assert found.cost_to_enough == pytest.approx(1)


def test_a_curve_by_hand():
    """A tenth of the cost has all that there is: half of the logarithm at full, half rising to it."""
    found = curve_figures((1.0, 0.5), [(10.0, 0.7)], (100.0, 0.7))
    assert found.auc_gap == pytest.approx(0.75)
    assert found.hypervolume == pytest.approx(0.2 * 0.9)
    assert found.cost_to_enough == pytest.approx(0.1)


def test_more_seats_that_hurt_take_nothing_from_what_is_dominated():
    """The hypervolume holds the best so far; a point dearer than all adds nothing."""
    good = [(10.0, 0.8)]
    assert curve_figures((1.0, 0.5), [*good, (50.0, 0.6)], (100.0, 0.7)).hypervolume == pytest.approx(
        curve_figures((1.0, 0.5), [*good, (200.0, 0.9)], (100.0, 0.7)).hypervolume or 0
    )


def test_a_gap_under_a_point_has_no_area():
    """Nor has a scene where none costs as much as all."""
    assert curve_figures((1.0, 0.5), [(2.0, 0.6)], (9.0, 0.505)).auc_gap is None
    assert curve_figures((9.0, 0.5), [], (9.0, 0.7)).hypervolume is None

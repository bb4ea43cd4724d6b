"""Areas and their errors: Olofsson's own example."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.products.areas import stratified_fractions

# Olofsson et al. 2014, table 8: rows are mapped classes there, columns what the reference says
EXAMPLE = np.array([[66, 0, 5, 4], [0, 55, 8, 12], [1, 0, 153, 11], [2, 1, 9, 313]])
MAPPED = np.array([200_000, 150_000, 3_200_000, 6_450_000]) / 1e7
HECTARES_A_PIXEL = 0.09


def test_the_stratified_estimate_is_that_of_its_paper() -> None:
    """Deforestation: 21158 ha with a 95 % interval of 6158 ha, as printed there."""
    fractions, errors = stratified_fractions(MAPPED, EXAMPLE.T)
    hectares = fractions * 1e7 * HECTARES_A_PIXEL
    intervals = 1.96 * errors * 1e7 * HECTARES_A_PIXEL
    assert hectares[0] == pytest.approx(21_158, abs=1)
    assert intervals[0] == pytest.approx(6_158, abs=2)
    assert hectares.sum() == pytest.approx(900_000)


def test_a_mapped_class_with_one_judged_pixel_has_no_estimate() -> None:
    """One pixel has no spread to tell an error by; a class that is not mapped needs none."""
    counts = np.array([[8, 1], [2, 0]])
    for estimate in stratified_fractions([0.9, 0.1], counts):
        assert np.isnan(estimate).all()
    fractions, errors = stratified_fractions([1.0, 0.0], counts)
    np.testing.assert_allclose(fractions, [0.8, 0.2])
    np.testing.assert_allclose(errors, np.sqrt(0.8 * 0.2 / 9))

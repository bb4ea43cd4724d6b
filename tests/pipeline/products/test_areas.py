"""Areas and their errors: Olofsson's own example, and draws by probability."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import ShapeError
from pipeline.products.areas import BLOCK_PX, FractionEstimate, judged_enough, probable_fractions, stratified_fractions

# Olofsson et al. 2014, table 8: rows are mapped classes there, columns what the reference says
EXAMPLE = np.array([[66, 0, 5, 4], [0, 55, 8, 12], [1, 0, 153, 11], [2, 1, 9, 313]])
MAPPED = np.array([200_000, 150_000, 3_200_000, 6_450_000]) / 1e7
HECTARES_A_PIXEL = 0.09


def test_the_stratified_estimate_is_that_of_its_paper() -> None:
    """Deforestation: 21158 ha with a 95 % interval of 6158 ha, as printed there."""
    found = stratified_fractions(MAPPED, EXAMPLE.T)
    hectares = found.fractions * 1e7 * HECTARES_A_PIXEL
    errors = 1.96 * found.errors * 1e7 * HECTARES_A_PIXEL
    assert hectares[0] == pytest.approx(21_158, abs=1)
    assert errors[0] == pytest.approx(6_158, abs=2)
    assert hectares.sum() == pytest.approx(900_000)


def test_a_mapped_class_that_was_not_judged_takes_its_own_estimate() -> None:
    """By hand: .9 of the map by counts, .1 by what is said of it; without that NaN. Sizes that differ raise."""
    counts = np.array([[8, 0], [2, 0]])
    others = FractionEstimate(np.array([0.25, 0.75]), np.array([0.2, 0.2]))
    found = stratified_fractions([0.9, 0.1], counts, others)
    np.testing.assert_allclose(found.fractions, [0.9 * 0.8 + 0.1 * 0.25, 0.9 * 0.2 + 0.1 * 0.75])
    np.testing.assert_allclose(found.errors, np.hypot(0.9 * np.sqrt(0.8 * 0.2 / 9), 0.1 * 0.2))
    assert np.isnan(stratified_fractions([0.9, 0.1], counts).fractions).all()
    np.testing.assert_allclose(stratified_fractions([1.0, 0.0], counts).fractions, [0.8, 0.2])
    with pytest.raises(ShapeError, match="2 classes and a confusion matrix"):
        stratified_fractions([0.5, 0.5], np.eye(3))


def test_classes_with_two_judged_pixels_are_judged() -> None:
    """One pixel has no spread to tell an error by."""
    np.testing.assert_array_equal(judged_enough([[1, 0, 1], [1, 1, 0], [0, 0, 0]]), [True, False, False])


def test_errors_by_probability_are_those_of_draws() -> None:
    """The spread of shares over draws in which a block's pixels go the same way is the standard error that is told."""
    rng = np.random.default_rng(3)
    blocks = rng.uniform(0, 1, (4, 5))
    first = np.kron(blocks, np.ones((BLOCK_PX, BLOCK_PX)))
    probability = np.stack([first, 1 - first], axis=-1)
    probability[:3, :3] = np.nan
    found = probable_fractions([probability[:BLOCK_PX], probability[BLOCK_PX:]], 2)
    known = np.isfinite(first) & ~np.isnan(probability[..., 0])
    drawn = []
    for _ in range(4000):
        went = np.kron(rng.uniform(0, 1, blocks.shape) < blocks, np.ones((BLOCK_PX, BLOCK_PX)))
        drawn.append(went[known].mean())
    assert found.fractions[0] == pytest.approx(np.mean(drawn), abs=0.005)
    assert found.errors[0] == pytest.approx(np.std(drawn), rel=0.06)
    assert found.errors[0] == pytest.approx(found.errors[1])
    assert np.isnan(probable_fractions([], 2).fractions).all()

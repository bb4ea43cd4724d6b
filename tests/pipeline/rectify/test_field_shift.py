"""How a field lies beside an earlier look: moved and turned fields are found, changed ones are not taken for them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, rotate

from pipeline.rectify.registration.alignment import FieldShift, field_shift

SIZE = (120, 150)
REACH = 12.0


def textured(seed: int, shape: tuple[int, int] = (180, 210)) -> NDArray[np.float64]:
    """A field with structure over some pixels, larger than what is compared."""
    rng = np.random.default_rng(seed)
    field: NDArray[np.float64] = gaussian_filter(rng.normal(size=shape), 2.0)
    return field


def cut(field: NDArray[np.float64], down: int = 0, across: int = 0) -> NDArray[np.float64]:
    """The middle of it, as much higher and further left."""
    return field[30 - down : 150 - down, 30 - across : 180 - across]


@settings(max_examples=12)
@given(seed=st.integers(0, 1000), down=st.integers(-11, 11), across=st.integers(-11, 11))
def test_a_moved_field_is_found(seed: int, down: int, across: int) -> None:
    """To a tenth of a pixel, and not turned."""
    field = textured(seed)
    found = field_shift(cut(field, down, across), cut(field), reach_px=REACH)
    np.testing.assert_allclose(found.shift, (down, across), atol=0.1)
    assert found.edge_px(SIZE) < 0.3


@pytest.mark.parametrize("degrees", [-5.0, -2.0, 1.0, 3.0, 5.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_turned_field_is_found(seed: int, degrees: float) -> None:
    """To a fifth of a degree, about its middle."""
    field = textured(seed, (180, 210))
    turned = rotate(field, degrees, reshape=False, order=3)
    found = field_shift(cut(turned), cut(field), reach_px=REACH)
    assert abs(found.turned_deg) == pytest.approx(abs(degrees), abs=0.2)
    assert np.hypot(*found.shift) < 1.0


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_what_changed_in_places_moves_nothing(seed: int) -> None:
    """A third of the field grown over by another, and noise everywhere."""
    field, rng = textured(seed), np.random.default_rng(seed)
    now = cut(field).copy()
    now[:, :50] = cut(textured(seed + 50))[:, :50]
    now += rng.normal(0, 0.1 * now.std(), now.shape)
    found = field_shift(now, cut(field), reach_px=REACH)
    assert np.hypot(*found.shift) < 0.3
    assert found.edge_px(SIZE) < 0.5


@pytest.mark.parametrize("now", [np.full(SIZE, np.nan), np.ones(SIZE)])
def test_where_nothing_is_shown_nothing_is_said(now: NDArray[np.float64]) -> None:
    """No value at all, or no structure; and fields that have nothing in common."""
    assert field_shift(now, cut(textured(6)), reach_px=REACH) == FieldShift()
    assert field_shift(cut(textured(7)), cut(textured(8)), reach_px=REACH) == FieldShift()


def test_a_small_field_is_compared_as_one() -> None:
    """Too small for windows, it is moved by what it says as a whole."""
    field = textured(9)
    found = field_shift(cut(field, 3, -2)[:60, :60], cut(field)[:60, :60], reach_px=REACH)
    np.testing.assert_allclose(found.shift, (3, -2), atol=0.2)
    assert found.turned_deg == 0

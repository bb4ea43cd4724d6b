"""Tokens of both scales and the codes of their places."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from models.network.layers import code_1d, code_2d, paper_numbers
from pipeline.errors import ShapeError

PLACE = st.tuples(st.integers(0, 4000), st.integers(0, 4000))


@given(PLACE, PLACE, PLACE)
def test_codes_know_distances_not_places(a: tuple[int, int], b: tuple[int, int], by: tuple[int, int]):
    """The product of two codes depends on the way between them alone, so crops can lie anywhere."""
    here, there, shift = (torch.tensor(place, dtype=torch.float64) for place in (a, b, by))
    still = code_2d(here, 32) @ code_2d(there, 32)
    moved = code_2d(here + shift, 32) @ code_2d(there + shift, 32)
    assert moved.item() == pytest.approx(still.item(), abs=1e-5)


def test_a_code_repeats_from_two_seats_to_128():
    """The quickest sine has a period of 2 seats, the slowest of 128, alike down and across."""
    near, two, far = (code_2d(torch.tensor([y, y], dtype=torch.float64), 16) for y in (0.3, 2.3, 128.3))
    assert near[[0, 8]] == pytest.approx(two[[0, 8]], abs=1e-6)
    assert near[[3, 11]] == pytest.approx(far[[3, 11]], abs=1e-6)
    assert near[:8].tolist() == near[8:].tolist()


def test_rows_do_not_wrap_in_two_dimensions():
    """The far side of the row before is no neighbour, as it is in the paper's code."""
    start, right, wrapped = (code_2d(torch.tensor(yx), 128) for yx in ([5.5, 15.5], [5.5, 16.5], [6.5, 0.5]))
    assert start @ right > 1.2 * (start @ wrapped)


def test_width_and_precision_are_checked():
    """A width that does not divide by 4 and places in half precision are refused."""
    with pytest.raises(ShapeError, match="divides by 4, got 10"):
        code_2d(torch.zeros(1, 2), 10)
    with pytest.raises(ShapeError, match=r"got torch\.bfloat16"):
        code_2d(torch.zeros(1, 2, dtype=torch.bfloat16), 16)
    with pytest.raises(ShapeError, match=r"got torch\.float16"):
        code_1d(torch.zeros(1, dtype=torch.float16), 16)


def _paper(yx: list[list[float]], fine: bool, columns: int = 16, factor: int = 2) -> list[float]:
    places = torch.tensor(yx, dtype=torch.float64)
    scale = torch.full((len(yx),), 0.0 if fine else 1.0)
    return paper_numbers(places, scale, columns, factor).tolist()


def test_patches_are_numbered_as_in_the_paper():
    """With 4 seats a patch: 1, 6, 11 ... along a row, and the paper's example 21 -> 26."""
    row = [[1.0, 2.0 * n + 1] for n in range(6)]
    assert _paper(row, fine=False) == [1, 6, 11, 16, 21, 26]
    assert _paper([[3.0, 1.0]], fine=False) == [16 * 5 + 1]  # the next row goes on counting


def test_seats_follow_their_patch():
    """The seats of patch 21 are 22 to 25, row by row, and 26 is the next patch."""
    seats = [[y + 0.5, 8 + x + 0.5] for y in (0, 1) for x in (0, 1)]
    assert _paper(seats, fine=True) == [22, 23, 24, 25]


@pytest.mark.parametrize(("factor", "size"), [(2, (3, 5)), (4, (2, 3))])
def test_no_number_is_given_twice(factor: int, size: tuple[int, int]):
    """Patches and seats of a whole scene together take every number from 1 once."""
    rows, columns = size
    patches = [[(y + 0.5) * factor, (x + 0.5) * factor] for y in range(rows) for x in range(columns)]
    seats = [[y + 0.5, x + 0.5] for y in range(rows * factor) for x in range(columns * factor)]
    numbers = _paper(patches, False, columns, factor) + _paper(seats, True, columns, factor)
    assert sorted(numbers) == list(range(1, rows * columns * (factor**2 + 1) + 1))


@pytest.mark.parametrize(
    ("first", "second", "cosine"),
    [(21, 26, 0.741), (21, 101, 0.459), (76, 81, 0.741), (21, 22, 0.973), (21, 25, 0.769), (25, 26, 0.973)],
)
def test_the_papers_code_has_no_columns(first: int, second: int, cosine: float):
    """Right neighbour and row wrap look alike, and a patch's last seat is nearer to the next patch."""
    a, b = code_1d(torch.tensor([first, second]), 768)
    assert torch.cosine_similarity(a, b, dim=0).item() == pytest.approx(cosine, abs=1e-3)

"""What is remembered of how a field looked: earlier coarse passes laid beside and over each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flows.tasks.field_prior_map import laid_together, shifted

Image = NDArray[np.float32]


def _image(seed: int, told: float) -> Image:
    """(y, x, column), of which a fraction is told."""
    rng = np.random.default_rng(seed)
    image = rng.normal(size=(6, 8, 2)).astype(np.float32)
    image[rng.random((6, 8)) > told] = np.nan
    return image


@given(seed=st.integers(0, 99), count=st.integers(1, 4))
def test_of_a_place_the_newest_look_counts(seed: int, count: int) -> None:
    """Each pixel is that of the first image that tells it, and nothing is told that none of them does."""
    images = [_image(seed + number, told=0.4) for number in range(count)]
    whole = laid_together(iter(images))
    for y, x in np.ndindex(6, 8):
        telling = [image[y, x] for image in images if np.isfinite(image[y, x]).all()]
        np.testing.assert_array_equal(whole[y, x], telling[0] if telling else [np.nan, np.nan])


def test_older_looks_are_read_only_where_newer_ones_lack_something() -> None:
    """A field that was looked at as a whole costs one picture, however many there are."""
    whole = _image(0, told=1.0)

    def images() -> Iterator[Image]:
        yield whole
        yield whole + 1
        raise AssertionError("read although nothing was missing")

    np.testing.assert_array_equal(laid_together(images()), whole)


@given(down=st.integers(-9, 9), across=st.integers(-9, 9), seed=st.integers(0, 9))
def test_what_is_moved_and_moved_back_lacks_its_edge_alone(down: int, across: int, seed: int) -> None:
    """Every pixel that stayed within is where it was, the others are unknown."""
    image = _image(seed, told=1.0)
    back = shifted(shifted(image, (down, across)), (-down, -across))
    stayed = np.zeros((6, 8), bool)
    stayed[max(-down, 0) : max(6 - max(down, 0), 0), max(-across, 0) : max(8 - max(across, 0), 0)] = True
    np.testing.assert_array_equal(back[stayed], image[stayed])
    assert np.isnan(back[~stayed]).all()

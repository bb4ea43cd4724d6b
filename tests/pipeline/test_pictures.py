"""Pictures put together by their places: the parts of an image give the image, and a wrong place is found out."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from pipeline.errors import ShapeError
from pipeline.rectify.pictures import Picture, join_pictures, picture_shift


def image(shape: tuple[int, int] = (90, 150), seed: int = 0) -> np.ndarray:
    """Smooth whole numbers of 0 to 255 in three bands."""
    noise = np.random.default_rng(seed).normal(size=(*shape, 3))
    smooth = gaussian_filter(noise, (1.5, 1.5, 0))
    return np.rint(np.clip(smooth / smooth.std() * 40 + 128, 0, 255)).astype(np.float32)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 89), st.integers(0, 89), st.sampled_from(["nearest", "bilinear", "catmull-rom"]))
def test_parts_of_an_image_give_the_image(first: int, second: int, kernel: str):
    """Two parts in their places are the whole, wherever they are cut and overlap, by every kernel."""
    whole = image()
    upper, lower = max(first, second), min(first, second)
    parts = [Picture(whole[:upper], np.zeros(2)), Picture(whole[lower:], np.array([lower, 0.0]))]
    joined, count = join_pictures(parts, whole.shape[:2], kernel=kernel)  # type: ignore[arg-type]
    np.testing.assert_array_equal(np.rint(joined), whole)
    assert count.sum() == 150 * (90 + upper - lower)


def test_wrong_place_is_found_and_mended():
    """A part said to lie a few pixels off is brought back, and the whole is exact again."""
    whole = image()
    left, right = Picture(whole[:, :95], np.zeros(2)), Picture(whole[:, 45:], np.array([3.0, 41.0]))
    found = picture_shift(left, right, prior_px=6)
    np.testing.assert_allclose(found.shift, [-3, 4], atol=1e-3)
    mended = Picture(right.values, np.rint(right.origin_px + found.shift))
    np.testing.assert_array_equal(np.rint(join_pictures([left, mended], (90, 150), kernel="nearest")[0]), whole)


def test_pixels_without_a_value_leave_room_for_others():
    """Where one picture has a hole the other shows; where none reaches there is NaN."""
    whole = image()
    hole = np.ones((90, 60), bool)
    hole[30:40] = False
    parts = [Picture(whole[:, :60], np.zeros(2), hole), Picture(whole[:, 50:100], np.array([0.0, 50.0]))]
    joined, count = join_pictures(parts, (90, 150), kernel="nearest")
    np.testing.assert_array_equal(np.rint(joined[30:40, 50:100]), whole[30:40, 50:100])
    assert np.isnan(joined[30:40, :50]).all()
    assert np.isnan(joined[:, 100:]).all()
    assert (count[:, 100:] == 0).all()


def test_pictures_apart_are_empty():
    """Pictures that share no pixel have no shift."""
    parts = [Picture(image(), np.zeros(2)), Picture(image(), np.array([200.0, 0.0]))]
    assert picture_shift(*parts, prior_px=5).status == "empty"


def test_pictures_that_do_not_fit_are_refused():
    """A mask of another size and an empty grid are named."""
    with pytest.raises(ShapeError, match=r"\(90, 150, 3\) and \(4, 4\)"):
        Picture(image(), np.zeros(2), np.ones((4, 4), bool))
    with pytest.raises(ShapeError, match="at least one row"):
        join_pictures([Picture(image(), np.zeros(2))], (0, 5))


@pytest.fixture(scope="module")
def rgbn() -> np.ndarray:
    """The real picture of four bands, (row, column, band); skips where it is not."""
    folder = Path(os.environ.get("SPECTRALZOOM_DATA", Path(__file__).parents[3] / "shared" / "data"))
    path = folder / "rgbn" / "rgbn.tif"
    if not path.is_file():
        pytest.skip(f"no real data at {path} (set SPECTRALZOOM_DATA)")
    with pytest.importorskip("rasterio").open(path) as file:
        values: np.ndarray = file.read()
    return np.moveaxis(values, 0, -1).astype(np.float32)


def test_real_picture_is_put_together_exactly(rgbn: np.ndarray):
    """Two overlapping parts of a real picture, one said to lie elsewhere, are it again, bit by bit."""
    left, right = Picture(rgbn[:, :320], np.zeros(2)), Picture(rgbn[:, 220:], np.array([3.0, 216.0]))
    found = picture_shift(left, right, prior_px=8)
    np.testing.assert_allclose(found.shift, [-3, 4], atol=1e-6)
    mended = Picture(right.values, np.rint(right.origin_px + found.shift))
    joined, _ = join_pictures([left, mended], rgbn.shape[:2], kernel="nearest")
    np.testing.assert_array_equal(np.rint(joined), rgbn)

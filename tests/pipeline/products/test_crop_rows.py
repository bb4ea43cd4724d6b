"""Crop rows of known directions, and pictures without any."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import ShapeError
from pipeline.products.crop_rows import CropRows, find_rows


def sine_rows(angle_deg: float, period: float, noise: float, shape: tuple[int, int] = (200, 256)) -> np.ndarray:
    """Sine rows along an angle from x towards y, with noise of the same size."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    across = y * np.cos(np.deg2rad(angle_deg)) - x * np.sin(np.deg2rad(angle_deg))
    return np.sin(2 * np.pi * across / period) + noise * np.random.default_rng(1).normal(size=shape)


@settings(max_examples=30, deadline=None)
@given(st.floats(0, 179.9), st.floats(4, 9))
def test_the_direction_of_rows_is_found(angle: float, period: float):
    """Within four degrees, at any angle and from four pixels apart, with noise half as strong as the rows."""
    found = find_rows(sine_rows(angle, period, 0.5))
    assert found.angle_deg is not None
    assert abs((found.angle_deg - angle + 90) % 180 - 90) < 4


def test_gaps_weeds_and_missing_pixels_do_not_matter():
    """Half of the rows gone, a bright track across them and NaN pixels leave the direction."""
    image = sine_rows(30.0, 6.0, 0.3)
    rng = np.random.default_rng(2)
    image[rng.random(image.shape) < 0.05] = np.nan
    image[40:90, 100:200] = rng.normal(size=(50, 100))
    image[:, 60:64] += 40.0
    found = find_rows(image)
    assert found.angle_deg == pytest.approx(30.0, abs=3)


@pytest.mark.parametrize("seed", range(5))
def test_noise_has_no_rows(seed: int):
    """White noise points anywhere."""
    found = find_rows(np.random.default_rng(seed).normal(size=(120, 150)))
    assert found.angle_deg is None
    assert found.strength < 0.1


@pytest.mark.parametrize(
    "image",
    [
        np.ones((60, 60)),
        np.full((60, 60), np.nan),
        np.zeros((1, 1)),
        np.zeros((0, 5)),
        np.zeros((1, 40)),
        sine_rows(30.0, 6.0, 0.1, (12, 40)),
    ],
    ids=["flat", "nan", "one pixel", "empty", "one row", "three tiles"],
)
def test_nothing_to_see_is_none(image: np.ndarray):
    """A flat, unknown or tiny picture has no rows and strength 0."""
    assert find_rows(image) == CropRows(None, 0.0)


def test_one_border_between_fields_is_no_row():
    """A step across an otherwise even picture speaks for its own tiles alone."""
    image = np.random.default_rng(0).normal(size=(200, 240))
    image[90:] += 30.0
    assert find_rows(image).angle_deg is None


@pytest.mark.parametrize("seed", [0, 5])
def test_plots_with_rows_every_which_way_have_no_common_direction(seed: int):
    """Strong rows that plots do not agree on are none of the field's, even where their mean is not small."""
    turns = np.random.default_rng(seed).uniform(0, 180, 4)
    found = find_rows(np.block([[sine_rows(turn, 6.0, 0.3, (40, 40)) for turn in turns] for _ in range(3)]))
    assert found.strength > 0.12
    assert found.angle_deg is None


def test_a_trace_of_rows_is_too_little():
    """Rows deep below the noise, though all tiles agree on them, are not reported."""
    assert find_rows(sine_rows(30.0, 6.0, 3.0, (300, 350))).angle_deg is None


def test_cubes_are_refused():
    """One image is asked for, not bands."""
    with pytest.raises(ShapeError, match=r"one \(y, x\) image, got shape \(4, 4, 3\)"):
        find_rows(np.zeros((4, 4, 3)))

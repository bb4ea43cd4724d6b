"""The farm's land: parcels fill it once, coverage is area, and crop rows have their period and heading."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import FieldPlan, farm_plan
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import farm_scene
from spectralzoom.pipeline.simulator.scenes.farm.land import (
    Parcel,
    clip_polygon,
    divide_land,
    parcel_pixels,
    polygon_area,
    rectangle,
    stream,
)


def test_parcels_cover_the_land_once() -> None:
    """The parcels' coverages sum to 1 in every pixel, and their areas to the land's."""
    parcels, _ = divide_land(stream(4, "land"), rectangle(700, 640), 20_000)
    assert sum(polygon_area(parcel.corners) for parcel in parcels) == pytest.approx(700 * 640)
    cover = np.zeros(300 * 280)
    for parcel in parcels:
        index, part, _ = parcel_pixels(parcel, (300, 280))
        cover[index] += part
    np.testing.assert_allclose(cover, 1, atol=1e-5)


def test_coverage_sums_to_the_area_of_the_polygon() -> None:
    """Coverage summed over the pixels is the polygon's area to 0.2 %, at any angle."""
    square = np.array([[-40.0, -40], [-40, 40], [40, 40], [40, -40]])
    cuts = []
    for angle in (0.3, 1.7, 2.9, 4.4):
        cuts.append((float(np.cos(angle)), float(np.sin(angle)), -20.0))
        square = clip_polygon(square, cuts[-1])
    _, cover, _ = parcel_pixels(Parcel(square, tuple(cuts)), (90, 90))
    assert cover.sum() == pytest.approx(polygon_area(square), rel=2e-3)


WINDOW = 128


def middle(field: FieldPlan, image: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """Return the square window deepest inside a field, or None if the field is too narrow."""
    index, _, centres = parcel_pixels(field.parcel, image.shape)
    depth = np.min(np.array(image.shape) / 2 - np.abs(centres), axis=1)
    for ny, nx, offset in field.parcel.cuts:
        np.minimum(depth, centres @ np.array([ny, nx]) - offset, out=depth)
    if not index.size or depth.max() < WINDOW / 2 + 3:
        return None
    y, x = np.divmod(index[depth.argmax()], image.shape[1])
    half = WINDOW // 2
    return image[y - half : y + half, x - half : x + half]


def wave(image: NDArray[np.float32], near_period: float) -> tuple[float, float]:
    """Return period and heading of the strongest wave within 25 % of a frequency, by a padded, windowed transform."""
    taper = np.hanning(WINDOW)
    power = np.abs(np.fft.rfft2((image - image.mean()) * taper[:, None] * taper, (8 * WINDOW, 8 * WINDOW)))
    fy, fx = np.fft.fftfreq(8 * WINDOW)[:, None], np.fft.rfftfreq(8 * WINDOW)
    frequency = np.hypot(fy, fx)
    power[np.abs(frequency * near_period - 1) > 0.25] = 0
    row, column = np.unravel_index(power.argmax(), power.shape)
    angle = np.degrees(np.arctan2(fy[row, 0], fx[column])) + 90
    return float(1 / frequency[row, column]), float(angle % 180)


def test_crop_rows_have_their_period_and_heading() -> None:
    """In every field with a crop, the Fourier transform finds the period to 2 % and the heading to 1.2 degrees."""
    plan = farm_plan(1)
    scene = farm_scene(1, bands=4)
    seen = 0
    picture = scene.planes @ np.ascontiguousarray(scene.spectra()[:, 3])  # in June, in the near infrared
    for field in plan.fields:
        window = middle(field, picture)
        if field.crop is None or field.land_on(plan.day).phase != "crop" or window is None:
            continue
        period, heading = wave(window, field.row_period_px)
        assert period == pytest.approx(field.row_period_px, rel=0.02)
        assert abs((heading - field.row_angle_deg + 90) % 180 - 90) < 1.2  # angle between undirected lines
        seen += 1
    assert seen >= 6

"""Rows in the picture: their heading and period are those of the plan, found by the spectrum and by their gradients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.planning.orientation import find_rows
from pipeline.simulator.scenes.farm.farm_plan import Ground
from pipeline.simulator.scenes.farm.farm_plan import FarmPlan, FieldPlan, farm_plan
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.farm.fields import row_gaps, row_shadow, rows_of, stripes_of, wheel_marks
from pipeline.simulator.scenes.farm.land import Parcel, parcel_pixels, stripes
from pipeline.simulator.scenes.farm.seasons import Sun

WINDOW = 128


@pytest.fixture(scope="module")
def survey() -> tuple[FarmPlan, NDArray[np.float32]]:
    """A farm's plan in June and what the near infrared shows of it, (y, x)."""
    scene = farm_scene(1, bands=4)
    return farm_plan(1), scene.planes @ np.ascontiguousarray(scene.spectra()[:, 3])


def middle(field: FieldPlan, image: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """The square window that lies deepest in a field; None where the field is too narrow."""
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
    """Period and heading of the strongest wave within a quarter of a period, by a padded, windowed transform."""
    taper = np.hanning(WINDOW)
    power = np.abs(np.fft.rfft2((image - image.mean()) * taper[:, None] * taper, (8 * WINDOW, 8 * WINDOW)))
    fy, fx = np.fft.fftfreq(8 * WINDOW)[:, None], np.fft.rfftfreq(8 * WINDOW)
    frequency = np.hypot(fy, fx)
    power[np.abs(frequency * near_period - 1) > 0.25] = 0
    row, column = np.unravel_index(power.argmax(), power.shape)
    angle = np.degrees(np.arctan2(fy[row, 0], fx[column])) + 90
    return float(1 / frequency[row, column]), float(angle % 180)


def turned_by(angle: float, other: float) -> float:
    """Angle between two lines [deg]."""
    return abs((angle - other + 90) % 180 - 90)


def test_period_and_heading_are_in_the_picture(survey: tuple[FarmPlan, NDArray[np.float32]]) -> None:
    """In every field with a crop, the Fourier transform finds the period to 2 % and the heading to 1.2 degrees."""
    plan, picture = survey
    seen = 0
    for field in plan.fields:
        window = middle(field, picture)
        if field.crop is None or field.land_on(plan.day).phase != "crop" or window is None:
            continue
        period, heading = wave(window, field.row_period_px)
        assert period == pytest.approx(field.row_period_px, rel=0.02)
        assert turned_by(heading, field.row_angle_deg) < 1.2
        seen += 1
    assert seen >= 6


def test_rows_are_found_by_their_gradients(survey: tuple[FarmPlan, NDArray[np.float32]]) -> None:
    """Where rows lie four pixels apart and more, ``find_rows`` gives their heading within five degrees."""
    plan, picture = survey
    for field in plan.fields:
        window = middle(field, picture)
        if field.use not in ("maize", "sugar_beet") or window is None:
            continue
        found = find_rows(window)
        assert found.angle_deg is not None
        assert turned_by(found.angle_deg, field.row_angle_deg) < 5
        assert found.strength > 0.6


def a_field(use: str) -> tuple[FarmPlan, FieldPlan]:
    """The largest field of a use on one farm."""
    plan = farm_plan(1)
    fields = [field for field in plan.fields if field.use == use]
    return plan, max(fields, key=lambda field: parcel_pixels(field.parcel, plan.shape)[0].size)


def test_gaps_are_rarer_than_the_fields_rate() -> None:
    """Pieces without plants cover between a tenth and twice the rate, and more where vigour is poor."""
    plan, field = a_field("maize")
    centres = parcel_pixels(field.parcel, plan.shape)[2]
    rows = rows_of(np.random.default_rng(0), field, centres)
    flat = np.zeros(len(centres), np.float32)
    gaps = [row_gaps(3, field, rows, Ground(flat, flat + vigour, flat, flat, flat)) for vigour in (-2.0, 0.0, 2.0)]
    assert all(gap.min() >= 0 and gap.max() <= 1 for gap in gaps)
    assert 0.1 * field.gap_rate < gaps[1].mean() < 2 * field.gap_rate
    assert gaps[0].mean() > gaps[1].mean() > gaps[2].mean() > 0


def test_rows_turn_on_the_headland() -> None:
    """Within the headland pixels are counted from the field's end, further in across the rows."""
    plan, field = a_field("maize")
    centres = parcel_pixels(field.parcel, plan.shape)[2]
    rows = rows_of(np.random.default_rng(0), field, centres)
    turned = rows.ends < field.headland_px
    assert 0.02 < turned.mean() < 0.6
    np.testing.assert_array_equal(rows.place[turned], rows.ends[turned])
    assert np.abs(rows.place[~turned] - rows.across[~turned]).max() < 0.2 * field.row_period_px


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 135.0])
def test_rows_shade_what_lies_away_from_the_sun(azimuth: float) -> None:
    """Rows that run north throw no shadow at noon; else it lies opposite the sun, as wide as cot(elevation) says."""
    x = np.arange(-30.0, 30.0, 0.25)
    open_land = Parcel(np.array([[-50.0, -50.0], [-50.0, 50.0], [50.0, 50.0], [50.0, -50.0]]))
    northward = replace(a_field("maize")[1], parcel=open_land, row_angle_deg=90.0, row_phase_px=0.0)
    rows = rows_of(np.random.default_rng(0), northward, np.column_stack([np.zeros_like(x), x]))
    shade = row_shadow(Sun(azimuth, 45.0), 6.0, rows, 20.0, np.full(x.size, 4.0))
    near = np.abs(x) < 10
    width = float(shade[near].sum() * 0.25)
    assert width == pytest.approx(6 * abs(np.sin(np.deg2rad(azimuth))), abs=0.6)
    if width > 1:
        assert float((shade[near] * x[near]).sum()) < 0  # the sun is in the east: shadows lie west


def test_stripes_of_agree_with_the_layouts() -> None:
    """Stripes of one width from pixel to pixel are those of the layout."""
    place = np.linspace(-40, 40, 733)
    for width in (0.3, 1.0, 2.7):
        np.testing.assert_allclose(stripes_of(place, 5.3, np.full(733, width)), stripes(place, 5.3, width), atol=1e-6)


def test_wheel_marks_come_in_pairs() -> None:
    """A field without tramlines has no marks; with them they cover about two widths in every spacing."""
    plan, field = a_field("wheat_a")
    centres = parcel_pixels(field.parcel, plan.shape)[2]
    for one in (a_field("grass")[1], field):
        marks = wheel_marks(one, rows_of(np.random.default_rng(0), one, centres))
        if one.tramlines is None:
            assert marks.max() == 0
        else:
            assert 0.3 < marks.mean() / (2 * one.tramlines.width / one.tramlines.spacing) < 4
            assert marks.max() == 1

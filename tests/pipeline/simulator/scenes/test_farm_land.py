"""The farm's land: parcels, lines, discs and rows by their laws, and scenes that are worth a second look."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.geometry.camera import LineCamera, expose, footprint
from pipeline.simulator.scenes.farm.farm_plan import FarmPlan, FieldPlan, Ground, farm_plan
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.farm.fields import row_gaps, row_shadow, rows_of, stripes_of, wheel_marks
from pipeline.simulator.scenes.farm.land import (
    Parcel,
    allot,
    clip_polygon,
    divide_land,
    parcel_pixels,
    polygon_area,
    smooth_noise,
    stream,
    stripes,
)
from pipeline.simulator.scenes.farm.seasons import Sun
from pipeline.simulator.scenes.scene import RasterScene


@pytest.fixture(scope="module")
def farms() -> list[RasterScene]:
    """Three farms of the default size in few bands."""
    return [farm_scene(seed, bands=4) for seed in range(3)]


def labels_of(scene: RasterScene) -> NDArray[np.uint8]:
    """The labels, which every farm has."""
    assert scene.labels is not None
    return scene.labels


def class_counts(scene: RasterScene) -> NDArray[np.intp]:
    """Pixels of every class."""
    return np.bincount(labels_of(scene).ravel(), minlength=len(scene.class_names))


def test_bands_do_not_move_the_farm() -> None:
    """The layout does not depend on the bands."""
    few, many = farm_scene(3, (90, 70), bands=2), farm_scene(3, (90, 70), bands=31)
    np.testing.assert_array_equal(few.planes, many.planes)
    assert many.electrons.shape == (many.planes.shape[2], 31)


def test_every_class_is_there(farms: list[RasterScene]) -> None:
    """Each farm has every class, and on average none has less than 0.7 % of the pixels."""
    each = np.array([class_counts(farm) / labels_of(farm).size for farm in farms])
    assert each.min() > 0.003
    assert each.mean(axis=0).min() > 0.007
    assert each.max() < 0.45


@pytest.mark.parametrize("name", ["water", "track"])
def test_ditches_and_tracks_are_thin_and_long(farms: list[RasterScene], name: str) -> None:
    """Water and tracks run on for more than 120 px while most of their pixels lie within 2 px of their edge."""
    farm = farms[0]
    mask = farm.labels == farm.class_names.index(name)
    pieces, _ = ndimage.label(mask, structure=np.ones((3, 3)))
    longest = max(max(part.stop - part.start for part in box) for box in ndimage.find_objects(pieces))
    assert longest > 120
    assert (ndimage.distance_transform_edt(mask)[mask] <= 2.01).mean() > 0.6


def test_single_plants_stand_in_the_fields(farms: list[RasterScene]) -> None:
    """Dozens of weeds stand alone, 2 to 5 px across."""
    farm = farms[1]
    pieces, _ = ndimage.label(farm.labels == farm.class_names.index("weed"), structure=np.ones((3, 3)))
    sizes = np.array([max(part.stop - part.start for part in box) for box in ndimage.find_objects(pieces)])
    assert ((sizes >= 2) & (sizes <= 5)).sum() > 60


def test_detail_is_where_a_second_look_pays(farms: list[RasterScene]) -> None:
    """Half of what labels at a quarter of the resolution have wrong lies in a fifth of the seats."""
    for farm in farms:
        blocks = labels_of(farm).reshape(256, 4, 320, 4).transpose(0, 2, 1, 3).reshape(256, 320, 16)
        counts = np.stack([(blocks == number).sum(axis=-1) for number in range(len(farm.class_names))], axis=-1)
        wrong = (16 - counts.max(axis=-1)).reshape(64, 4, 80, 4).sum(axis=(1, 3)) / 256
        assert 0.2 < (wrong > 0.05).mean() < 0.55
        assert np.sort(wrong.ravel())[-1024:].sum() > 0.5 * wrong.sum()


def twin_accuracy(scene: RasterScene, bands: NDArray[np.intp]) -> float:
    """Accuracy of Fisher's discriminant between the twins on a third of a look's pixels, fitted on every other one."""
    electrons = scene.planes[:320] @ np.ascontiguousarray(scene.electrons[:, bands])
    seen = expose(footprint(electrons, LineCamera()), LineCamera(), step=1, rng=np.random.default_rng(0)).reshape(
        -1, len(bands)
    )
    labels = labels_of(scene)[:320].ravel()
    twins = [seen[labels == scene.class_names.index(name)] for name in ("wheat_a", "wheat_b")]
    size = min(map(len, twins))
    twins = [pixels[np.linspace(0, len(pixels) - 1, size).astype(int)] for pixels in twins]
    means = [pixels[::2].mean(axis=0) for pixels in twins]
    scatter = np.cov(np.concatenate([pixels[::2] - mean for pixels, mean in zip(twins, means, strict=True)]).T)
    axis = np.linalg.solve(scatter, means[1] - means[0])
    middle = (means[0] + means[1]) @ axis / 2
    return float(((twins[0][1::2] @ axis < middle).mean() + (twins[1][1::2] @ axis > middle).mean()) / 2)


def test_twins_need_the_spectrum() -> None:
    """In the fine pass many bands tell the two wheats apart in most pixels; red, green and blue do not."""
    scene = farm_scene(3, bands=68, day=130)
    colour = np.array([np.abs(scene.wavelength_nm - nm).argmin() for nm in (640, 550, 460)])
    assert twin_accuracy(scene, np.arange(68)) > 0.75
    assert twin_accuracy(scene, colour) < 0.62


def test_parcels_share_the_land() -> None:
    """The parcels' coverages sum to 1 in every pixel, and their areas to the land's."""
    parcels, _ = divide_land(stream(4, "land"), (700, 640), 20_000)
    assert sum(polygon_area(parcel.corners) for parcel in parcels) == pytest.approx(700 * 640)
    cover = np.zeros(300 * 280)
    for parcel in parcels:
        index, part, _ = parcel_pixels(parcel, (300, 280))
        cover[index] += part
    np.testing.assert_allclose(cover, 1, atol=1e-5)


def test_coverage_is_area() -> None:
    """Coverage summed over the pixels is the polygon's area, whatever its angle."""
    square = np.array([[-40.0, -40], [-40, 40], [40, 40], [40, -40]])
    cuts = []
    for angle in (0.3, 1.7, 2.9, 4.4):
        cuts.append((float(np.cos(angle)), float(np.sin(angle)), -20.0))
        square = clip_polygon(square, cuts[-1])
    _, cover, _ = parcel_pixels(Parcel(square, tuple(cuts)), (90, 90))
    assert cover.sum() == pytest.approx(polygon_area(square), rel=2e-3)


@given(st.floats(2.0, 12.0), st.floats(0.1, 0.9), st.floats(-50, 50))
def test_stripes_cover_their_share(period: float, part: float, phase: float) -> None:
    """Stripes cover width over period of the ground in the long run, and never less than none or more than all."""
    cover = stripes(np.arange(4000) + phase, period, part * period)
    assert cover.min() > -1e-5
    assert cover.max() < 1 + 1e-5
    assert cover.mean() == pytest.approx(part, abs=0.01)


def test_every_kind_is_allotted() -> None:
    """Each kind gets a piece where pieces suffice, however small its share."""
    kinds = allot(stream(0, "use"), [100.0, 90.0, 5.0, 4.0], {"a": 0.9, "b": 0.09, "c": 0.01})
    assert set(kinds) == {"a", "b", "c"}
    assert len(allot(stream(0, "use"), [3.0], {"a": 0.5, "b": 0.5})) == 1


def test_noise_has_the_stated_size() -> None:
    """Smooth noise has mean 0 and sd 1, and neighbours within a bump agree."""
    field = smooth_noise(stream(0, "noise"), (400, 500), 5)
    assert abs(field.mean()) < 0.1
    assert field.std() == pytest.approx(1, abs=0.1)
    assert np.corrcoef(field[:, 1:].ravel(), field[:, :-1].ravel())[0, 1] > 0.9


WINDOW = 128


@pytest.fixture(scope="module")
def survey(farms: list[RasterScene]) -> tuple[FarmPlan, NDArray[np.float32]]:
    """A farm's plan in June and what the near infrared shows of it, (y, x)."""
    scene = farms[1]
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

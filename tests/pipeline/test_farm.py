"""The built-in farm: a law that gives the same scene for the same seed, and scenes that are worth a second look."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.errors import SceneError, WavelengthError
from pipeline.geometry.camera import LineCamera, look
from pipeline.simulator.farm import FARM_LAW, farm_scene
from pipeline.simulator.farm_layout import (
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
from pipeline.simulator.scene import RasterScene
from pipeline.simulator.spectra import MATERIALS

LAW_COUNTS = [39, 33659, 20392, 10924, 8585, 0, 3951, 2194, 443, 745, 988]
LAW_ELECTRONS = [
    2881.7,
    1270.1,
    3441.8,
    279.3,
    3203.2,
    1457.2,
    1531.7,
    1975.0,
    1863.9,
    1162.9,
    1363.1,
    1796.9,
    1637.6,
    1610.1,
    1390.9,
    1512.8,
    1493.8,
    1167.3,
    1373.6,
    3329.6,
    81.4,
]
LAW_MEANS = [
    0.05551,
    0.04646,
    0.00378,
    0.00853,
    0.0,
    0.20707,
    0.10786,
    0.14145,
    0.05958,
    0.07342,
    0.02738,
    0.01091,
    0.0078,
    0.00038,
    0.02454,
    0.01661,
    0.00934,
    0.06454,
    0.02233,
    0.00369,
    0.10882,
]


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


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**40), st.integers(1, 90), st.integers(1, 90))
def test_abundances_are_shares(seed: int, height: int, width: int) -> None:
    """Abundances of any seed and size are non-negative and sum to 1, and every pixel has a known class."""
    scene = farm_scene(seed, (height, width), bands=2)
    assert scene.planes.shape == (height, width, len(MATERIALS))
    assert scene.planes.dtype == np.float32
    assert scene.planes.min() >= 0
    np.testing.assert_allclose(scene.planes.sum(axis=-1), 1, atol=1e-6)
    assert labels_of(scene).max() < len(scene.class_names)


@pytest.mark.parametrize("shape", [(1, 1), (16, 16), (300, 517), (1, 900), (700, 3)])
def test_any_size(shape: tuple[int, int]) -> None:
    """Sizes that divide by nothing work, down to one pixel."""
    scene = farm_scene(5, shape, bands=2)
    assert scene.shape == shape
    assert np.isfinite(scene.planes).all()


def test_same_seed_same_farm() -> None:
    """One seed gives one scene, bit for bit; the global generator plays no part."""
    first = farm_scene(11, (120, 150), bands=5)
    np.random.seed(1)  # noqa: NPY002 - the point of the test
    second = farm_scene(11, (120, 150), bands=5)
    assert first.key == second.key
    np.testing.assert_array_equal(first.planes, second.planes)
    np.testing.assert_array_equal(first.labels, second.labels)


def test_seeds_differ() -> None:
    """Another seed is another farm."""
    first, second = farm_scene(0, (200, 200), bands=2), farm_scene(1, (200, 200), bands=2)
    assert np.mean(labels_of(first) != labels_of(second)) > 0.3
    assert first.key != second.key


def test_bands_do_not_move_the_farm() -> None:
    """The layout does not depend on the bands."""
    few, many = farm_scene(3, (90, 70), bands=2), farm_scene(3, (90, 70), bands=31)
    np.testing.assert_array_equal(few.planes, many.planes)
    assert many.electrons.shape == (len(MATERIALS), 31)


def test_key_tells_the_law() -> None:
    """The key names law, seed, shape, bands and what the camera changes."""
    key = farm_scene(42, (20, 30), bands=7).key
    assert key.startswith(FARM_LAW)
    for part in ("seed=42", "shape=20x30", "bands=7"):
        assert part in key
    assert farm_scene(42, (20, 30), bands=7, camera=LineCamera(electrons_per_dn=3.0)).key != key


def test_law_is_frozen() -> None:
    """The law gives the farm it gave when it was named; a change of the drawing needs a new FARM_LAW."""
    scene = farm_scene(7, (256, 320), bands=2)
    assert FARM_LAW == "farm@1"
    np.testing.assert_allclose(class_counts(scene), LAW_COUNTS, atol=8)
    np.testing.assert_allclose(scene.planes.mean(axis=(0, 1)), LAW_MEANS, atol=2e-4)
    np.testing.assert_allclose(farm_scene(7, (8, 8), bands=5).electrons.mean(axis=1), LAW_ELECTRONS, rtol=1e-3)


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
    """Labels at a quarter of the resolution are wrong somewhere in a third of the seats, and right in most of them."""
    for farm in farms:
        blocks = labels_of(farm).reshape(256, 4, 320, 4).transpose(0, 2, 1, 3).reshape(256, 320, 16)
        counts = np.stack([(blocks == number).sum(axis=-1) for number in range(len(farm.class_names))], axis=-1)
        wrong = (16 - counts.max(axis=-1)).reshape(64, 4, 80, 4).sum(axis=(1, 3)) / 256
        assert 0.2 < (wrong > 0.05).mean() < 0.45
        assert np.sort(wrong.ravel())[-1024:].sum() > 0.6 * wrong.sum()


def test_edges_are_mixed_pixels(farms: list[RasterScene]) -> None:
    """Water's pixels at the shore hold a part of it, not all or nothing."""
    water = farms[0].planes[..., MATERIALS.index("water")]
    part = (water > 0.15) & (water < 0.75)
    assert 0.1 < part.sum() / (water > 0.15).sum() < 0.8


def twin_accuracy(scene: RasterScene, bands: NDArray[np.intp]) -> float:
    """Accuracy of Fisher's discriminant between the twins on one look's pixels, fitted on every other one."""
    electrons = scene.planes[256:576, 320:960] @ scene.electrons[:, bands]
    seen = look(electrons, LineCamera(), step=1, rng=np.random.default_rng(0)).reshape(-1, len(bands))
    labels = labels_of(scene)[256:576, 320:960].ravel()
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
    scene = farm_scene(3, bands=68)
    colour = np.array([np.abs(scene.wavelength_nm - nm).argmin() for nm in (640, 550, 460)])
    assert twin_accuracy(scene, np.arange(68)) > 0.72
    assert twin_accuracy(scene, colour) < 0.62


@pytest.mark.parametrize(("seed", "shape"), [(-1, (8, 8)), (0, (0, 8))])
def test_impossible_farms_are_refused(seed: int, shape: tuple[int, int]) -> None:
    """A negative seed or an empty shape is refused with what came."""
    with pytest.raises(SceneError, match=rf"got seed {seed}, shape"):
        farm_scene(seed, shape)


def test_one_band_is_refused() -> None:
    """A farm in one band is refused."""
    with pytest.raises(WavelengthError, match="at least 2 bands"):
        farm_scene(0, (8, 8), bands=1)


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

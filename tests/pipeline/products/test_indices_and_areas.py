"""Products of maps: spectral indices worked out by hand, bands by wavelength, refusals, and areas with errors."""

from __future__ import annotations

import numpy as np
import pytest

from spectralzoom.models.evaluation.metrics import stratified_fractions
from spectralzoom.pipeline.errors import SettingsError, WavelengthError
from spectralzoom.pipeline.products.indices import find_index, index_values, pick_bands, white_level

FINE_NM = np.arange(400.0, 1000.0, 5.0)


@pytest.mark.parametrize(
    ("name", "nm", "value"),
    [
        ("NDVI", {835: 0.5, 665: 0.1}, 0.4 / 0.6),
        ("MCARI", {700: 0.2, 670: 0.1, 550: 0.15}, (0.1 - 0.2 * 0.05) * 2),
        ("SAVI", {835: 0.5, 665: 0.1}, 1.5 * 0.4 / 1.1),
        ("gndvi", {835: 0.5, 560: 0.2}, 0.3 / 0.7),
    ],
)
def test_an_index_is_its_papers_formula_of_the_nearest_bands(name: str, nm: dict[float, float], value: float) -> None:
    """The values are worked out by hand. Every other band of the cube holds 0.9, which would change the result."""
    index = find_index(name)
    cube = np.full((1, 2, len(FINE_NM)), 0.9)
    for centre, level in nm.items():
        cube[..., centre == FINE_NM] = level
    bands = list(pick_bands(index, FINE_NM))
    np.testing.assert_allclose(index_values(index, cube[..., bands], FINE_NM[bands].tolist()), value, rtol=1e-6)


def test_dark_missing_and_divided_by_zero_pixels_are_nan() -> None:
    """Dark pixels have a mean of their bands below 1 % of white."""
    index = find_index("MCARI")  # divides by red
    cube = np.array([[[0.2, 0.1, 0.1], [0.01, 0.005, 0.01], [0.2, np.nan, 0.1], [0.2, 0.0, 0.1]]])
    assert np.isnan(index_values(index, cube, [700, 670, 550])).tolist() == [[False, True, True, True]]
    scaled = index_values(find_index("NDVI"), 100 * cube[..., :2], [835, 665], white=100.0)
    np.testing.assert_array_equal(scaled, index_values(find_index("NDVI"), cube[..., :2], [835, 665]))


def test_a_cube_without_a_required_band_is_refused() -> None:
    """The message names the missing band's range and the cube's wavelengths."""
    with pytest.raises(WavelengthError, match=r"NDVI wants .*760 to 900 nm, .*at 460, 550, 640 nm; leave NDVI out"):
        pick_bands(find_index("NDVI"), [460, 550, 640])
    assert pick_bands(find_index("MCARI"), [550, 667, 690, 712]) == (3, 1, 0)  # 690 is nearer, but no red edge


@pytest.mark.parametrize(
    ("name", "words"),
    [("NDVY", "like it: .*NDVI"), ("kNDVI", "needs kNN, which no camera gives"), ("RFDI", "which no camera gives")],
)
def test_indices_that_a_camera_cannot_give_are_refused(name: str, words: str) -> None:
    """Unknown names come with similar ones, radar and kernel indices with their requirements."""
    with pytest.raises(SettingsError, match=words):
        find_index(name)


def test_an_index_of_ratios_needs_no_reflectance() -> None:
    """The formula decides whether an index needs reflectance. The white level of a cube shows whether it has it."""
    assert not any(find_index(name).wants_reflectance for name in ("NDVI", "GNDVI"))
    assert all(find_index(name).wants_reflectance for name in ("SAVI", "EVI", "MCARI"))
    assert white_level(np.linspace(0, 1.2, 500)) == 1.0
    assert white_level(np.linspace(0, 255, 500)) > 250
    assert white_level(np.full(4, np.nan)) == 1.0
    assert white_level(np.linspace(0, 0.01, 500)) < 0.01  # radiance


# Olofsson et al. 2014, table 8: rows are mapped classes there, columns reference classes
EXAMPLE = np.array([[66, 0, 5, 4], [0, 55, 8, 12], [1, 0, 153, 11], [2, 1, 9, 313]])
MAPPED = np.array([200_000, 150_000, 3_200_000, 6_450_000]) / 1e7
HECTARES_A_PIXEL = 0.09


def test_stratified_area_estimate_equals_the_paper() -> None:
    """Deforestation is 21158 ha with a 95 % interval of 6158 ha, as printed in the paper."""
    fractions, errors = stratified_fractions(MAPPED, EXAMPLE.T)
    hectares, intervals = fractions * 1e7 * HECTARES_A_PIXEL, 1.96 * errors * 1e7 * HECTARES_A_PIXEL
    assert hectares[0] == pytest.approx(21_158, abs=1)
    assert intervals[0] == pytest.approx(6_158, abs=2)
    assert hectares.sum() == pytest.approx(900_000)


def test_a_mapped_class_with_one_reference_pixel_has_no_estimate() -> None:
    """One pixel has no variance for an error estimate. A class that is not mapped needs none."""
    counts = np.array([[8, 1], [2, 0]])
    for estimate in stratified_fractions([0.9, 0.1], counts):
        assert np.isnan(estimate).all()
    fractions, errors = stratified_fractions([1.0, 0.0], counts)
    np.testing.assert_allclose(fractions, [0.8, 0.2])
    np.testing.assert_allclose(errors, np.sqrt(0.8 * 0.2 / 9))

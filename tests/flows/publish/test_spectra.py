"""Mean spectra of classes, and curves with gaps at removed bands."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flows.publish.panels import class_spectra, curve_with_gaps, draw_spectra
from pipeline.signal.components import Components
from storage.arrays.class_maps import ClassMap
from storage.arrays.mosaics import Mosaic, MosaicWriter, open_mosaic

AVIRIS = 400 + 10.0 * np.arange(220)


def small_mosaic(path: Path, bands: int = 8) -> Mosaic:
    """Return a mosaic of two by two pixels with one component that is 1 in every band; the last pixel is nodata."""
    law = Components(np.full(bands, 5.0), np.full((1, bands), 1.0), np.ones(bands))
    writer = MosaicWriter(path, (2, 2), law, 400 + 10.0 * np.arange(bands))
    scores = np.array([[[1.0], [3.0]], [[7.0], [np.nan]]], np.float32)
    writer.write_rows(0, scores, np.array([[True, True], [True, False]]))
    return open_mosaic(path)


def test_a_class_has_the_mean_spectrum_of_its_pixels(tmp_path: Path) -> None:
    """Values by hand: scores 1 and 3 of class 0, 7 of class 1, plus a mean of 5; class 2 has no valid pixel."""
    spectra = class_spectra(small_mosaic(tmp_path / "mosaic.zarr"), np.array([[0, 0], [1, 2]], np.uint8), 3)
    assert spectra[0].tolist() == [7.0] * 8
    assert spectra[1].tolist() == [12.0] * 8
    assert np.isnan(spectra[2]).all()


@pytest.mark.parametrize(
    ("removed_nm", "ends_nm"),
    [
        ([800], [(790, 810)]),
        (range(1430, 1480, 10), [(1420, 1480)]),
        ([*range(1430, 1480, 10), *range(1890, 2030, 10)], [(1420, 1480), (1880, 2030)]),
    ],
)
def test_a_curve_has_a_gap_at_removed_bands(removed_nm: list[int], ends_nm: list[tuple[int, int]]) -> None:
    """Each run of removed bands has one gap, between its two neighbours, in any order of bands."""
    kept = np.setdiff1d(AVIRIS, removed_nm)
    nm, curve = curve_with_gaps(kept[::-1], 2 * kept[::-1])
    (gaps,) = np.nonzero(np.isnan(nm))
    assert [(nm[gap - 1], nm[gap + 1]) for gap in gaps] == ends_nm
    assert np.array_equal(curve, 2 * nm, equal_nan=True)


@pytest.mark.parametrize(
    "wavelength_nm",
    [
        [443, 490, 560, 665, 705, 740, 783, 842, 865, 945, 1375, 1610, 2190],  # Sentinel-2
        [*np.arange(420, 900, 6.5), *np.arange(900, 2400, 11.0)],  # two detectors
        [480, 550, 650, 730, 840],
    ],
)
def test_a_curve_of_unevenly_spaced_bands_has_no_gap(wavelength_nm: list[float]) -> None:
    """A satellite's bands are far apart by design, and a second detector has wider bands."""
    nm, _ = curve_with_gaps(np.array(wavelength_nm), np.ones(len(wavelength_nm)))
    assert np.isfinite(nm).all()


def test_few_bands_have_no_curve(tmp_path: Path) -> None:
    """Three bands have no picture of spectra, eight bands have one."""
    found = ClassMap(
        np.zeros((2, 2), np.uint8), np.ones((2, 2), np.float32), ("soil",), np.array([[120, 80, 40]], np.uint8)
    )
    assert draw_spectra(small_mosaic(tmp_path / "three.zarr", 3), found) is None
    drawn = draw_spectra(small_mosaic(tmp_path / "eight.zarr"), found)
    assert drawn is not None
    with Image.open(io.BytesIO(drawn)) as picture:
        assert picture.size[0] > 600

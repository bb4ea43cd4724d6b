"""Bands leave the product by rising wavelength, with the detector that saw them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray

from spectralzoom.pipeline.signal.components import Components
from spectralzoom.spectra import open_lazy_mosaic
from spectralzoom.storage.arrays.band_order import sort_bands
from spectralzoom.storage.arrays.mosaics import MosaicWriter

VNIR_SWIR = [400, 600, 800, 1000, 960, 1000, 1400, 1800]


@pytest.mark.parametrize(
    ("wavelengths", "detectors"),
    [
        ([450, 550, 650], [0, 0, 0]),
        ([650, 550, 450], [0, 0, 0]),
        (VNIR_SWIR, [0, 0, 0, 1, 0, 1, 1, 1]),
        (VNIR_SWIR[::-1], [1, 1, 1, 0, 0, 1, 0, 0]),
        ([1400, 1800, 400, 600], [0, 0, 0, 0]),  # no two overlap
        ([640, 550, 460, 800], [0, 0, 0, 0]),  # red, green, blue and near infrared
        ([400, 550, 550, 700], [0, 0, 1, 1]),
        ([500], [0]),
    ],
)
def test_bands_of_overlapping_detectors_alternate(wavelengths: list[float], detectors: list[int]) -> None:
    """Wavelengths rise strictly, by less than a picometre where two are equal."""
    found = sort_bands(wavelengths)
    assert found.wavelength_nm.round(6).tolist() == [wavelengths[band] for band in found.order]
    assert (np.diff(found.wavelength_nm) > 0).all()
    assert found.detector.tolist() == detectors


def test_a_mosaic_of_two_detectors_is_selected_by_wavelength(tmp_path: Path) -> None:
    """Nearest and slices work on the opened cube and on its NetCDF copy; both bands of one wavelength stay."""
    bands = len(VNIR_SWIR)
    components = Components(np.arange(bands) * 1.0, np.eye(bands)[:1], np.ones(bands))
    writer = MosaicWriter(tmp_path / "mosaic.zarr", (4, 5), components, np.array(VNIR_SWIR, float), largest=9)
    writer.write_rows(0, np.zeros((4, 5, 1), np.float32), np.ones((4, 5), np.bool_))
    cube = open_lazy_mosaic(tmp_path / "mosaic.zarr")
    cube.to_dataset(name="values").to_netcdf(tmp_path / "copy.nc", engine="h5netcdf")
    with xarray.open_dataset(tmp_path / "copy.nc", engine="h5netcdf") as copy:
        for one in (cube.load(), copy["values"].set_xindex("wavelength")):
            assert one.sel(wavelength=970, method="nearest")[0, 0] == VNIR_SWIR.index(960)
            assert one.sel(band=1100, method="nearest")[0, 0] == 5
            assert one.sel(wavelength=slice(900, 1100))[0, 0].values.tolist() == [4, 3, 5]
            assert one.where(one.detector == 1, drop=True).wavelength.values.round(6).tolist() == [
                960,
                1000,
                1400,
                1800,
            ]

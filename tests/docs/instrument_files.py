"""Write small files for the pages on products, in the layouts of NEON, PRISMA and PACE, and on drones."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from affine import Affine

from tests.conftest import patchy_scene
from tests.users.test_georeference import NORTH_UP, write_geotiff
from tests.users.test_recorded_sweeps import write_pushbroom

PRISMA_FIELDS = "HDFEOS/SWATHS/PRS_L2D_HCO/Data Fields"


def write_instrument_files(folder: Path) -> None:
    """Write neon.h5, prisma.he5 and pace.nc with 6 x 5 px."""
    rng = np.random.default_rng(2)
    with h5py.File(folder / "neon.h5", "w") as file:
        site = file.create_group("ABBY/Reflectance")
        data = site.create_dataset("Reflectance_Data", data=rng.integers(0, 9000, (6, 5, 4)).astype(np.int16))
        data.attrs.update({"Scale_Factor": 10000.0, "Data_Ignore_Value": -9999.0})
        site["Metadata/Spectral_Data/Wavelength"] = np.array([450.0, 550.0, 660.0, 800.0])
        site["Metadata/Spectral_Data/FWHM"] = np.full(4, 5.0)
        info = "UTM,  1.000,  1.000,  552000.00,  5075000.0,  1.0,  1.0,  10,  North,  WGS-84,  units=Meters, 0"
        site["Metadata/Coordinate_System/Map_Info"] = np.bytes_(info)
        site["Metadata/Coordinate_System/EPSG Code"] = np.bytes_("32610")
    with h5py.File(folder / "prisma.he5", "w") as file:
        centres = {"Vnir": [0.0, 980.0, 700.0, 450.0], "Swir": [2400.0, 1600.0, 950.0]}  # the first is empty
        for name, nm in centres.items():
            cube = rng.integers(0, 65535, (6, len(nm), 5)).astype(np.uint16)
            file[f"{PRISMA_FIELDS}/{name.upper()}_Cube"] = cube
            about = {f"List_Cw_{name}": nm, f"List_Fwhm_{name}": [10.0] * len(nm)}
            file.attrs.update({**about, f"L2Scale{name}Min": 0.0, f"L2Scale{name}Max": 1.0})
        corner = {"Product_ULcorner_easting": 500015.0, "Product_ULcorner_northing": 4999985.0}
        file.attrs.update({**corner, "Epsg_Code": np.uint32(32632)})
    with h5py.File(folder / "pace.nc", "w") as file:
        bands = file.create_dataset("sensor_band_parameters/wavelength_3d", data=np.array([450.0, 550.0, 800.0]))
        bands.attrs["units"] = "nm"
        values = file.create_dataset("geophysical_data/rhos", data=rng.integers(0, 9000, (6, 5, 3)).astype(np.int16))
        values.attrs.update({"scale_factor": np.float32(2e-4), "add_offset": np.float32(0), "_FillValue": np.int16(-1)})
        for axis, name in enumerate(("number_of_lines", "pixels_per_line", "wavelength_3d")):
            values.dims[axis].label = name


def write_drone_files(folder: Path) -> None:
    """Write two georeferenced tiles into flight, and a strip of raw lines with its pointing into lines."""
    (folder / "flight").mkdir()
    for number in (1, 2):
        write_geotiff(folder / f"flight/tile_{number}.tif", NORTH_UP * Affine.translation(70 * number, 0))
    values = (patchy_scene((48, 40), 3, seed=5)[0] * 12 + 60).astype(np.uint16)
    write_pushbroom(folder / "lines", values)
    for file in sorted((folder / "lines").iterdir()):
        file.rename(file.with_name(file.name.replace("scan", "strip")))
    rows = [f"{0.05 * line:g},{0.02 * line + 0.01:g}" for line in range(48)]
    (folder / "lines" / "strip.pointing.csv").write_text("\n".join(["position_m,time", *rows]) + "\n")

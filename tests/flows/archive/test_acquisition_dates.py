"""The date of acquisition of a survey: from file or visit into receipt, name, export and age of the prior map."""

from __future__ import annotations

import io
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pystac
import pytest
import rasterio
import xarray
from PIL import Image
from rich.console import Console

from spectralzoom.flows.archive.export_command import run_export
from spectralzoom.flows.opening.recorded_field import open_recorded
from spectralzoom.flows.opening.visit import at_due_time
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.storage.readers.open_cubes import open_cube
from tests.conftest import QUIET
from tests.storage.readers.test_envi_cubes import write_envi
from tests.users.test_georeference import NORTH_UP, PIXELS, write_geotiff


def survey(folder: Path, weights: Path, taken: str, **flags: Any) -> Published:
    """Survey a GeoTIFF whose tags say when it was taken, as a raster of the field north."""
    scene = write_geotiff(folder / "tile.tif", NORTH_UP)
    with rasterio.open(scene, "r+") as file:
        file.update_tags(TIFFTAG_DATETIME=taken)
    asked = {"scene": str(scene), "weights": str(weights), "out": str(folder / "archive"), "name": "north"}
    given = {"source": "raster", "engine": "plain", "accuracy": False, "prior": "latest"}
    return run_survey(load_settings(None, asked | given | flags), QUIET)


def item_of(folder: Path) -> dict[str, Any]:
    """Export the latest run, and return the properties of its item."""
    done = run_export(folder / "archive", None, folder / "out", console=QUIET)
    pystac.Item.from_file(done["item"])
    found: dict[str, Any] = json.loads(Path(done["item"]).read_text())["properties"]
    return found


def test_the_date_of_a_file_is_kept_beside_the_day_of_processing(tmp_path: Path, weights: Path) -> None:
    """Tiles of two dates that are processed on one day are seven days apart."""
    survey(tmp_path, weights, "2022:07:01 10:11:12")
    later = survey(tmp_path, weights, "2022:07:08 10:11:12")
    assert later.receipt["acquired"] == "2022-07-08T10:11:12Z"
    assert later.receipt["prior_map"]["days"] == 7
    assert later.folder.name.endswith("-north-20220708")
    about = item_of(tmp_path)
    assert about["datetime"] == about["start_datetime"] == about["end_datetime"] == "2022-07-08T10:11:12Z"
    assert about["created"] == later.receipt["finished"]
    with rasterio.open(next(tmp_path.rglob("*-north-*/class_map.tif"))) as file:
        assert file.tags()["ACQUISITIONDATETIME"] == "2022-07-08T10:11:12+00:00"
        assert file.tags()["processed"] == later.receipt["finished"]


def test_a_file_without_a_date_gives_images_none(tmp_path: Path, weights: Path) -> None:
    """The item has the time of the survey, and a note says so."""
    run, console = survey(tmp_path, weights, ""), Console(file=io.StringIO(), width=200)
    done = run_export(tmp_path / "archive", None, tmp_path / "out", console=console)
    assert "its items have the day of the survey" in console.file.getvalue()
    assert json.loads(Path(done["item"]).read_text())["properties"]["datetime"] == run.receipt["started"]
    with rasterio.open(tmp_path / "out" / done["files"]["class_map"]) as file:
        assert "ACQUISITIONDATETIME" not in file.tags()


@pytest.mark.parametrize(
    ("visit", "day", "note"),
    [("first of July", "2022-07-01", "read as UTC"), ("2021-05-06", "2021-05-06", "--visit 2021-05-06 is kept")],
)
def test_a_stated_date_wins_over_the_file(tmp_path: Path, weights: Path, visit: str, day: str, note: str) -> None:
    """A visit without a date leaves that of the file."""
    run = survey(tmp_path, weights, "2022:07:01 10:11:12", visit=visit)
    assert run.receipt["acquired"][:10] == day
    assert note in " ".join(run.receipt["settings"]["notes"])
    about = item_of(tmp_path)
    assert [about[name][:10] for name in ("datetime", "end_datetime")] == [day, day]


def envi(folder: Path) -> Path:
    told = {"acquisition_date": "DATE(yyyy-mm-dd): 2022-07-01", "start_time": "UTC TIME: 10:11:12"}
    write_envi(folder / "a.img", PIXELS, "bil", wavelength_units="nm", wavelength="{640, 550, 460}", **told)
    return folder / "a.hdr"


def picture(folder: Path) -> Path:
    exif = Image.Exif()
    exif[0x0132] = "2024:01:01 00:00:00"  # a program changed the file
    exif.get_ifd(0x8769).update({0x9003: "2022:07:01 12:11:12", 0x9011: "+02:00"})
    Image.fromarray(PIXELS).save(folder / "a.jpg", exif=exif)
    return folder / "a.jpg"


def dated(folder: Path) -> Path:
    told = {"wavelength_units": "nm", "wavelength": "{640, 550, 460}", "date": "2022-07-01", "time": "10:11:12"}
    write_envi(folder / "a.img", PIXELS, "bil", **told)
    return folder / "a.hdr"


def png(folder: Path) -> Path:
    exif = Image.Exif()
    exif[0x0132] = "2024:01:01 00:00:00"
    exif.get_ifd(0x8769)[0x9003] = "2022:07:01 10:11:12"
    Image.fromarray(PIXELS).save(folder / "a.png", exif=exif)
    return folder / "a.png"


def netcdf(folder: Path) -> Path:
    about = {"time_coverage_start": "2022-07-01T10:11:12Z", "date_created": "2024-01-01"}
    bands = ("band", np.array([640.0, 550.0, 460.0]), {"units": "nm"})
    cube = xarray.Dataset({"cube": (("y", "x", "band"), PIXELS)}, {"wavelength": bands}, about)
    cube.to_netcdf(folder / "a.nc", engine="h5netcdf")
    return folder / "a.nc"


def netcdf_with_time(folder: Path) -> Path:
    time = np.datetime64("2022-07-01T10:11:12", "ns")
    with xarray.open_dataset(netcdf(folder)) as opened:
        opened.drop_attrs().assign_coords(time=time).to_netcdf(folder / "b.nc", engine="h5netcdf")
    return folder / "b.nc"


@pytest.mark.parametrize("write", [envi, dated, picture, png, netcdf, netcdf_with_time])
def test_readers_find_the_date(tmp_path: Path, write: Any) -> None:
    """The kinds of files give the same moment, and none the day on which the file was made."""
    assert open_cube(write(tmp_path)).attrs["acquired"] == "2022-07-01T10:11:12Z"


@pytest.mark.parametrize(
    ("units", "calendar"),
    [("days since 2019-02-25", "noleap"), ("seconds since sensor start", "standard"), ("months since 2019-01-01", "")],
)
def test_a_time_that_cannot_be_read_is_no_date(tmp_path: Path, units: str, calendar: str) -> None:
    """The cube is read; a note names units and calendar."""
    with xarray.open_dataset(netcdf(tmp_path)) as opened:
        cube = opened.drop_attrs().assign_coords(time=((), 5.0, {"units": units, "calendar": calendar}))
        cube.to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    found = open_cube(tmp_path / "b.nc")
    assert found.attrs.get("acquired") is None
    assert any(f"time in '{units} {calendar}" in note for note in found.attrs["notes"])


@pytest.mark.parametrize(
    ("flags", "visit"),
    [
        ({"source": "raster"}, "2022-07-01T10:11:12Z"),
        ({"source": "raster", "visit": "mine"}, "mine"),
        ({"source": "sim"}, "2026-06-01T12:00:00Z"),
    ],
)
def test_a_scheduled_raster_has_the_date_of_its_file(tmp_path: Path, flags: dict[str, str], visit: str) -> None:
    """The due time is that of the processing; a stated visit is kept, and a simulated capture has its due time."""
    settings = load_settings(None, {"scene": str(envi(tmp_path)), **flags})
    assert at_due_time(settings, datetime(2026, 6, 1, 12, tzinfo=UTC)).visit == visit


def test_two_cubes_of_a_recording_have_the_date_of_the_first(tmp_path: Path) -> None:
    """Runs of sweeps have the date in the headers of their files."""
    for number, day in enumerate(("2022-07-02", "2022-07-01")):
        told = {"wavelength_units": "nm", "wavelength": "{640, 550, 460}", "acquisition_date": day}
        write_envi(tmp_path / f"{number}.img", PIXELS.astype(np.uint16), "bil", **told)
        rows = "".join(f"{(line - 25) / 3000},0\n" for line in range(len(PIXELS)))
        (tmp_path / f"{number}.pointing.csv").write_text(f"mirror_x,mirror_y\n{rows}")
    _, recording = open_recorded(load_settings(None, {"sweeps": str(tmp_path), "size": "8x8"}))
    assert recording.acquired == "2022-07-01"

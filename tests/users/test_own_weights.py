"""Surveys by weights that were trained on the user's tiles: notes on training scenes and on bands."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pandas as pd
import pytest
import rasterio
import rioxarray  # noqa: F401 - registers the accessor that users have
import xarray as xr
from rasterio.transform import from_origin

from spectralzoom import open as open_archive
from spectralzoom.flows.cli.main import main
from spectralzoom.models.weights.files import describe_weights
from tests.flows.conftest import command_line
from tests.storage.readers.test_raster_tags import write

__all__ = ["command_line"]

SENTINEL_NM = (443, 490, 560, 665, 705, 740, 783, 842, 865, 945, 1375, 1610, 2190)  # none between 1610 and 2190
SIDE = 32
NUMBERS = np.array([3, 7, 200], np.uint8)  # of the classes in the label files
SMALL = ["--steps", "2"]
PLAIN = ["--engine", "plain"]


def write_tile(folder: Path, number: int) -> None:
    """Write a tile of three classes in 13 bands with its labels; tiles lie side by side by number."""
    rng = np.random.default_rng(number)
    labels = (np.add.outer(np.arange(SIDE) + 3 * number, np.arange(SIDE)) // 8 % 3).astype(np.uint8)
    spectra = np.stack([np.linspace(300, 3000, 13), np.linspace(2500, 500, 13), 1500 + 500 * np.sin(np.arange(13))])
    values = (spectra[labels] + rng.normal(0, 30, (SIDE, SIDE, 13))).astype(np.uint16)
    place = {"crs": "EPSG:32633", "transform": from_origin(5e5 + 10 * SIDE * number, 5e6, 10, 10)}
    with write(folder / "images" / f"t{number}.tif", np.moveaxis(values, 2, 0), **place) as file:
        for band, centre in enumerate(SENTINEL_NM, 1):
            file.update_tags(band, wavelength=str(centre), wavelength_units="nm")
    write(folder / "labels" / f"t{number}.tif", NUMBERS[labels][None], **place).close()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with five tiles and weights of t0 to t3; t0 judged the network, t4 was held out."""
    here = tmp_path_factory.mktemp("tiles")
    for name in ("images", "labels"):
        (here / "field" / name).mkdir(parents=True)
    for number in range(5):
        write_tile(here / "field", number)
    words = ["train", here / "field", "-o", here / "w.safetensors", "--validation", "1", "--hold-out", "4"]
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words), "--min-exposure-ms", "3", *SMALL])
    assert not ended.value.code
    assert list(describe_weights(here / "w.safetensors").record["split"]["validation"]) == ["0"]
    return here


def survey(command_line: Any, made: Path, scene: object, out: Path, *words: str) -> tuple[str, dict[str, Any]]:
    """Survey a scene; return the terminal's output as one line, and the receipt."""
    ended = command_line("survey", "--scene", scene, "--weights", made / "w.safetensors", "--out", out, *PLAIN, *words)
    assert ended.code == 0, ended.err
    folder = open_archive(out).latest.folder
    return " ".join((ended.out + ended.err).split()), json.loads((folder / "receipt.json").read_text())


def test_a_training_scene_and_lacking_bands_are_marked(made: Path, tmp_path: Path, command_line: Any) -> None:
    """Terminal, report, receipt and `ls` mark the score of a training scene, and not that of a scene held out.

    The scene is recognized by its content: it has another file name and fewer bands here. A note counts only spectral
    features that training reached; a survey of fewer bands brings it, and one of all bands does not.
    """
    scene = tmp_path / "other name.tif"
    shutil.copy(made / "field" / "images" / "t1.tif", scene)
    labels = ["--labels", str(made / "field" / "labels" / "t1.tif")]
    said, receipt = survey(command_line, made, scene, tmp_path / "a", *labels, "--bands", "0-8")
    sentence = "of 100 against the labels on a training scene (not valid for other fields) ("
    assert sentence in said
    assert "the bands cover 5 of the weights' 12 spectral features" in said
    assert receipt["training_scene"] == "all"
    assert sentence in (open_archive(tmp_path / "a").latest.folder / "report.html").read_text()
    assert "* on a scene that the weights were trained on" in command_line("ls", tmp_path / "a").out
    said, receipt = survey(command_line, made, made / "field" / "images" / "t4.tif", tmp_path / "b")
    assert "of 100 against the labels (" in said
    assert "spectral features" not in said
    assert "training_scene" not in receipt
    assert "*" not in command_line("ls", tmp_path / "b").out


def test_maps_and_exports_have_the_numbers_of_the_label_files(made: Path, tmp_path: Path, command_line: Any) -> None:
    """The GeoTIFF compares with the label file pixel by pixel; legend, areas, polygons and Python have its numbers."""
    survey(command_line, made, made / "field" / "images" / "t0.tif", tmp_path / "a")
    ended = command_line("export", tmp_path / "a", "-o", tmp_path / "maps", "--polygons")
    assert ended.code == 0, ended.err
    run = open_archive(tmp_path / "a").latest
    with rasterio.open(tmp_path / "maps" / run.folder.name / "class_map.tif") as file:
        drawn, tags, colours = file.read(1), file.tags(1), file.colormap(1)
    with rasterio.open(made / "field" / "labels" / "t0.tif") as file:
        assert (file.read(1) == drawn).mean() > 0.8
    assert {name: tags[name] for name in tags if name.startswith("CLASS")} == {
        f"CLASS_{n}": f"class_{n}" for n in (3, 7, 200)
    }
    table = pd.read_csv(tmp_path / "maps" / run.folder.name / "areas.csv")
    assert dict(zip(table["class"], table["value"], strict=True)) == {f"class_{n}": n for n in (3, 7, 200)}
    assert table["pixels"].tolist() == [(drawn == n).sum() for n in (3, 7, 200)]
    regions = geopandas.read_file(tmp_path / "maps" / run.folder.name / "classes.gpkg")
    assert {(n, f"class_{n}") for n in (3, 7, 200)} == set(zip(regions["class"], regions["name"], strict=True))
    assert {"#" + bytes(colours[7][:3]).hex()} == set(regions["colour"][regions["class"] == 7])
    np.testing.assert_array_equal(run.class_map, drawn)
    assert run.class_map.attrs["flag_values"] == [3, 7, 200]


def test_products_of_a_run_are_written_as_netcdf_and_zarr(made: Path, tmp_path: Path, command_line: Any) -> None:
    """Plain xarray writes every product of a georeferenced scene; rioxarray finds the CRS in the written files."""
    survey(command_line, made, made / "field" / "images" / "t0.tif", tmp_path / "a")
    run = open_archive(tmp_path / "a").latest
    run.class_map.to_netcdf(tmp_path / "map.nc")
    run.class_map.to_zarr(tmp_path / "map.zarr", consolidated=False)
    for read in (xr.open_dataset(tmp_path / "map.nc"), xr.open_zarr(tmp_path / "map.zarr", consolidated=False)):
        assert (read["classes"].rio.crs.to_epsg(), read["classes"].dtype) == (32633, np.uint8)
        np.testing.assert_array_equal(read["classes"], run.class_map)
        read.close()
    for name in run.products:
        run.dataset(name).to_netcdf(tmp_path / f"{name}.nc")
        with xr.open_dataset(tmp_path / f"{name}.nc") as read:
            assert set(read.data_vars) == set(run.dataset(name).data_vars)
    run.mosaic.to_netcdf(tmp_path / "cube.nc")
    with xr.open_dataset(tmp_path / "cube.nc") as read:
        np.testing.assert_array_equal(read["spectra"], run.mosaic)

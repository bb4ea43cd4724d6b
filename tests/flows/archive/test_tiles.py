"""Scenes of a folder or pattern: one run each, a table of all, and one map of all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray
from affine import Affine

import spectralzoom
from tests.conftest import CLASSES
from tests.users.test_georeference import NORTH_UP, PIXELS, SHAPE, write_geotiff

COLUMNS = 34  # of the western tile


def write_tiles(folder: Path, **more: Any) -> Path:
    """Write a scene and its eastern neighbour, which overlaps it by half."""
    folder.mkdir()
    write_geotiff(folder / "west.tif", NORTH_UP, **more)
    write_geotiff(folder / "east.tif", NORTH_UP * Affine.translation(COLUMNS, 0), **more)
    return folder


def survey(command_line: Any, scene: Path, weights: Path, out: Path, *more: str) -> Any:
    """Survey tiles without effects, labels or Prefect."""
    return command_line(
        *("survey", "--scene", str(scene), "--weights", str(weights), "--out", str(out), "--engine", "plain"), *more
    )


@pytest.mark.parametrize("address", ["tiles", "tiles/*.tif"])
def test_tiles_are_one_run_each_with_a_table_of_all(
    tmp_path: Path, weights: Path, command_line: Any, address: str
) -> None:
    """A damaged tile is a row with its message and decides the exit code; the others have score, time and classes."""
    (write_tiles(tmp_path / "tiles") / "broken.tif").write_bytes(b"II*\0")
    done = survey(command_line, tmp_path / address, weights, tmp_path / "out", "--json")
    assert done.code == 1
    runs = json.loads(done.out)["surveys"]
    assert [one.get("survey", "failed") for one in runs] == ["failed", "east", "west"]
    assert set(spectralzoom.open(tmp_path / "out")) == {
        one["products"]["report.html"].split("/")[1] for one in runs[1:]
    }
    rows = done.err.split("classes", 1)[1]
    assert all(word in rows for word in ("broken.tif", "failed", "west.tif", "confidence"))


def test_the_same_command_computes_no_tile_again(tmp_path: Path, weights: Path, command_line: Any) -> None:
    """Every stage of the second run of each tile is found."""
    for _ in range(2):
        done = survey(command_line, write_once(tmp_path / "tiles"), weights, tmp_path / "out", "--json")
    states = {stage["state"] for one in json.loads(done.out)["surveys"] for stage in one["stages"]}
    assert states == {"cached"}


def write_once(folder: Path) -> Path:
    """Return a folder of tiles, which is written if it is not there."""
    return folder if folder.exists() else write_tiles(folder)


def test_the_maps_of_tiles_are_merged_to_one(tmp_path: Path, weights: Path, command_line: Any) -> None:
    """The image has both maps at their places, with class names, colours and the runs in its tags."""
    assert survey(command_line, write_tiles(tmp_path / "tiles"), weights, tmp_path / "out").code == 0
    done = command_line("export", str(tmp_path / "out"), "--merge", "--out", str(tmp_path / "maps"), "--json")
    assert done.code == 0, done.err
    content = json.loads(done.out)
    west, east = (spectralzoom.open(tmp_path / "out")[name] for name in sorted(content["runs"], reverse=True))
    west, east = (west, east) if west.receipt["survey"] == "west" else (east, west)
    with rasterio.open(content["file"]) as file:
        assert (file.shape, file.crs.to_epsg()) == ((SHAPE[0], SHAPE[1] + COLUMNS), 32632)
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        classes = file.read(1)
        assert file.tags()["runs"].split(", ") == content["runs"]
        assert [file.tags(1)[f"CLASS_{number}"] for number in range(3)] == list(CLASSES)
        colours = [file.colormap(1)[number][:3] for number in range(3)]
    assert colours == [tuple(one) for one in json.loads(west.dataset("class_map").attrs["class_colours"])]
    newest_first = content["runs"][0] == west.name
    np.testing.assert_array_equal(classes[:, :COLUMNS], west.class_map.values[:, :COLUMNS])
    np.testing.assert_array_equal(classes[:, SHAPE[1] :], east.class_map.values[:, SHAPE[1] - COLUMNS :])
    on_top = west.class_map.values[:, COLUMNS:] if newest_first else east.class_map.values[:, : SHAPE[1] - COLUMNS]
    np.testing.assert_array_equal(classes[:, COLUMNS : SHAPE[1]], on_top)


def test_maps_of_two_crs_are_not_merged(tmp_path: Path, weights: Path, command_line: Any) -> None:
    """The message names the run, and both CRS."""
    write_tiles(tmp_path / "tiles")
    write_geotiff(tmp_path / "tiles" / "west.tif", NORTH_UP, crs="EPSG:32633")
    assert survey(command_line, tmp_path / "tiles", weights, tmp_path / "out").code == 0
    done = command_line("export", str(tmp_path / "out"), "--merge", "--out", str(tmp_path / "maps"))
    done.refused(2, r"-east has CRS EPSG:32632, expected EPSG:32633 as .*-west; warp the tiles")


def test_without_a_georeferenced_run_there_is_nothing_to_merge(
    surveyed_png: Any, tmp_path: Path, command_line: Any
) -> None:
    """The message says why."""
    surveyed_png(tmp_path / "out")
    done = command_line("export", str(tmp_path / "out"), "--merge", "--out", str(tmp_path / "maps"))
    done.refused(2, "has a CRS, so there is nothing to merge")


def test_a_zarr_store_is_one_scene(tmp_path: Path, weights: Path, command_line: Any) -> None:
    """Its folder is no folder of tiles."""
    xarray.Dataset({"cube": (("y", "x", "band"), PIXELS)}).to_zarr(tmp_path / "a.zarr", consolidated=False)
    done = survey(
        command_line, tmp_path / "a.zarr", weights, tmp_path / "out", "--wavelengths", "640,550,460", "--json"
    )
    assert done.code == 0, done.err
    assert json.loads(done.out)["survey"] == "a"

"""Nothing that a reader finds by itself leads out of the folder of the file that was named."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import rasterio.transform
import scipy.io
import xarray as xr
import zarr
from PIL import Image

from spectralzoom.flows.training.data import load_data_set
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.recordings import open_recording
from spectralzoom.storage.readers.scene_files import open_scene_file
from tests.envi_files import listed, write_cube
from tests.storage.readers.test_headwall_folders import write_part

CUBE = np.arange(1, 73, dtype=np.uint16).reshape(6, 4, 3)
NM = {"wavelength units": "nm", "wavelength": listed(np.array([500.0, 600.0, 700.0]))}
Opened = Callable[[], Any]


def envi(here: Path) -> Opened:
    write_cube(here / "a.hdr", CUBE, "u2", **NM)
    return lambda: open_cube_source(here / "a.hdr")


def envi_by_data(here: Path) -> Opened:
    write_cube(here / "a.hdr", CUBE, "u2", **NM)
    return lambda: open_cube_source(here / "a.img")


def headwall(here: Path) -> Opened:
    write_part(here, "raw_0", CUBE)
    (here / "frameIndex_0.txt").write_text("".join(f"{frame}\t{1000 + frame}\n" for frame in range(6)))
    for kind in ("dark", "white"):
        write_cube(here / f"{kind}Reference.hdr", CUBE[:1], "u2")
    return lambda: open_cube_source(here)


def recorded(here: Path) -> Opened:
    write_cube(here / "a.hdr", CUBE, "u2", **NM)
    for kind in ("dark", "bad"):
        np.save(here / f"a.{kind}.npy", CUBE[0].astype("f4") * 0)
    write_cube(here / "a.white.hdr", CUBE[:1], "u2")
    (here / "a.pointing.csv").write_text("position_px\n" + "".join(f"{line}\n" for line in range(6)))
    return lambda: open_recording(here)


def picture(path: Path, values: Any = 7) -> None:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.full((6, 8, 3), values, np.uint8)[..., slice(None) if values == 7 else 0]).save(path)


def labelled(here: Path) -> Opened:
    picture(here / "images" / "001.png")
    picture(here / "labels" / "001.png", 1)
    (here / "scene.toml").write_text("")
    return lambda: open_scene_file(here / "images" / "001.png")


def stated(here: Path) -> Opened:
    picture(here / "a.png")
    picture(here / "more" / "a.png", 1)
    (here / "nm.txt").write_text("640\n550\n460\n")
    (here / "scene.toml").write_text('labels = "more/a.png"\nwavelengths_file = "nm.txt"\n')
    return lambda: open_scene_file(here / "a.png")


def named_array(here: Path) -> Opened:
    picture(here / "a.png")
    scipy.io.savemat(here / "gt.mat", {"gt": np.ones((6, 8), np.uint8), "more": np.ones((3, 3))})
    (here / "scene.toml").write_text('labels = "gt.mat:gt"\n')
    return lambda: open_scene_file(here / "a.png")


def store(here: Path) -> Opened:
    zarr.create_array(here / "cube.zarr", data=CUBE)
    return lambda: open_cube_source(here)


def training(here: Path) -> Opened:
    for number in range(3):
        picture(here / "images" / f"{number}.png")
        picture(here / "labels" / f"{number}.png", 1)
    return lambda: load_data_set(here)


def image(here: Path) -> Opened:
    grid = {"transform": rasterio.transform.from_origin(4e5, 5e6, 1, 1), "crs": "EPSG:32632"}
    for name in ("a.tif", "a.tif.msk", "a.tif.ovr"):
        with rasterio.open(here / f"{name}.tif", "w", "GTiff", 8, 6, 1, dtype="uint8", **grid) as file:
            file.write(np.full((1, 6, 8), 255, np.uint8))
        (here / f"{name}.tif").rename(here / name)
    (here / "a.tfw").write_text("1\n0\n0\n-1\n400000\n5000000\n")
    (here / "a.tif.aux.xml").write_text("<PAMDataset></PAMDataset>")
    (here / "LC08_MTL.txt").write_text("GROUP = L1_METADATA_FILE\nEND\n")  # as beside LC08_B2.tif
    return lambda: open_cube_source(here / "a.tif")


LAYOUTS: dict[Callable[[Path], Opened], tuple[str, ...]] = {
    envi: ("a.img",),
    envi_by_data: ("a.hdr",),
    headwall: (
        *("raw_0.hdr", "raw_0", "frameIndex_0.txt"),
        *("darkReference.hdr", "darkReference.img", "whiteReference.hdr", "whiteReference.img"),
    ),
    recorded: ("a.hdr", "a.img", "a.dark.npy", "a.bad.npy", "a.white.hdr", "a.white.img", "a.pointing.csv"),
    labelled: ("labels/001.png", "labels", "scene.toml"),
    stated: ("more/a.png", "more", "nm.txt", "scene.toml"),
    named_array: ("gt.mat",),
    store: ("cube.zarr", "cube.zarr/zarr.json", "cube.zarr/c/0/0"),
    training: ("images/1.png", "images", "labels/1.png", "labels"),
    image: ("a.tif.msk", "a.tif.ovr", "a.tfw", "a.tif.aux.xml", "LC08_MTL.txt"),
}


@pytest.mark.parametrize(("layout", "name"), [(one, name) for one, names in LAYOUTS.items() for name in names])
def test_links_out_of_the_folder_are_refused(tmp_path: Path, layout: Callable[[Path], Opened], name: str) -> None:
    """Each file is read where it lies; as a link out of the folder it is refused, with the name of its target."""
    here = tmp_path / "here"
    here.mkdir()
    opened = layout(here)
    opened()
    moved = (tmp_path / "outside" / name).resolve()
    moved.parent.mkdir(parents=True)
    (here / name).rename(moved)
    (here / name).symlink_to(moved)
    with pytest.raises(SceneError, match=rf"is a link .*{moved}.* not followed; copy the file there"):
        opened()


def test_a_named_link_is_followed(tmp_path: Path) -> None:
    """Data may lie beside the link, or beside the header that the link leads to."""
    (tmp_path / "here").mkdir()
    envi(tmp_path / "there")
    for name in ("a.hdr", "a.img"):
        (tmp_path / "here" / name).symlink_to(tmp_path / "there" / name)
    np.testing.assert_array_equal(open_cube_source(tmp_path / "here" / "a.hdr").read(0, 6), CUBE)
    (tmp_path / "folder").symlink_to(tmp_path / "there")
    np.testing.assert_array_equal(open_cube_source(tmp_path / "folder" / "a.hdr").read(0, 6), CUBE)


def test_scene_toml_names_relative_files(tmp_path: Path) -> None:
    """Files beside and above it are read; an absolute path, which may be any file of the machine, is refused."""
    picture(tmp_path / "data" / "a.png")
    (tmp_path / "nm.txt").write_text("640\n550\n460\n")
    settings = tmp_path / "data" / "scene.toml"
    settings.write_text('wavelengths_file = "../nm.txt"')
    assert open_scene_file(tmp_path / "data" / "a.png").wavelength_nm.tolist() == [640, 550, 460]
    for line in (f'wavelengths_file = "{tmp_path}/nm.txt"', f'labels = "{tmp_path}/nm.txt"'):
        settings.write_text(line)
        with pytest.raises(SceneError, match=r"scene.toml: .* is an absolute path; write it relative to"):
            open_scene_file(tmp_path / "data" / "a.png")


@pytest.mark.parametrize("name", ["a.tfw", "LC08_MTL.txt"])
def test_a_pipe_beside_an_image_is_refused(tmp_path: Path, name: str) -> None:
    """Reading it would never end."""
    opened = image(tmp_path)
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    with pytest.raises(SceneError, match=rf"{name} is no file; move it elsewhere"):
        opened()


@pytest.mark.parametrize("place", ["a.tif", "a.tif.aux.xml", "a.tif.msk", "a.tif.ovr"])
def test_overviews_elsewhere_are_refused(tmp_path: Path, place: str) -> None:
    """Tags of an image, its sidecar or its mask cannot make GDAL contact a server."""
    opened = image(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        url = f"/vsicurl/http://127.0.0.1:{server.getsockname()[1]}/a.tif"
        if place.endswith("xml"):
            entry = f'<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{url}</MDI></Metadata>'
            (tmp_path / place).write_text(f"<PAMDataset>{entry}</PAMDataset>")
        else:
            with rasterio.open(tmp_path / place, "r+", driver="GTiff") as file:
                file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=url)
        with pytest.raises(
            SceneError, match=r"says that its overviews are in /vsicurl/http.* not opened; write it again"
        ):
            opened()
        with pytest.raises(TimeoutError):
            server.accept()


def test_a_crs_in_another_file_is_not_opened(tmp_path: Path) -> None:
    """PROJ reads definitions from any file that a CRS names."""
    (tmp_path / "defs").write_text("<utm> +proj=utm +zone=32 +datum=WGS84 +units=m <>\n")
    axes = {"y": 5e6 - np.arange(6.0), "x": 4e5 + np.arange(4.0)}
    cube = xr.DataArray(CUBE, dims=("y", "x", "band"), coords=axes, attrs={"crs": f"+init={tmp_path}/defs:utm"})
    cube.to_dataset(name="cube").to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    source = open_cube_source(tmp_path / "a.nc")
    assert source.geobox is None
    assert any("cannot be read from crs: it names a file, which is not opened" in note for note in source.notes)


@pytest.mark.parametrize("name", ["a.tif.msk", "a.tif.ovr"])
def test_sidecars_of_other_formats_are_refused(tmp_path: Path, name: str) -> None:
    """GDAL would open a mask or overviews by any driver, and a VRT leads to any file."""
    opened = image(tmp_path)
    (tmp_path / name).write_text('<VRTDataset rasterXSize="8" rasterYSize="6"></VRTDataset>')
    with pytest.raises(SceneError, match=rf"{name} cannot be read as TIFF.* move it elsewhere"):
        opened()

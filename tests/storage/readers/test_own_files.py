"""Links of the user are followed; files that other files name are not, and what is no file is refused."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import scipy.io
import xarray as xr
import zarr
from PIL import Image

from spectralzoom.flows.training.data import load_data_set
from spectralzoom.pipeline.capture.recorded import Recording
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.cube_sources import CubeSource
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.recordings import open_recording
from spectralzoom.storage.readers.scene_files import SceneFile, open_scene_file
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
    for kind, level in (("dark", 0), ("white", 1000)):
        write_cube(here / f"{kind}Reference.hdr", CUBE[:1] * 0 + level, "u2")
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
    """Write a TIFF without a place of its own, so that GDAL looks for one beside it."""
    for name in ("LC08_B2.tif", "LC08_B2.tif.msk", "LC08_B2.tif.ovr"):
        with rasterio.open(here / f"{name}.tif", "w", "GTiff", 8, 6, 1, dtype="uint8") as file:
            file.write(np.full((1, 6, 8), 255, np.uint8))
        (here / f"{name}.tif").rename(here / name)
    (here / "LC08_B2.tfw").write_text("1\n0\n0\n-1\n400000\n5000000\n")
    (here / "LC08_B2.tif.aux.xml").write_text("<PAMDataset></PAMDataset>")
    (here / "LC08_MTL.txt").write_text("GROUP = L1_METADATA_FILE\nEND\n")
    return lambda: open_cube_source(here / "LC08_B2.tif")


def png(here: Path) -> Opened:
    picture(here / "a.png")
    (here / "a.pgw").write_text("1\n0\n0\n-1\n400000\n5000000\n")
    return lambda: open_cube_source(here / "a.png")


def hdf(here: Path) -> Opened:
    xr.Dataset({"cube": (("y", "x", "band"), CUBE)}).to_netcdf(here / "a.nc", engine="h5netcdf")
    return lambda: open_cube_source(here / "a.nc")


def npy(here: Path) -> Opened:
    np.save(here / "a.npy", CUBE)
    return lambda: open_cube_source(here / "a.npy")


def mat(here: Path) -> Opened:
    scipy.io.savemat(here / "a.mat", {"cube": CUBE})
    return lambda: open_cube_source(here / "a.mat")


def sweep_stores(here: Path) -> Opened:
    for name in ("a.zarr", "b.zarr"):
        array = zarr.create_group(here / name).create_array("cube", data=CUBE, dimension_names=("y", "x", "band"))
        array.update_attributes({"wavelength": [500.0, 600.0, 700.0], "wavelength_units": "nm"})
        rows = "".join(f"{line / 100}\n" for line in range(6))
        (here / name).with_suffix(".pointing.csv").write_text(f"angle_deg\n{rows}")
    return lambda: open_recording(here)


LAYOUTS: dict[Callable[[Path], Opened], tuple[str, ...]] = {
    npy: ("a.npy",),
    mat: ("a.mat",),
    hdf: ("a.nc",),
    png: ("a.png", "a.pgw"),
    envi: ("a.img", "a.hdr"),
    envi_by_data: ("a.hdr",),
    headwall: (
        *("raw_0.hdr", "raw_0", "frameIndex_0.txt"),
        *("darkReference.hdr", "darkReference.img", "whiteReference.hdr", "whiteReference.img"),
    ),
    recorded: ("a.hdr", "a.img", "a.dark.npy", "a.bad.npy", "a.white.hdr", "a.white.img", "a.pointing.csv"),
    sweep_stores: ("b.zarr", "b.pointing.csv"),
    labelled: ("labels/001.png", "scene.toml"),
    stated: ("more/a.png", "nm.txt", "scene.toml"),
    named_array: ("gt.mat",),
    store: ("cube.zarr/c/0/0/0",),
    training: ("images/1.png", "labels/1.png"),
    image: ("LC08_B2.tif.msk", "LC08_B2.tif.ovr", "LC08_B2.tfw", "LC08_B2.tif.aux.xml", "LC08_MTL.txt"),
}
FOLDERS = {
    labelled: ("labels", "images"),
    stated: ("more",),
    store: ("cube.zarr", "cube.zarr/c"),
    training: ("labels",),
}
EACH = [(layout, name) for layout, names in LAYOUTS.items() for name in names]
WITH_FOLDERS = [*EACH, *((layout, name) for layout, names in FOLDERS.items() for name in names)]


def content(found: Any) -> dict[str, Any]:
    """Return the numbers that a reader has read, and what it found beside them."""
    if isinstance(found, CubeSource):
        lines = found.read(0, found.shape[0])
        return {"lines": lines, "dark": found.dark, "place": found.geobox, "notes": found.notes}
    if isinstance(found, SceneFile):
        return {"values": found.values, "labels": found.labels, "nm": found.wavelength_nm, "notes": found.provenance}
    if isinstance(found, Recording):
        lines = [one.read_lines(np.arange(len(one.position))) for one in found.sweeps]
        return {"lines": lines, "light": found.light, "dark": [one.references.dark for one in found.sweeps]}
    return {"labels": sorted(found.label_files), "files": sorted(found.files)}


@pytest.mark.parametrize(("layout", "name"), WITH_FOLDERS)
def test_links_of_a_folder_are_followed(tmp_path: Path, layout: Callable[[Path], Opened], name: str) -> None:
    """Each file, and each folder, may lie on another disk: the same is read, and has the same hash."""
    (folder := tmp_path / "here").mkdir()
    before = content((opened := layout(folder))())
    moved = tmp_path / "outside" / name
    moved.parent.mkdir(parents=True)
    (folder / name).rename(moved)
    (folder / name).symlink_to(moved)
    np.testing.assert_equal(content(opened()), before)


@pytest.mark.parametrize(("layout", "name"), EACH)
@pytest.mark.parametrize("kind", ["link", "loop", "pipe", "device"])
def test_what_is_no_file_is_refused(tmp_path: Path, layout: Callable[[Path], Opened], name: str, kind: str) -> None:
    """It ends at once, with the name: a reader would take a link to nowhere for no file, and wait for a pipe."""
    opened = layout(tmp_path)
    place = tmp_path / name
    place.unlink() if place.is_file() else shutil.rmtree(place)
    if kind == "pipe":
        os.mkfifo(place)
    else:
        place.symlink_to({"link": tmp_path / "none", "loop": Path(place.name), "device": Path("/dev/zero")}[kind])
    words = "is no file; move it" if kind in ("pipe", "device") else "is a link that leads nowhere|there is no"
    with pytest.raises(SceneError, match=rf"{place.name} ({words})|{words} file .*{place.name}"):
        content(opened())


@pytest.mark.parametrize(("layout", "name"), [(layout, name) for layout, names in FOLDERS.items() for name in names])
def test_a_folder_that_leads_nowhere_is_refused(tmp_path: Path, layout: Callable[[Path], Opened], name: str) -> None:
    """It is not taken for one that does not exist: labels, settings or chunks would be missing without a word."""
    opened = layout(tmp_path)
    (tmp_path / name).rename(tmp_path / "away")
    (tmp_path / name).symlink_to(tmp_path / "none")
    with pytest.raises(SceneError, match=r"is a link that leads nowhere|there is no|expected a file"):
        content(opened())


@pytest.mark.parametrize("layout", LAYOUTS)
def test_neighbours_may_be_anything(tmp_path: Path, layout: Callable[[Path], Opened]) -> None:
    """Links, pipes, sockets and devices that no reader opens are as if they were not there."""
    before = content((opened := layout(tmp_path))())
    for name in ("README.txt", "a2.img", "LC08_B22.img", "LC08_B2.txt", "a_live", "METADATA.csv", "notes.xml"):
        os.mkfifo(tmp_path / name)
    for name in ("a.html", "a_b.tfw", "LC08_B2_old.msk", "LC08_B22.tif.msk", "LC09_MTL.txt", "raw.csv", "b.txt"):
        (tmp_path / name).symlink_to(tmp_path / "none")
    (tmp_path / "zero.bin").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as live:
        live.bind(str(tmp_path / "a.sock"))
        np.testing.assert_equal(content(opened()), before)


def test_a_store_is_hashed_through_its_links(tmp_path: Path) -> None:
    """Another content of the linked folder is another scene; a link to the store itself is followed once."""
    np_cube = CUBE.astype("f4")
    zarr.create_array(tmp_path / "a.zarr", data=np_cube)
    (tmp_path / "a.zarr" / "c").rename(tmp_path / "chunks")
    (tmp_path / "a.zarr" / "c").symlink_to(tmp_path / "chunks")
    (tmp_path / "a.zarr" / "again").symlink_to(tmp_path / "a.zarr")
    nm = [500.0, 600.0, 700.0]
    first = open_scene_file(tmp_path / "a.zarr", wavelengths=nm)
    np.testing.assert_array_equal(first.values, np_cube)
    assert not any("chunks have no file" in note for note in first.provenance)
    zarr.create_array(tmp_path / "b.zarr", data=np_cube + 1)
    (chunk,) = (path for path in (tmp_path / "b.zarr" / "c").rglob("*") if path.is_file())
    chunk.replace(next(path for path in (tmp_path / "chunks").rglob("*") if path.is_file()))
    assert open_scene_file(tmp_path / "a.zarr", wavelengths=nm).content != first.content


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


@pytest.mark.parametrize("place", ["LC08_B2.tif", "LC08_B2.tif.aux.xml", "LC08_B2.tif.msk", "LC08_B2.tif.ovr"])
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


@pytest.mark.parametrize("name", ["LC08_B2.tif.msk", "LC08_B2.tif.ovr", "LC08_B2.TIF.OVR", "LC08_B2.tif.msk.ovr"])
def test_sidecars_of_other_formats_are_refused(tmp_path: Path, name: str) -> None:
    """GDAL would open a mask or overviews by any driver, and a VRT leads to any file."""
    opened = image(tmp_path)
    (tmp_path / name).write_text('<VRTDataset rasterXSize="8" rasterYSize="6"></VRTDataset>')
    with pytest.raises(SceneError, match=rf"{name} cannot be read as TIFF.* move it elsewhere"):
        opened()

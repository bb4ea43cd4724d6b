"""A file that changes while it is read is refused: what is hashed is what is read."""

from __future__ import annotations

import os
import posix
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
import scipy.io
import xarray as xr
import zarr
from PIL import Image

from spectralzoom.pipeline.errors import FileChangedError, SceneError
from spectralzoom.storage.readers import file_numbers, user_files
from spectralzoom.storage.readers.file_numbers import FileNumbers
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.polygons import read_polygons
from spectralzoom.storage.readers.recordings import open_recording
from spectralzoom.storage.readers.scene_files import open_scene_file
from spectralzoom.storage.readers.user_files import OpenedFiles, is_there, reading_files
from tests.envi_files import listed, write_cube
from tests.storage.readers.test_zone_files import SQUARE, written

NM = [500.0, 600.0, 700.0]
HEADER = {"wavelength units": "nm", "wavelength": listed(np.array(NM))}
CUBE = np.arange(1, 200 * 9 * 3 + 1, dtype=np.uint16).reshape(200, 9, 3)
Written = Callable[[Path], tuple[Path, Path]]  # address, and the file that changes


def npy(here: Path) -> tuple[Path, Path]:
    np.save(here / "a.npy", CUBE)
    return here / "a.npy", here / "a.npy"


def by_columns(here: Path) -> tuple[Path, Path]:
    np.save(here / "a.npy", np.asfortranarray(CUBE))
    return here / "a.npy", here / "a.npy"


def mat(here: Path) -> tuple[Path, Path]:
    scipy.io.savemat(here / "a.mat", {"cube": CUBE})
    return here / "a.mat", here / "a.mat"


def hdf(here: Path) -> tuple[Path, Path]:
    xr.Dataset({"cube": (("y", "x", "band"), CUBE)}).to_netcdf(here / "a.nc", engine="h5netcdf")
    return here / "a.nc", here / "a.nc"


def envi(here: Path) -> tuple[Path, Path]:
    write_cube(here / "a.hdr", CUBE, "u2", **HEADER)
    return here / "a.hdr", here / "a.img"


def envi_header(here: Path) -> tuple[Path, Path]:
    return envi(here)[0], here / "a.hdr"


def tiff(here: Path) -> tuple[Path, Path]:
    with rasterio.open(here / "a.tif", "w", "GTiff", 9, 200, 3, dtype="uint16", photometric="MINISBLACK") as file:
        file.write(np.moveaxis(CUBE, -1, 0))
    return here / "a.tif", here / "a.tif"


def world_file(here: Path) -> tuple[Path, Path]:
    (here / "a.tfw").write_text("1\n0\n0\n-1\n400000\n5000000\n")
    return tiff(here)[0], here / "a.tfw"


def png(here: Path) -> tuple[Path, Path]:
    Image.fromarray(CUBE.astype(np.uint8)).save(here / "a.png")
    return here / "a.png", here / "a.png"


def chunk(here: Path) -> tuple[Path, Path]:
    zarr.create_array(here / "a.zarr", data=CUBE, chunks=(64, 9, 3))
    return here / "a.zarr", here / "a.zarr" / "c" / "1" / "0" / "0"


def in_place(path: Path) -> None:
    """Write another last byte, and set the time back."""
    before = path.stat()
    with path.open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        last = file.read(1)
        file.seek(-1, os.SEEK_END)
        file.write(bytes([last[0] ^ 1]))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def by_rename(path: Path) -> None:
    """Put another file of the same size and time in its place."""
    other = path.with_name("other")
    other.write_bytes(path.read_bytes())
    in_place(other)
    os.utime(other, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns))
    other.replace(path)


def cut(path: Path) -> None:
    """Cut it off, as a program does that begins to write it again."""
    path.write_bytes(b"")


FORMATS: list[Written] = [npy, by_columns, mat, hdf, envi, envi_header, tiff, world_file, png, chunk]


@pytest.mark.parametrize("write", FORMATS)
@pytest.mark.parametrize("change", [in_place, by_rename, cut, Path.unlink])
def test_a_change_ends_the_reading(tmp_path: Path, write: Written, change: Callable[[Path], None]) -> None:
    """Of every format and kind of change, also one whose size and time are as before; none ends the process."""
    address, changing = write(tmp_path)
    source = open_cube_source(address)
    np.testing.assert_array_equal(source.read(0, 70), CUBE.astype(source.dtype)[:70])
    change(changing)
    with pytest.raises(FileChangedError, match=rf"{changing.name} changed while it was read; run the survey again"):
        source.read(70, 200)


def test_lines_that_were_read_stay(tmp_path: Path) -> None:
    """They are a copy: a later change of the file does not reach them."""
    address, changing = npy(tmp_path)
    lines = open_cube_source(address).read(190, 200)
    in_place(changing)
    np.testing.assert_array_equal(lines, CUBE[190:])


def test_other_rights_and_names_are_no_change(tmp_path: Path) -> None:
    """A backup may link a file or change its rights; its content was hashed, and is compared."""
    address, changing = npy(tmp_path)
    scene = open_scene_file(address, wavelengths=NM)
    changing.chmod(0o600)
    os.link(changing, tmp_path / "backup")
    np.testing.assert_array_equal(scene.values, CUBE.astype(np.float32))
    in_place(changing)
    with pytest.raises(FileChangedError):
        scene.read(0, 2)


@pytest.mark.parametrize("write", [npy, envi, tiff, chunk])
def test_a_scene_is_what_was_hashed(tmp_path: Path, write: Written) -> None:
    """A change between opening and reading never gives the new values under the old hash."""
    address, changing = write(tmp_path)
    scene = open_scene_file(address, wavelengths=NM)
    in_place(changing)
    with pytest.raises(FileChangedError):
        scene.read(0, 200)
    if write is not chunk:  # whose checksum or packing tells
        again = open_scene_file(address, wavelengths=NM)
        assert again.content != scene.content
        assert not np.array_equal(again.values, CUBE.astype(np.float32))


def test_files_beside_a_scene_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings, labels or polygons that change as the scene is opened are refused by their name."""
    address, _ = npy(tmp_path)
    (settings := tmp_path / "scene.toml").write_text("wavelengths_nm = [500, 600, 700]\n")
    np.save(tmp_path / "a_labels.npy", np.ones((200, 9), np.uint8))
    open_scene_file(address)
    hashed = OpenedFiles.digest

    def changed_meanwhile(name: str) -> None:
        def digest(opened: OpenedFiles, path: Path) -> str:
            in_place(tmp_path / name)
            return hashed(opened, path)

        monkeypatch.setattr(user_files.OpenedFiles, "digest", digest)

    for name in ("scene.toml", "a_labels.npy", "a.npy"):
        changed_meanwhile(name)
        with pytest.raises(FileChangedError, match=f"{name} changed while it was read"):
            open_scene_file(address)
        settings.write_text("wavelengths_nm = [500, 600, 700]\n")


def test_polygons_count(tmp_path: Path) -> None:
    """Their file is noted, and with a shapefile its parts."""
    path = written(tmp_path / "z.shp", [SQUARE])
    with pytest.raises(FileChangedError, match=r"z\.dbf changed"), reading_files():  # noqa: PT012 - the end of the block raises
        read_polygons(path)
        in_place(tmp_path / "z.dbf")


def test_a_reader_fails_by_a_half_written_file(tmp_path: Path) -> None:
    """The message is that of the change, not that of the damage it causes."""
    (path := tmp_path / "a").write_text("1")
    with pytest.raises(FileChangedError, match="a changed while it was read"), reading_files():  # noqa: PT012 - as above
        is_there(path)
        path.write_text("11")
        raise SceneError("damaged")


def recorded(here: Path) -> Path:
    write_cube(here / "a.hdr", CUBE, "u2", **HEADER)
    np.save(here / "a.dark.npy", np.zeros((9, 3), np.float32))
    (here / "a.pointing.csv").write_text("position_px\n" + "".join(f"{line}\n" for line in range(200)))
    return here


@pytest.mark.parametrize("name", ["a.img", "a.hdr"])
def test_a_recording_of_other_lines_is_another(tmp_path: Path, name: str) -> None:
    """Also one of the same size and time; its lines cannot be read, and it has another key. A copy has the same."""
    (folder := tmp_path / "here").mkdir()
    before = open_recording(recorded(folder))
    np.testing.assert_array_equal(before.sweeps[0].read_lines(np.arange(2)), CUBE[:2])
    folder.rename(tmp_path / "moved")
    os.utime(tmp_path / "moved" / "a.img", (1, 1))
    folder = tmp_path / "moved"
    assert open_recording(folder).light == before.light
    before = open_recording(folder)
    if name == "a.hdr":
        text = (folder / name).read_text()
        old = (folder / name).stat()
        (folder / name).write_text(text.replace("500.0", "510.0"))
        os.utime(folder / name, ns=(old.st_atime_ns, old.st_mtime_ns))
    else:
        in_place(folder / name)
    assert open_recording(folder).light != before.light
    with pytest.raises(FileChangedError, match=name):
        before.sweeps[0].read_lines(np.arange(2))


MAPPED = """
import mmap, sys
with open(sys.argv[1], "r+b") as file, mmap.mmap(file.fileno(), 0) as content:
    content[-1] ^= 1
    print("dirty", flush=True)
    sys.stdin.readline()
    content[-1] ^= 2
    print("written", flush=True)
    sys.stdin.readline()
"""


def test_writes_through_a_memory_map_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process writes to a page that it has written before, without a call; on a disk the kernel dates it."""
    monkeypatch.setattr(os, "fsync", posix.fsync)
    address, changing = npy(tmp_path)
    command = [sys.executable, "-c", MAPPED, str(changing)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdin is not None
        assert writer.stdout is not None
        assert writer.stdout.readline() == "dirty\n"
        source = open_cube_source(address)
        source.read(0, 2)
        before = changing.stat()
        writer.stdin.write("\n")
        writer.stdin.flush()
        assert writer.stdout.readline() == "written\n"
        if subprocess.run(["stat", "-f", "-c", "%T", changing], capture_output=True, text=True).stdout == "tmpfs\n":
            assert changing.stat().st_ctime_ns == before.st_ctime_ns
            pytest.skip("files in memory alone have no time of such writes")
        with pytest.raises(FileChangedError):
            source.read(0, 2)
        writer.communicate("\n")


def test_young_files_are_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A change within the clock's grain might have the same time; one wait serves all files written before it."""
    waits: list[float] = []
    monkeypatch.setattr(time, "sleep", waits.append)
    (path := tmp_path / "a").write_text("1")
    OpenedFiles().note(path)
    assert waits == [user_files.GRAIN_NS / 1e9]
    monkeypatch.setattr(time, "time_ns", lambda: path.stat().st_ctime_ns + user_files.GRAIN_NS)
    OpenedFiles().note(path)
    assert len(waits) == 1


@pytest.mark.parametrize("at_once", [1, 600, 1 << 24])
@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (2, 0, 1), (2, 1, 0)])
def test_parts_of_an_array_in_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int, order: tuple[int, int, int]
) -> None:
    """They are those of numpy, in any order of axes, in one piece or in many."""
    monkeypatch.setattr(file_numbers, "AT_ONCE", at_once)
    (path := tmp_path / "a").write_bytes(b"head" + CUBE.transpose(order).tobytes())
    there = np.frombuffer(CUBE.transpose(order).tobytes(), CUBE.dtype).reshape([CUBE.shape[axis] for axis in order])
    steps = dict(zip(order, there.strides, strict=True))
    found = FileNumbers(path, 4, CUBE.shape, CUBE.dtype, (steps[0], steps[1], steps[2]))
    for part in (
        ...,
        slice(3, 70),
        slice(190, 400),
        slice(5, 5),
        (slice(60, 64), slice(None), 1),
        (7,),
        slice(9, 2, -1),
    ):
        np.testing.assert_array_equal(found[part], CUBE[part])
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(SceneError, match="ends before its last number"):
        found[...]

"""Files that claim more than they hold, or would run code or fetch files: one clear error, and little memory."""

from __future__ import annotations

import io
import pickle
import struct
import tracemalloc
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from PIL import Image

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.open_cubes import load_labels_array, open_cube_source

FEW = 8 << 20  # bytes: what libraries take when they are first used


def read_all(path: Path) -> Any:
    """Read all lines of a cube."""
    source = open_cube_source(path)
    return source.read(0, source.shape[0])


@contextmanager
def little_memory(most: int = FEW) -> Iterator[None]:
    """Fail if the block allocates more memory."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def npy_header(shape: tuple[int, ...], kind: str = "<u2") -> bytes:
    """Return a .npy header, without any number after it."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": kind, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def test_arrays_with_huge_claims_are_refused(tmp_path: Path) -> None:
    """A shape beyond the bytes of the file is refused before it is allocated."""
    (tmp_path / "a.npy").write_bytes(npy_header((100_000, 1000, 1000)) + bytes(100))
    with little_memory(), pytest.raises(SceneError, match="cannot be read as"):
        read_all(tmp_path / "a.npy")


def test_only_the_cube_of_a_file_is_read(tmp_path: Path) -> None:
    """Other arrays in a .mat file are not unpacked."""
    cube = np.ones((3, 4, 5), np.uint8)
    scipy.io.savemat(tmp_path / "a.mat", {"cube": cube, "large": np.zeros((6000, 6000), np.uint8)}, do_compression=True)
    with little_memory(128 << 20):  # scipy unpacks 128 KiB at a time
        np.testing.assert_array_equal(read_all(tmp_path / "a.mat"), cube)


class Trap:
    """Leave a file if unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def test_pickles_are_never_loaded(tmp_path: Path) -> None:
    """Content that only unpickling could read is refused in .npy and .mat files."""
    trap = pickle.dumps(Trap(tmp_path / "trapped"))
    (tmp_path / "bare.npy").write_bytes(trap)
    (tmp_path / "object.npy").write_bytes(npy_header((2, 2, 2), "|O") + trap)
    (tmp_path / "bare.mat").write_bytes(trap)
    scipy.io.savemat(tmp_path / "cell.mat", {"cube": np.array([{"a": 1}], object)})  # objects are skipped
    for name in ("bare.npy", "object.npy", "bare.mat", "cell.mat"):
        with pytest.raises(SceneError, match=r"Python objects|cannot be read|has no (single )?array"):
            open_cube_source(tmp_path / name)
    assert not (tmp_path / "trapped").exists()


def test_mat_arrays_with_huge_claims_are_refused(tmp_path: Path) -> None:
    """Axes beyond the file's size are refused in both versions; the array of version 7.3 was never written."""
    scipy.io.savemat(tmp_path / "a.mat", {"cube": np.ones((3, 4, 5), np.uint8)})
    whole = (tmp_path / "a.mat").read_bytes()
    sizes = struct.pack("<iii", 3, 4, 5)
    assert sizes in whole
    (tmp_path / "a.mat").write_bytes(whole.replace(sizes, struct.pack("<iii", 30_000, 40_000, 50_000)))
    with h5py.File(tmp_path / "b.mat", "w", userblock_size=512) as file:
        file.create_dataset("cube", (10**4, 10**4, 10**4), np.uint16, chunks=(64, 64, 64))
    for name in ("a.mat", "b.mat"):
        with little_memory(), pytest.raises(SceneError, match="bytes of numbers, and"):
            read_all(tmp_path / name)


def test_matlab_text_and_cells_are_ignored(tmp_path: Path) -> None:
    """MATLAB 7.3 stores text as numbers; it is not taken for an image beside the labels."""
    labels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["labels"] = labels.T
        file["note"] = np.frombuffer(b"w\0h\0y\0", np.uint16)[:, None]
        file["note"].attrs["MATLAB_class"] = b"char"
        file["cells"] = np.array([[file["labels"].ref] * 2] * 2, h5py.ref_dtype)
    np.testing.assert_array_equal(load_labels_array(tmp_path / "a.mat")[..., 0], labels)


def png(width: int, height: int, packed: bytes) -> bytes:
    """Return a grey PNG of any claimed size."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)), (b"IDAT", packed), (b"IEND", b"")]
    number = struct.Struct(">I").pack
    parts = [number(len(body)) + kind + body + number(zlib.crc32(kind + body)) for kind, body in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize("side", [12_000, 25_000, 2**31 - 1])
def test_images_with_huge_claims_are_refused(tmp_path: Path, side: int) -> None:
    """A PNG and a bitmap of a few bytes do not get the memory of the size that they claim."""
    (tmp_path / "a.png").write_bytes(png(side, side, zlib.compress(bytes(2000))))
    Image.new("L", (2, 2)).save(tmp_path / "a.bmp")
    head = bytearray((tmp_path / "a.bmp").read_bytes())
    head[18:26] = struct.pack("<ii", side, side)
    (tmp_path / "a.bmp").write_bytes(head)
    for name in ("a.png", "a.bmp"):
        with little_memory(), pytest.raises(SceneError, match=r"bytes of numbers, and|cannot be read"):
            read_all(tmp_path / name)


@pytest.mark.parametrize(("side", "tile"), [(2_000_000_000, 2_000_000_000), (60_000, 60_000), (1_000_000, 512)])
def test_tiffs_with_huge_claims_are_refused(tmp_path: Path, side: int, tile: int) -> None:
    """A TIFF of a few bytes claims sides of up to 2 000 000 000 px."""
    told = {(256, 257): (4, side), (258,): (3, 8), (259, 262, 277): (3, 1), (322, 323): (4, tile), (324, 325): (4, 0)}
    entries = [(tag, *one) for tags, one in told.items() for tag in tags]
    body = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    (tmp_path / "a.tif").write_bytes(b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + bytes(4))
    with little_memory(), pytest.raises(SceneError, match=r"bytes of numbers, and|cannot be read"):
        read_all(tmp_path / "a.tif")


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("fraction", [0.02, 0.9])
def test_truncated_tiffs_are_refused(tmp_path: Path, compression: str | None, fraction: float) -> None:
    """The error comes when missing rows are read; they are not filled."""
    values = np.random.default_rng(0).integers(1, 255, (200, 100), dtype=np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", values, compression=compression, rowsperstrip=16)
    whole = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(whole[: int(len(whole) * fraction)])
    with pytest.raises(SceneError, match="cannot be read as TIFF"):
        open_cube_source(tmp_path / "a.tif").read(0, 200)


def test_a_tiff_of_several_images_is_refused(tmp_path: Path) -> None:
    """They may be bands, dates or thumbnails; the message says what is expected."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for _ in range(5):
            file.write(np.ones((7, 9), np.uint8), contiguous=False)
    with pytest.raises(SceneError, match=r"a\.tif holds 5 images, expected one with all bands; write them as"):
        open_cube_source(tmp_path / "a.tif")


VRT = """<VRTDataset rasterXSize="4" rasterYSize="3"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>
<SourceFilename relativeToVRT="1">secret.tif</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand>
</VRTDataset>"""


def test_a_vrt_named_as_tiff_is_refused(tmp_path: Path) -> None:
    """Other formats of GDAL may refer to any file or server, so they are not opened under this ending."""
    tifffile.imwrite(tmp_path / "secret.tif", np.full((3, 4), 7, np.uint8))
    (tmp_path / "a.tif").write_text(VRT)
    with pytest.raises(SceneError, match=r"a\.tif cannot be read as TIFF"):
        open_cube_source(tmp_path / "a.tif")

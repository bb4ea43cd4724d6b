"""Chunks that unpack to far more than their headers declare are refused, in little memory."""

from __future__ import annotations

import gzip
import json
import struct
import subprocess
import sys
import zlib
from bz2 import compress as bz2_compress
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import google_crc32c
import h5py
import numcodecs
import numpy as np
import pytest
import zarr
from zarr.storage import LocalStore

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.checked_chunks import PACKERS, CheckedStore, read_hdf5, unpack
from spectralzoom.storage.readers.open_cubes import open_cube_source

CUBE = np.arange(4 * 6 * 5, dtype=np.uint16).reshape(4, 6, 5)
PIECE_BYTES, PIECES = 64 << 20, 12  # together more than the limit
LIMIT_KB = 600 << 10
CHILD = """
import re, sys
from pathlib import Path
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.open_cubes import open_cube_source
for path in map(Path, sys.argv[1:]):
    try:
        open_cube_source(path).read(0, 4)
        print(path.name, "was read")
    except SceneError as error:
        print(error)
print(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])  # since it was started
"""


def codec(packer: str) -> Any:
    """Return a packer of numcodecs."""
    return numcodecs.get_codec({"id": packer})


@cache
def zeros(packer: str) -> bytes:
    """Return hundreds of MB of zeros in one packed chunk."""
    piece = bytes(PIECE_BYTES)
    if packer == "zlib":
        packing = zlib.compressobj(9, zlib.DEFLATED, -15)
        part = packing.compress(piece) + packing.flush(zlib.Z_FULL_FLUSH)
        sums = struct.pack(">HH", PIECES * PIECE_BYTES % 65521, 1)
        return b"\x78\x9c" + part * PIECES + b"\x03\x00" + sums
    if packer in ("blosc", "lz4"):
        return bytes(codec(packer).encode(np.zeros(PIECES * PIECE_BYTES, np.uint8)))
    pack: dict[str, Callable[[bytes], Any]] = {"gzip": gzip.compress, "bz2": bz2_compress, "zstd": codec("zstd").encode}
    return bytes(pack[packer](piece)) * PIECES


def store(path: Path, packer: str, *, version: int, sharded: bool = False) -> Path:
    """Write a small Zarr store of one chunk, and the zeros in its place."""
    named: Any = codec(packer) if version == 2 else {"name": packer, "configuration": {}}
    if version == 3 and packer in ("zlib", "bz2", "lz4"):
        named = {"name": f"numcodecs.{packer}", "configuration": {}}
    shards: Any = {"shards": CUBE.shape, "chunks": (2, 6, 5)} if sharded else {"chunks": CUBE.shape}
    plain: Any = None if version == 2 else "auto"
    zarr.create_array(path, shape=CUBE.shape, dtype="u2", zarr_format=version, compressors=plain, **shards)  # type: ignore[arg-type]
    about = json.loads((path / {2: ".zarray", 3: "zarr.json"}[version]).read_text())
    chunk = zeros(packer)
    if version == 2:
        about["compressor"] = named.get_config()
    elif sharded:
        about["codecs"][0]["configuration"]["codecs"][-1] = named
        index = struct.pack("<4Q", 0, len(chunk), 0, len(chunk))
        chunk += index + struct.pack("<I", google_crc32c.value(index))
    else:
        about["codecs"][-1] = named
    (path / {2: ".zarray", 3: "zarr.json"}[version]).write_text(json.dumps(about))
    place = path / ("0.0.0" if version == 2 else "c/0/0/0")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(chunk)
    return path


def hdf5(path: Path, **how: Any) -> Path:
    """Write an HDF5 file of one deflated chunk of zeros."""
    with h5py.File(path, "w") as file:
        cube = file.create_dataset("cube", CUBE.shape, "u2", chunks=CUBE.shape, compression="gzip", **how)
        cube.id.write_direct_chunk((0, 0, 0), zeros("zlib"))
    return path


def mat(path: Path, place: str) -> Path:
    """Write a .mat file whose numbers, or name, are zeros beyond what it declares."""
    head = struct.pack("<116sQHH", b"MATLAB 5.0 MAT-file", 0, 0x0100, 0x4D49)
    flags = struct.pack("<4I", 6, 8, 4, 0)[:8] + struct.pack("<II", 9, 0)
    sizes = struct.pack("<IIiiiI", 5, 12, *CUBE.shape, 0)
    name = struct.pack("<II8s", 1, 4, b"cube") if place == "numbers" else b""
    start = flags + sizes + name + struct.pack("<II", 2 if place == "numbers" else 1, PIECES * PIECE_BYTES)
    packing = zlib.compressobj(9)
    body = packing.compress(struct.pack("<II", 14, len(start) + 480) + start) + packing.compress(bytes(1 << 16))
    body += packing.flush(zlib.Z_FULL_FLUSH) + zeros("zlib")[2:]
    path.write_bytes(head + struct.pack("<II", 15, len(body)) + body)
    return path


def test_chunks_beyond_their_header_are_refused(tmp_path: Path) -> None:
    """Each kind of file ends in one message, and all together take less memory than one chunk would."""
    paths = [
        *(store(tmp_path / f"2_{packer}.zarr", packer, version=2) for packer in PACKERS),
        *(store(tmp_path / f"3_{packer}.zarr", packer, version=3) for packer in PACKERS),
        *(store(tmp_path / f"shard_{packer}.zarr", packer, version=3, sharded=True) for packer in ("gzip", "zstd")),
        hdf5(tmp_path / "a.h5"),
        hdf5(tmp_path / "a.nc", shuffle=True),
        hdf5(tmp_path / "a73.mat"),
        mat(tmp_path / "numbers.mat", "numbers"),
        mat(tmp_path / "name.mat", "name"),
    ]
    done = subprocess.run([sys.executable, "-c", CHILD, *paths], capture_output=True, text=True, check=True)
    *messages, peak_kb = done.stdout.splitlines()
    assert len(messages) == len(paths)
    for path, message in zip(paths, messages, strict=True):
        assert message.startswith(f"{path} cannot be read as"), message
    assert sum("bytes that its header declares" in one for one in messages) >= len(paths) - 1
    assert int(peak_kb) < LIMIT_KB


def test_a_part_of_a_large_chunk_is_checked(tmp_path: Path) -> None:
    """HDF5 decodes all of a chunk for one number."""
    with h5py.File(hdf5(tmp_path / "a.h5")) as file, pytest.raises(ValueError, match="bytes that its header declares"):
        read_hdf5(file["cube"], np.s_[:1, :1, :1])


@pytest.mark.filterwarnings("ignore:Numcodecs codecs are not in the Zarr version 3")
@pytest.mark.parametrize("packer", PACKERS)
@pytest.mark.parametrize("version", [2, 3])
def test_ordinary_chunks_are_read(tmp_path: Path, packer: str, version: int) -> None:
    """Every packer that is allowed gives the numbers that were stored."""
    packing: Any = codec(packer) if version == 2 else {"name": packer, "configuration": {}}
    if version == 3 and packer in ("zlib", "bz2", "lz4"):
        packing = {"name": f"numcodecs.{packer}", "configuration": {}}
    zarr.create_array(tmp_path / "a.zarr", data=CUBE, zarr_format=version, compressors=packing)  # type: ignore[arg-type]
    np.testing.assert_array_equal(open_cube_source(tmp_path / "a.zarr").read(0, 4), CUBE)


@pytest.mark.parametrize("packer", ["pickle", "lzma", "zfpy", "pcodec", "packbits", "vlen-utf8"])
def test_other_codecs_are_refused(tmp_path: Path, packer: str) -> None:
    """The message names the codec and the packers that are read, however deep the array lies."""
    array = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2).create_array("b/c/cube", data=CUBE)
    path = tmp_path / "a.zarr" / array.path / ".zarray"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"compressor": {"id": packer}}))
    group = zarr.open_group(CheckedStore(LocalStore(tmp_path / "a.zarr", read_only=True)), mode="r")
    with pytest.raises(
        SceneError, match=rf"cube/\.zarray asks for the codec '{packer}', which is not read; .*blosc, zst"
    ):
        group["b/c/cube"]


def test_zstd_gives_the_stated_bytes_alone() -> None:
    """Whatever the width of the size in the header; more frames than the first are refused."""
    for size in (5, 300, 70_000, 300_000):
        one = bytes(codec("zstd").encode(np.arange(size, dtype=np.uint32)))
        assert unpack("zstd", one, 4 * size) == np.arange(size, dtype=np.uint32).tobytes()
        for damaged in (one + one, one[:4], b"more" + one):
            with pytest.raises((ValueError, RuntimeError)):
                unpack("zstd", damaged, 8 * size)


@pytest.mark.parametrize("lost", [0, 1])
def test_zstd_without_a_size_is_read(tmp_path: Path, lost: int) -> None:
    """Writers of streams do not know it; the chunk must fill the array."""
    zarr.create_array(tmp_path / "a.zarr", data=CUBE, chunks=CUBE.shape)
    numbers = CUBE.tobytes()[lost:]
    block = (1 | len(numbers) << 3).to_bytes(3, "little") + numbers
    (tmp_path / "a.zarr/c/0/0/0").write_bytes(b"\x28\xb5\x2f\xfd\x00\x58" + block)
    if lost:
        with pytest.raises(SceneError, match="cannot be read as Zarr"):
            open_cube_source(tmp_path / "a.zarr").read(0, 4)
    else:
        np.testing.assert_array_equal(open_cube_source(tmp_path / "a.zarr").read(0, 4), CUBE)


@pytest.mark.parametrize("how", [{}, {"shuffle": True}, {"shuffle": True, "fletcher32": True}])
def test_large_hdf5_chunks_are_read(tmp_path: Path, how: dict[str, bool]) -> None:
    """Chunks too large for HDF5's own decoder give the same numbers, and the fill value where there is none."""
    values = np.random.default_rng(0).integers(0, 1 << 16, (6, 500, 700), dtype=np.uint16)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        cube = file.create_dataset(
            "cube", (9, 500, 700), ">u2", chunks=(2, 400, 500), compression=1, fillvalue=7, **how
        )
        cube[:6] = values
        for part in (np.s_[1:5, 10:420, 3:], np.s_[5:9, :, :], np.s_[3:3, :, :]):
            np.testing.assert_array_equal(read_hdf5(cube, part), cube[part])
        np.testing.assert_array_equal(read_hdf5(cube, ...), cube[...])


@pytest.mark.parametrize("twice", [False, True])
def test_other_hdf5_filters_are_refused(tmp_path: Path, twice: bool) -> None:
    """Filters that state sizes of their own are not read, nor packing twice; the message says how to write it again."""
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk(CUBE.shape)
    for _ in range(2 if twice else 0):
        plist.set_deflate(4)
    if not twice:
        plist.set_scaleoffset(h5py.h5z.SO_INT, 4)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        h5py.h5d.create(file.id, b"cube", h5py.h5t.NATIVE_UINT16, h5py.h5s.create_simple(CUBE.shape), plist)
        file["cube"][...] = CUBE
    with pytest.raises(SceneError, match=r"a\.h5:/cube is packed by the HDF5 filters \[.*write it with deflate"):
        open_cube_source(tmp_path / "a.h5").read(0, 4)

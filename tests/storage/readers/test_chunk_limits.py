"""Chunks decode to the bytes that their array declares; others are refused, in little memory."""

from __future__ import annotations

import gzip
import json
import struct
import subprocess
import sys
import zlib
from bz2 import compress as bz2_compress
from functools import cache
from pathlib import Path
from typing import Any

import google_crc32c
import h5py
import numcodecs
import numpy as np
import pytest
import zarr

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.chunk_limits import PACKERS, unpack
from spectralzoom.storage.readers.open_cubes import open_cube_source

CUBE = np.arange(4 * 6 * 5, dtype=np.uint16).reshape(4, 6, 5)
METADATA = {2: ".zarray", 3: "zarr.json"}
PIECE_BYTES, PIECES = 16 << 20, 12
MOST_MB = 128  # of a process that refuses all of them
CHILD = """
import re, sys
from pathlib import Path
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.open_cubes import open_cube_source
def status(name):
    return int(re.search(name + r":\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
before = status("VmRSS")
for path in map(Path, sys.argv[1:]):
    try:
        open_cube_source(path).read(0, 4)
        print(path.name, "was read")
    except SceneError as error:
        print(error)
print((status("VmHWM") - before) // 1024)
"""


@cache
def zeros(packer: str) -> bytes:
    """Return 192 MB of zeros in one packed chunk."""
    piece = bytes(PIECE_BYTES)
    if packer == "zlib":
        packing = zlib.compressobj(9, zlib.DEFLATED, -15)
        part = packing.compress(piece) + packing.flush(zlib.Z_FULL_FLUSH)
        return b"\x78\x9c" + part * PIECES + b"\x03\x00" + struct.pack(">HH", PIECES * PIECE_BYTES % 65521, 1)
    if packer in ("blosc", "lz4"):
        return bytes(numcodecs.get_codec({"id": packer}).encode(np.zeros(PIECES * PIECE_BYTES, np.uint8)))
    if packer == "stream":  # of zstd, which states no size
        block, last = (((end | 2 | (128 << 10) << 3).to_bytes(3, "little") + b"\0") for end in (0, 1))
        return b"\x28\xb5\x2f\xfd\x00\x58" + block * 1500 + last
    pack: dict[str, Any] = {"gzip": gzip.compress, "bz2": bz2_compress, "zstd": numcodecs.Zstd().encode}
    return bytes(pack[packer](piece)) * PIECES


def named(packer: str, version: int) -> dict[str, Any]:
    """Return the metadata of a packer."""
    if version == 2:
        return {"id": packer}
    return {"name": f"numcodecs.{packer}" if packer in ("zlib", "bz2", "lz4") else packer, "configuration": {}}


def change(path: Path, **entries: Any) -> None:
    """Replace entries of a store's metadata."""
    (file,) = (one for name in METADATA.values() if (one := path / name).exists())
    file.write_text(json.dumps(json.loads(file.read_text()) | entries))


def bomb(path: Path, packer: str, version: int, *, sharded: bool = False) -> Path:
    """Write a small Zarr store of one chunk, and the zeros in its place."""
    kind = "zstd" if packer == "stream" else packer
    shards: Any = {"shards": CUBE.shape, "chunks": (2, 6, 5)} if sharded else {"chunks": CUBE.shape}
    zarr.create_array(path, shape=CUBE.shape, dtype="u2", zarr_format=version, compressors=None, **shards)  # type: ignore[arg-type]
    chunk = zeros(packer)
    if version == 2:
        change(path, compressor=named(kind, 2))
    else:
        codecs = json.loads((path / "zarr.json").read_text())["codecs"]
        (codecs[0]["configuration"]["codecs"] if sharded else codecs).append(named(kind, 3))
        change(path, codecs=codecs)
    if sharded:
        index = struct.pack("<4Q", 0, len(chunk), 0, len(chunk))
        chunk += index + struct.pack("<I", google_crc32c.value(index))
    place = path / ("0.0.0" if version == 2 else "c/0/0/0")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(chunk)
    return path


def test_chunks_beyond_their_declared_size_are_refused(tmp_path: Path) -> None:
    """Each kind of store ends in one message, and all together take less memory than one chunk would."""
    kinds = (*PACKERS, "stream")
    paths = [bomb(tmp_path / f"{version}_{one}.zarr", one, version) for one in kinds for version in (2, 3)]
    paths += [bomb(tmp_path / f"shard_{one}.zarr", one, 3, sharded=True) for one in kinds]
    done = subprocess.run([sys.executable, "-c", CHILD, *paths], capture_output=True, text=True, check=True)
    *messages, peak_mb = done.stdout.splitlines()
    for path, message in zip(paths, messages, strict=True):
        assert message.startswith(f"{path} cannot be read as Zarr"), message
    assert int(peak_mb) < MOST_MB


@pytest.mark.parametrize("packer", PACKERS)
def test_a_chunk_has_exactly_the_declared_bytes(packer: str) -> None:
    """A longer one, a shorter one and one that is cut off are refused: no byte is made up."""
    values = np.arange(3000, dtype=np.uint16)
    packed = bytes(numcodecs.get_codec({"id": packer}).encode(values))
    assert unpack(packer, packed, values.nbytes).tobytes() == values.tobytes()
    for wrong, size in ((packed, values.nbytes - 1), (packed, values.nbytes + 1), (packed[:-3], values.nbytes)):
        with pytest.raises((ValueError, RuntimeError, EOFError)):
            unpack(packer, wrong, size)


def test_zstd_in_frames_of_any_header() -> None:
    """The width of the stated size varies; more frames than the first are refused."""
    for size in (5, 300, 70_000, 300_000):
        values = np.arange(size, dtype=np.uint32)
        one = bytes(numcodecs.Zstd().encode(values))
        assert unpack("zstd", one, values.nbytes).tobytes() == values.tobytes()
        for damaged in (one + one, one[:4], b"more" + one):
            with pytest.raises((ValueError, RuntimeError)):
                unpack("zstd", damaged, values.nbytes)
    numbers = bytes(range(200))
    stream = b"\x28\xb5\x2f\xfd\x00\x58" + (1 | len(numbers) << 3).to_bytes(3, "little") + numbers
    assert unpack("zstd", stream, 200).tobytes() == numbers  # a writer of streams does not know the size
    with pytest.raises((ValueError, RuntimeError)):
        unpack("zstd", stream, 201)


FILTERS: dict[str, Any] = {
    "wider": [{"id": "delta", "dtype": "<u2", "astype": "<i8"}],
    "narrower": [{"id": "fixedscaleoffset", "scale": 1, "offset": 0, "dtype": "<u2", "astype": "|u1"}],
    "summed": [{"id": "shuffle", "elementsize": 2}, {"id": "fletcher32"}, {"id": "crc32"}],
    "retyped": [{"id": "astype", "encode_dtype": "<f4", "decode_dtype": "<u2"}, {"id": "bitround", "keepbits": 20}],
}


@pytest.mark.parametrize("packer", PACKERS)
@pytest.mark.parametrize("filters", FILTERS)
def test_ordinary_filters_are_read_from_v2(tmp_path: Path, filters: str, packer: str) -> None:
    """Filters change how many bytes of a chunk are packed."""
    chain = [numcodecs.get_codec(one) for one in FILTERS[filters]]
    packing = numcodecs.get_codec({"id": packer})
    store = tmp_path / "a.zarr"
    zarr.create_array(store, data=CUBE, chunks=(3, 4, 5), zarr_format=2, filters=chain, compressors=packing)
    np.testing.assert_array_equal(open_cube_source(store).read(0, 4), CUBE)


@pytest.mark.filterwarnings("ignore:Numcodecs codecs are not in the Zarr version 3")
@pytest.mark.parametrize("packer", PACKERS)
@pytest.mark.parametrize("sharded", [False, True])
def test_checksums_and_filters_are_read_from_v3(tmp_path: Path, packer: str, sharded: bool) -> None:
    """A checksum within the packed bytes is counted, one around them is not."""
    delta: Any = {"name": "numcodecs.delta", "configuration": {"dtype": "<u2", "astype": "<i4"}}
    packing: Any = [{"name": "crc32c"}, named(packer, 3), {"name": "crc32c"}]
    shape = {"chunks": (2, 3, 5), **({"shards": (4, 6, 5)} if sharded else {})}
    zarr.create_array(tmp_path / "a.zarr", data=CUBE, filters=[delta], compressors=packing, **shape)  # type: ignore[arg-type]
    np.testing.assert_array_equal(open_cube_source(tmp_path / "a.zarr").read(0, 4), CUBE)


@pytest.mark.filterwarnings("ignore:Numcodecs codecs are not in the Zarr version 3")
@pytest.mark.parametrize("place", ["filters", "codecs", "shard"])
def test_packing_twice_is_refused(tmp_path: Path, place: str) -> None:
    """A packed chunk in a packed chunk multiplies what a byte can stand for."""
    path = tmp_path / "a.zarr"
    if place == "filters":
        zarr.create_array(path, data=CUBE, zarr_format=2, filters=[numcodecs.LZ4()], compressors=numcodecs.Zlib())
    else:
        shards: Any = {"shards": CUBE.shape, "chunks": (2, 6, 5)} if place == "shard" else {}
        zarr.create_array(path, data=CUBE, **shards)
        change(path, codecs=[*json.loads((path / "zarr.json").read_text())["codecs"], named("gzip", 3)])
    with pytest.raises(SceneError, match=r"packs chunks twice, by .*; store them with one packer"):
        open_cube_source(path)


@pytest.mark.parametrize("codec", ["astype", "quantize", "fixedscaleoffset", "delta"])
@pytest.mark.parametrize("version", [2, 3])
def test_filters_of_texts_are_refused(tmp_path: Path, codec: str, version: int) -> None:
    """A number of one byte would become a text of megabytes."""
    wide = {"astype": {"encode_dtype": "|u1", "decode_dtype": "<U9999"}}.get(
        codec, {"dtype": "<U9999", "astype": "|u1"}
    )
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=CUBE, zarr_format=version, compressors=None)  # type: ignore[arg-type]
    if version == 2:
        change(path, filters=[{"id": codec, **wide}])
    else:
        codecs = json.loads((path / "zarr.json").read_text())["codecs"]
        change(path, codecs=[{"name": f"numcodecs.{codec}", "configuration": wide}, *codecs])
    with pytest.raises(SceneError, match=f"asks for the codec '(numcodecs.)?{codec}', which is not read"):
        open_cube_source(path)


def test_a_list_of_long_names_is_refused(tmp_path: Path) -> None:
    """Names of bands are read with the same limits as numbers."""
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
    group.create_array("cube", data=CUBE).attrs["_ARRAY_DIMENSIONS"] = ["y", "x", "band"]
    group.create_array("band_names", shape=(5,), chunks=(5,), dtype="<U2000000", compressors=numcodecs.BZ2())
    (tmp_path / "a.zarr/band_names/0").write_bytes(bz2_compress(bytes(5 * 8_000_000)))
    with pytest.raises(SceneError, match=r"band_names claims 40000000 bytes of numbers"):
        open_cube_source(tmp_path / "a.zarr:cube")


def test_hdf5_that_is_deflated_twice_is_refused(tmp_path: Path) -> None:
    """HDF5 unpacks by itself: once a byte becomes a kilobyte at most, twice a megabyte."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        how = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        how.set_chunk(CUBE.shape)
        how.set_deflate(9)
        how.set_deflate(9)
        cube = h5py.h5d.create(file.id, b"cube", h5py.h5t.NATIVE_UINT16, h5py.h5s.create_simple(CUBE.shape), how)
        h5py.Dataset(cube)[...] = CUBE
    with pytest.raises(SceneError, match=r"a\.h5:/cube is packed twice, by the HDF5 filters \[1, 1\]; repack it"):
        open_cube_source(tmp_path / "a.h5").read(0, 4)

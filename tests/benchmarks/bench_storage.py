"""Storage: our layout against plain zarr-python, and the spool's fraction of a core."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import zarr
from measure import Row, ratio, time_in_turn
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec

from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.source import Line, References
from spectralzoom.storage.arrays.cubes import RawCubeWriter, SweepHeader, open_raw_cube
from spectralzoom.storage.arrays.layout import SHARD_ROWS, image_spec
from spectralzoom.storage.arrays.spool import Spool

LINES, SAMPLES, BANDS = 256, 640, 270
SPOOLED = 640
RATE_HZ = 100.0
ROUNDS = 3


def rows() -> list[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        raw = _raw()
        return [*_against_zarr(folder, raw), _spool(folder, raw)]


def _raw() -> NDArray[np.uint16]:
    """Return counts with shot noise on a smooth signal, (line, sample, band)."""
    smooth = 1500 + 1000 * np.sin(np.linspace(0, 6, SAMPLES))[:, None] * np.cos(np.linspace(0, 3, BANDS))
    rng = np.random.default_rng(0)
    block = rng.poisson(np.broadcast_to(smooth, (SHARD_ROWS, SAMPLES, BANDS))).astype(np.uint16)
    return np.concatenate([np.roll(block, turn, axis=1) for turn in range(LINES // SHARD_ROWS)])


def _against_zarr(folder: Path, raw: NDArray[np.uint16]) -> list[Row]:
    """Compare our writer and reader with zarr alone, on a raw cube written 64 lines at a time and read whole."""
    lines = [Line(number, data, 0.0, 1e-4 * number, 0.1 * number, 100.0) for number, data in enumerate(raw)]
    frame = np.zeros((SAMPLES, BANDS), np.float32)
    references = References(frame, frame + 1000, np.ones(BANDS, np.float32))
    header = SweepHeader(Sweep("fine-0", "fine", "x", 0.0, 0.0, LINES), references, np.linspace(400, 1000, BANDS))
    spec = image_spec(("line", "sample", "band"), raw.shape, "<u2")

    def write_ours() -> None:
        shutil.rmtree(folder / "ours.zarr", ignore_errors=True)
        with RawCubeWriter(folder / "ours.zarr", header) as cube:
            for first in range(0, LINES, SHARD_ROWS):
                cube.write(lines[first : first + SHARD_ROWS])

    def write_plain() -> None:
        shutil.rmtree(folder / "plain.zarr", ignore_errors=True)
        blosc = BloscCodec(cname="zstd", clevel=3, shuffle=BloscShuffle.bitshuffle, typesize=2)
        layout = {"chunks": spec.chunk, "shards": spec.shard, "compressors": (blosc, Crc32cCodec())}
        array = zarr.create_array(folder / "plain.zarr", shape=spec.shape, dtype="<u2", **layout)
        for first in range(0, LINES, SHARD_ROWS):
            array[first : first + SHARD_ROWS] = raw[first : first + SHARD_ROWS]

    writes = time_in_turn({"ours": write_ours, "plain": write_plain}, ROUNDS)
    plain = zarr.open_array(folder / "plain.zarr", mode="r")
    cube = open_raw_cube(folder / "ours.zarr")
    reads = time_in_turn({"ours": cube.read, "plain": lambda: plain[...]}, ROUNDS)
    size = raw.nbytes / 1e6
    found = []
    for what, clocks in (("write", writes), ("read", reads)):
        fraction = ratio(clocks, "plain", "ours")
        ours, theirs = (f"{size / min(clocks[way].wall_s):.0f} MB/s" for way in ("ours", "plain"))
        name = f"{what} a raw cube of {size:.0f} MB: speed over plain zarr-python's"
        found.append(Row(name, f"{fraction:.0%}", ">= 80 %", fraction >= 0.8, f"{ours}, plain {theirs}"))
    return found


def _spool(folder: Path, raw: NDArray[np.uint16]) -> Row:
    """Append lines one by one at the spool's highest rate; a rig sends one every 10 ms."""
    lines = [Line(n, raw[n % LINES], 0.0, 0.0, n / RATE_HZ, 10.0) for n in range(SPOOLED)]
    slowest = 0.0
    with Spool.open(folder / "spool", SAMPLES, BANDS, header={"sweep": "bench"}) as spool:
        began, cpu = time.perf_counter(), time.process_time()
        for line in lines:
            before = time.perf_counter()
            spool.append(line)
            slowest = max(slowest, time.perf_counter() - before)
        spool.sync()
        cpu, wall = time.process_time() - cpu, time.perf_counter() - began
    fraction = cpu / SPOOLED * RATE_HZ
    return Row(
        f"spool, lines of {raw[0].nbytes / 1e3:.0f} KB at {RATE_HZ:.0f} Hz: fraction of one core",
        f"{fraction:.0%}",
        "<= 20 %",
        fraction <= 0.2,
        f"{wall / SPOOLED * 1e3:.2f} ms a line, the slowest {slowest * 1e3:.0f} ms",
    )

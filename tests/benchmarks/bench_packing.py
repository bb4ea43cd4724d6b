"""The archive tier: bytes of raw sweeps before and after pack, and the CPU time of packing and of reading."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from measure import Row

from storage.archive.archive import Archive, StageRef
from storage.arrays.layout import open_group, read_array
from storage.packed_arrays import raw_array
from storage.repacking import pack

MIXED = ("indian_pines/Indian_pines_corrected.npy", "headwall_references/darkReference.hdr", "emit_raw/*.hdr")
GOAL = 1.15  # bytes before over after, of a farm's raw sweeps


def rows() -> list[Row]:
    """A farm's sweeps, and real cubes where the data are there (`SPECTRALZOOM_DATA`)."""
    with tempfile.TemporaryDirectory() as name:
        archive = Path(name) / "archive"
        _survey(archive)
        _ingest(archive)
        opened = Archive.open(archive)
        reading = {ref.uri: _cpu(lambda ref=ref: _read(ref)) for ref in _raw(opened)}  # type: ignore[misc]
        before = {ref.uri: _bytes(ref) for ref in _raw(opened)}
        took = _cpu(lambda: pack(opened, older_than=0))
        states = {one.uri: one for one in pack(opened, older_than=0).stores}
        numbers = {ref.uri: sum(array.nbytes for array in _arrays(ref)) for ref in _raw(opened)}
        found = [_row(ref, before[ref.uri], reading[ref.uri], states[ref.uri].why) for ref in _raw(opened)]
        speed = sum(numbers.values()) / 1e6 / took
        return [
            *found,
            Row(f"pack {len(found)} stores", f"{took:.2f} s CPU", "-", None, f"{speed:.0f} MB/s of raw numbers"),
        ]


def _survey(archive: Path) -> None:
    from rich.console import Console

    from flows.publish.survey_command import run_survey
    from flows.settings.survey_settings import load_settings

    flags = {"scene": "farm", "size": "256x256", "seed": "5", "budget": "0.8", "engine": "plain", "controls": False}
    run_survey(load_settings(None, flags | {"out": str(archive)}), Console(quiet=True))


def _ingest(archive: Path) -> None:
    from rich.console import Console

    from flows.archive.ingest_command import IngestRequest, run_ingest

    data = Path(os.environ.get("SPECTRALZOOM_DATA", Path(__file__).parents[3] / "shared" / "data"))
    for pattern in MIXED:
        for path in sorted(data.glob(pattern)):
            run_ingest(IngestRequest(str(path), archive, None, None, None, None), Console(quiet=True))


def _raw(archive: Archive) -> list[StageRef]:
    return [*archive.refs("capture"), *archive.refs("ingest")]


def _arrays(ref: StageRef) -> list[zarr.Array[Any]]:
    return [array for cube in sorted(ref.path.glob("*.zarr")) if (array := raw_array(cube)) is not None]


def _read(ref: StageRef) -> None:
    for cube in sorted(ref.path.glob("*.zarr")):
        array = raw_array(cube)
        if array is not None:
            read_array(open_group(cube), array.basename)


def _bytes(ref: StageRef) -> int:
    return sum(path.stat().st_size for path in ref.path.rglob("*") if path.is_file())


def _cpu(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def _row(ref: StageRef, before: int, reading: float, why: str) -> Row:
    arrays = _arrays(ref)
    kinds = ", ".join(sorted({f"{np.dtype(array.dtype)}" for array in arrays}))
    shapes = ", ".join("x".join(map(str, array.shape)) for array in arrays[:2])
    after, again = _bytes(ref), _cpu(lambda: _read(ref))
    figure = f"{before / 1e6:.2f} -> {after / 1e6:.2f} MB, {before / after:.2f}"
    met = before / after >= GOAL if ref.stage == "capture" else None
    words = f"read {reading * 1e3:.0f} -> {again * 1e3:.0f} ms CPU" if after < before else why
    goal = f">= {GOAL} times" if ref.stage == "capture" else "-"
    return Row(f"{ref.stage} {kinds} {shapes}", figure, goal, met, words)

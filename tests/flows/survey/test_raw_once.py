"""Raw lines lie in an archive once, and pictures of them are drawn without reading them again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from rich.console import Console

from flows.publish.run_folder import Published
from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from storage.archive.archive import Archive
from storage.arrays.cubes import RawCube, open_raw_cube
from storage.arrays.quicklooks import pictures_of


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Published]:
    """An archive with one survey, which nobody changes, and what it published."""
    root = tmp_path_factory.mktemp("raw") / "archive"
    return root, _survey(root)


def _survey(root: Path) -> Published:
    """A small farm in as many bands as light with a spectrum needs."""
    flags = {
        "scene": "farm",
        "size": "384x288",
        "bands": ",".join(map(str, range(5, 265, 10))),
        "engine": "plain",
        "controls": False,
        "budget": "0.95",
        "out": str(root),
    }
    return run_survey(load_settings(None, flags), Console(quiet=True))


@pytest.fixture
def copied(surveyed: tuple[Path, Published], tmp_path: Path) -> Path:
    """A copy of that archive."""
    return Path(shutil.copytree(surveyed[0], tmp_path / "archive"))


def _arrays(root: Path) -> Iterator[tuple[Path, zarr.Array[Any]]]:
    """Every array of every store, with its folder."""
    for about in sorted((root / "stages").rglob("zarr.json")):
        if json.loads(about.read_text())["node_type"] == "array":
            yield about.parent, zarr.open_array(about.parent, mode="r")


def _dims(array: zarr.Array[Any]) -> tuple[str, ...]:
    return tuple(getattr(array.metadata, "dimension_names", None) or ())


def test_raw_is_stored_once_and_as_uint16(surveyed: tuple[Path, Published]) -> None:
    """Every captured line is in one array; no spool is left, and nothing else holds lines of all bands."""
    root, published = surveyed
    by_line = [(path, array) for path, array in _arrays(root) if {"line", "band"} <= set(_dims(array))]
    assert {path.name for path, _ in by_line} == {"dn"}
    assert {array.dtype for _, array in by_line} == {np.dtype(np.uint16)}
    sweeps = [open_raw_cube(path.parent).sweep.name for path, _ in by_line]
    assert len(sweeps) == len(set(sweeps))
    assert sum(array.shape[0] for _, array in by_line) == published.receipt["savings"]["lines"]["done"]
    assert [path for path in (root / "spool").rglob("*") if path.is_file()] == []


def test_no_array_holds_the_raw_numbers_under_another_name(surveyed: tuple[Path, Published]) -> None:
    """Not as uint16 of any shape but the cubes', and what is derived at coarse scale is smaller than they are."""
    root, _ = surveyed
    raw = {path for path, _ in _arrays(root) if path.name == "dn"}
    assert not [path for path, array in _arrays(root) if array.dtype == np.uint16 and path not in raw]
    largest = max(array.nbytes for path, array in _arrays(root) if path in raw)
    mosaics = [array for path, array in _arrays(root) if path.match("rectify/*/mosaic.zarr/values")]
    assert len(mosaics) == 1
    assert mosaics[0].size * 2 <= largest


def test_both_sides_of_the_ledger_count_one_representation(surveyed: tuple[Path, Published]) -> None:
    """Stored bytes of a full scan are its raw bytes at the ratio at which this survey's own fine lines were stored."""
    root, published = surveyed
    archive, savings = Archive.open(root, create=False, write=False), published.receipt["savings"]
    size: dict[str, int] = {}
    raw: dict[str, int] = {}
    for name in ("raw_coarse", "raw_fine"):
        _, stage, key = published.receipt["products"][name].split("/")
        ref = archive.find(stage, key)
        assert ref is not None
        size[name] = archive.stored_bytes(ref)
        raw[name] = sum(open_raw_cube(path).read().nbytes for path in ref.path.glob("*.zarr"))
    assert savings["bytes_raw"]["done"] == sum(raw.values())
    assert savings["bytes_stored"]["done"] == sum(size.values())
    ratio = size["raw_fine"] / raw["raw_fine"]
    assert savings["bytes_stored"]["full"] == round(savings["bytes_raw"]["full"] * ratio)


def test_the_picture_of_raw_lines_reads_no_raw_line(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A warm survey draws it from the quicklooks alone."""

    def read(*given: object) -> None:
        raise AssertionError("a cube was scanned for a picture")

    monkeypatch.setattr(RawCube, "read", read)
    monkeypatch.setattr(RawCube, "read_window", read)
    assert (_survey(copied).folder / "quicklook.png").stat().st_size > 10_000
    stores = [ref.path for stage in ("capture", "rectify") for ref in Archive.open(copied).refs(stage)]
    assert all(pictures_of(store) for store in stores)

"""Raw lines lie in an archive once, packing them changes no figure, and the command says what it saved."""

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

from flows.publish.receipt import comparable
from flows.publish.run_folder import Published
from flows.publish.survey_command import run_survey
from flows.settings.survey_settings import load_settings
from storage.archive.archive import Archive
from storage.arrays.cubes import RawCube, open_raw_cube
from storage.arrays.quicklooks import pictures_of
from tests.flows.conftest import CommandLine


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Published]:
    """An archive with one survey, which nobody changes, and what it published."""
    root = tmp_path_factory.mktemp("pack") / "archive"
    return root, _survey(root)


def _survey(root: Path) -> Published:
    """A small farm in as many bands as light with a spectrum needs."""
    flags = {
        "scene": "farm", "size": "384x288", "bands": ",".join(map(str, range(5, 265, 10))), "engine": "plain",
        "controls": False, "budget": "0.95", "out": str(root),
    }  # fmt: skip
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


def test_packing_changes_no_figure(surveyed: tuple[Path, Published], command_line: CommandLine, tmp_path: Path) -> None:
    """The same survey finds every stage in the packed archive, and its receipt is the one of before."""
    root, published = surveyed
    copy = Path(shutil.copytree(root, tmp_path / "archive"))
    assert command_line("pack", copy, "--older-than", "0").code == 0
    again = _survey(copy).receipt
    assert {stage["state"] for stage in again["stages"]} <= {"cached", "skipped"}
    assert comparable(again) == comparable(published.receipt)
    assert command_line("verify", copy).code == 0


def test_the_picture_of_raw_lines_reads_no_raw_line(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A warm survey draws it from the quicklooks alone."""

    def read(*given: object) -> None:
        raise AssertionError("a cube was scanned for a picture")

    monkeypatch.setattr(RawCube, "read", read)
    monkeypatch.setattr(RawCube, "read_window", read)
    assert (_survey(copied).folder / "quicklook.png").stat().st_size > 10_000
    stores = [ref.path for stage in ("capture", "rectify") for ref in Archive.open(copied).refs(stage)]
    assert all(pictures_of(store) for store in stores)


def test_pack_says_what_it_saved(copied: Path, command_line: CommandLine) -> None:
    """In a table, with its sum; a second time there is nothing to do."""
    done = command_line("pack", copied, "--older-than", "0")
    assert done.code == 0
    assert "ratio" in done.out
    assert "2 of 2 raw stores packed" in done.out
    assert "Zarr version 3 specification" not in done.err
    assert "2 left as stored: packed already\n0 of 2 raw stores packed, 0 B saved" in command_line(
        "pack", copied, "--older-than", "0"
    ).out  # fmt: skip


def test_a_dry_run_changes_nothing(copied: Path, command_line: CommandLine) -> None:
    """It names what would be packed, and why the rest would not."""
    before = {path: path.stat().st_mtime_ns for path in copied.rglob("*")}
    done = command_line("pack", copied, "--older-than", "0", "--dry-run", "--json")
    content = json.loads(done.out)
    assert [store["state"] for store in content["stores"]] == ["to pack", "to pack"]
    assert (content["bytes_saved"], content["obstacle"]) == (0, None)
    assert "2 left as stored: younger than 30 days" in command_line("pack", copied, "--dry-run").out
    assert {path: path.stat().st_mtime_ns for path in copied.rglob("*")} == before


def test_json_has_every_store(copied: Path, command_line: CommandLine) -> None:
    """One object on stdout, with bytes and ratio."""
    content = json.loads(command_line("pack", copied, "--older-than", "0", "--json").out)
    assert content["bytes_saved"] == sum(store["before"] - store["after"] for store in content["stores"]) > 0
    assert all(store["ratio"] == store["before"] / store["after"] for store in content["stores"])


def test_an_archive_in_use_ends_with_code_3(copied: Path, command_line: CommandLine) -> None:
    """And a sentence; numbers of days that are none with 2."""
    with Archive.open(copied).in_use():
        done = command_line("pack", copied, "--older-than", "0")
    assert done.code == 3
    assert "somebody is using the archive: run pack again when it is free" in done.out
    refused = command_line("pack", copied, "--older-than", "-1")
    assert (refused.code, len(refused.errors)) == (2, 1)
    assert command_line("pack", copied / "nowhere").code == 1


def test_a_damaged_store_ends_with_code_3(copied: Path, command_line: CommandLine) -> None:
    """It is named and left; the others are packed."""
    shard = next(copied.glob("stages/capture/*/*.zarr/dn/c/0/0/0"))
    shard.write_bytes(shard.read_bytes()[:-1])
    done = command_line("pack", copied, "--older-than", "0")
    assert done.code == 3
    assert "1 of 2 raw stores packed" in done.out
    assert "dn/c/0/0/0 has" in done.out

"""Verification finds every changed bit and names the store and file that hold it."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.storage.arrays.layout import create_group, open_group, read_array, write_image, write_small
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive, Ref
from tests.storage.small_archive import flip, small_survey


def _with_cube(archive: Archive) -> Ref:
    """Make a store with a cube of (130, 700, 3): shards of 64 rows and 640 columns, chunks of 32 x 32."""
    values = np.random.default_rng(2).integers(0, 4096, (130, 700, 3), dtype=np.uint16)

    def build(path: Path) -> None:
        group = create_group(path / "mosaic.zarr", "a cube", {})
        write_image(group, "values", ("y", "x", "band"), values, {})
        write_small(group, "wavelength", ("band",), np.arange(3.0), {})

    return archive.produce("rectify", build, version=1, params={})[0]


def _found(archive: Archive) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for one in verify_everything(archive):
        if one.problem is not None:
            found.setdefault(one.uri, []).append(one.problem)
    return found


def test_verify_finds_flipped_bits_in_any_file(tmp_path: Path, archive: Archive) -> None:
    """30 places are drawn from all bytes and all files, manifests and receipts among them."""
    small_survey(archive)
    _with_cube(archive)
    files = [path for path in sorted(tmp_path.rglob("*")) if path.is_file() and path.suffix != ".lock"]
    chance = random.Random(4)
    for number in range(30):
        weights = [path.stat().st_size if number % 2 else 1 for path in files]
        (path,) = chance.choices(files, weights)
        at, bit = chance.randrange(path.stat().st_size), chance.randrange(8)
        flip(path, at, bit)
        place = next(parent for parent in path.parents if (parent / "manifest.json").is_file())
        problems = _found(archive)[place.relative_to(tmp_path).as_posix()]
        assert any(path.relative_to(place).as_posix() in problem for problem in problems), (path, at, bit, problems)
        flip(path, at, bit)
    assert _found(archive) == {}


@pytest.mark.parametrize("at", [0, 1000, -10])
def test_a_flipped_bit_in_a_shard_raises_an_error(archive: Archive, at: int) -> None:
    """Chunks and the shard's index have checksums; other shards are still read as written."""
    ref = _with_cube(archive)
    before = read_array(open_group(ref.path / "mosaic.zarr"), "values")
    flip(ref.path / "mosaic.zarr/values/c/0/0/0", at=at)
    with pytest.raises(IncompleteStoreError, match=r"mosaic\.zarr/values cannot be read"):
        read_array(open_group(ref.path / "mosaic.zarr"), "values")
    there = read_array(open_group(ref.path / "mosaic.zarr"), "values", (slice(64, 130),))
    np.testing.assert_array_equal(there, before[64:])


def test_missing_short_and_extra_files_each_have_a_finding(archive: Archive) -> None:
    """Each finding names its file."""
    ref = _with_cube(archive)
    values = ref.path / "mosaic.zarr/values"
    (values / "c/0/0/0").unlink()
    (values / "c/1/0/0").write_bytes((values / "c/1/0/0").read_bytes()[:-50])
    (values / "notes.txt").write_text("x")
    missing, short, extra = sorted(_found(archive)[ref.uri])
    assert missing == "mosaic.zarr/values/c/0/0/0 cannot be read: it is missing"
    assert "mosaic.zarr/values/c/1/0/0 has" in short
    assert "values/notes.txt is not in the manifest" in extra


def test_verify_reports_lost_manifests_and_lost_stores(tmp_path: Path, archive: Archive) -> None:
    """A lost store is known by the run that names it, a lost manifest by its folder; stray files are reported."""
    small = small_survey(archive)
    (small.mosaic.path / "manifest.json").unlink()
    with pytest.raises(IncompleteStoreError, match="it is missing"):
        archive.find("rectify", small.mosaic.key)
    shutil.rmtree(small.raw.path)
    (tmp_path / "stages" / "note.txt").write_text("x")
    found = _found(archive)
    assert f"is not there, but runs/{small.run.name} names it" in found.pop(small.raw.uri)
    assert "manifest.json is missing" in found.pop(small.mosaic.uri)
    assert "expected a folder" in found.pop("stages/note.txt")[0]
    assert found == {}


def test_verify_reports_a_missing_store_once(archive: Archive) -> None:
    """Two runs that name the store give one finding; without a run, its dependent store reveals it."""
    small, other = small_survey(archive), small_survey(archive, seed=1, named=False)
    small_survey(archive)
    for ref in (small.mosaic, other.mosaic):
        archive.discard(ref)
    gone = [one for one in verify_everything(archive) if one.kind == "missing"]
    assert [one.uri for one in gone] == [small.mosaic.uri, other.mosaic.key]
    assert f"is not there, but {other.map.uri} was made of it" in str(gone[1].problem)


def test_a_store_removed_during_verify_is_not_damage(archive: Archive) -> None:
    """gc may run at the same time; a store that a run names must be there."""
    named, other = small_survey(archive), small_survey(archive, seed=1, named=False)

    def clear(ref: Ref) -> list[str]:
        return [one.uri for one in verify_everything(archive, lambda *_: archive.discard(ref) and None) if one.problem]

    assert clear(other.map) == []
    assert clear(named.map) == [named.map.uri]

"""Packing changes the bytes of raw sweeps and nothing else, and a kill leaves the store as it was or as it will be."""

from __future__ import annotations

import errno
import importlib
import json
import os
import random
import shutil
import sys
import threading
import warnings
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr
from numpy.typing import NDArray

from pipeline.errors import ArchiveError, IncompleteStoreError, SettingsError
from pipeline.geometry.scan import Sweep
from pipeline.source import Line, References
from storage import packed_arrays, repacking
from storage.archive import folder_exchange, manifests
from storage.archive.archive import Archive, StageRef
from storage.archive.folder_exchange import exchange
from storage.archive_codec import PCODEC_NAME
from storage.arrays import layout
from storage.arrays.cubes import RawCubeWriter, SweepHeader, open_raw_cube
from storage.cube_sources import CubeSource, LineFacts
from storage.ingested_cubes import write_ingested_cube
from storage.maintenance.garbage import clear_up
from storage.packed_arrays import values_hash
from storage.repacking import IN_USE, PACKED_ALREADY, Packing, pack, plan_packing
from storage.scan_files import open_cube_source
from tests.storage.small_archive import flip

FLIPS = 60
KILLS = 6
BANDS = 20


def _light(lines: int, samples: int = 90, seed: int = 1) -> NDArray[np.uint16]:
    """Counts with shot noise under a smooth spectrum, (line, sample, band)."""
    rng = np.random.default_rng(seed)
    level = 400 + 300 * np.sin(np.arange(BANDS) / 4) + rng.uniform(0, 200, (lines, samples, 1))
    return rng.poisson(level).astype(np.uint16)


def _capture(archive: Archive, seed: int = 1, *, sweeps: tuple[int, ...] = (130, 37)) -> StageRef:
    """A capture of sweeps of so many lines, and a run that rests on it."""

    def build(path: Path) -> None:
        for number, lines in enumerate(sweeps):
            frame = np.full((90, BANDS), 64, np.float32)
            references = References(frame, frame * 20, np.ones(BANDS, np.float32))
            sweep = Sweep(f"fine-{number}", "fine", "y", 0.0, 0.0, lines)
            header = SweepHeader(sweep, references, np.linspace(400, 900, BANDS))
            with RawCubeWriter(path / f"fine-{number}.zarr", header) as cube:
                cube.write([Line(n, data, 0.0, 0.0, n / 9, 9.0) for n, data in enumerate(_light(lines, seed=seed))])

    ref = archive.produce("capture", build, version=2, params={"source": "rig", "seed": seed}, work=167.0)[0]
    with archive.new_run("farm") as draft:
        draft.write_file("receipt.json", json.dumps({"settings": {"source": "rig"}, "products": {"raw": ref.uri}}))
        draft.publish(rests_on=archive.manifest_hashes([ref]))
    return ref


def _ingest(archive: Archive, values: NDArray[np.generic]) -> StageRef:
    def build(path: Path) -> None:
        facts = LineFacts(np.ones(len(values), np.bool_))
        shape = (values.shape[0], values.shape[1], values.shape[2])
        source = CubeSource("a.npy", shape, values.dtype, lambda a, b: values[a:b], (), facts)
        write_ingested_cube(path, source, [], name="a")

    return archive.produce("ingest", build, version=1, params={"kind": values.dtype.str})[0]


def _problems(archive: Archive) -> list[str]:
    return [f"{one.uri}: {one.problem}" for one in archive.verify_all() if one.problem is not None]


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """An archive with one capture that a run names."""
    opened = Archive.open(tmp_path / "a")
    _capture(opened)
    return opened


def test_numbers_stay_and_bytes_shrink(archive: Archive) -> None:
    """Every number, coordinate and attribute is as it was; codec, sizes and the manifest are not."""
    (ref,) = archive.refs()
    paths = sorted(ref.path.glob("*.zarr"))
    before = [xr.open_zarr(path, consolidated=False).load() for path in paths]
    hashes, manifest = [values_hash(path) for path in paths], archive.manifest(ref)
    (one,) = pack(archive, older_than=0).stores
    assert one.state == "packed"
    assert one.after is not None
    assert one.after < 0.95 * one.before
    for path, was in zip(paths, before, strict=True):
        xr.testing.assert_identical(xr.open_zarr(path, consolidated=False).load(), was)
        codecs = json.loads((path / "dn" / "zarr.json").read_text())["codecs"][0]["configuration"]["codecs"]
        assert [codec["name"] for codec in codecs] == [PCODEC_NAME, "crc32c"]
    after = archive.manifest(ref)
    assert [values_hash(path) for path in paths] == hashes == list(after["packed"]["values"].values())
    kept = ("stage", "key", "version", "params", "inputs", "cost", "created", "libraries")
    assert [after[name] for name in kept] == [manifest[name] for name in kept]


def test_readers_and_the_archive_agree_with_what_was_packed(archive: Archive) -> None:
    """verify, gc and the run that knew the old manifest find nothing wrong; a second pack finds nothing to do."""
    (ref,) = archive.refs()
    size, cost = archive.stored_bytes(ref), archive.cost(ref)
    known = archive.manifest_hash(ref)
    pack(archive, older_than=0)
    assert archive.manifest_hash(ref) != known
    assert archive.manifest(ref)["packed"]["manifests"] == [known]
    assert _problems(archive) == []
    assert clear_up(archive, keep_days=0, raw_too=True).removals == ()
    assert (archive.stored_bytes(ref), archive.cost(ref)) == (size, cost)
    assert [(one.state, one.why) for one in pack(archive, older_than=0).stores] == [("skipped", PACKED_ALREADY)]


def test_bits_that_flip_in_a_packed_store_are_found(archive: Archive) -> None:
    """Anywhere in its files, the manifest with its chain among them."""
    pack(archive, older_than=0)
    (ref,) = archive.refs()
    files = [path for path in sorted(ref.path.rglob("*")) if path.is_file()]
    chance = random.Random(6)
    for number in range(FLIPS):
        (path,) = chance.choices(files, [path.stat().st_size if number % 2 else 1 for path in files])
        at, bit = chance.randrange(path.stat().st_size), chance.randrange(8)
        flip(path, at, bit)
        assert any(path.name in problem for problem in _problems(archive)), (path, at, bit)
        flip(path, at, bit)
    assert _problems(archive) == []


def _resealed(ref: StageRef, change: Callable[[dict[str, object]], None]) -> None:
    """Change a manifest by hand and seal it as if it were right."""
    from storage.archive.manifests import _seal, _text

    path = ref.path / "manifest.json"
    content = json.loads(path.read_text())
    del content["seal"]
    change(content["packed"])
    path.write_text(_text(content | {"seal": _seal(content)}))


def test_a_chain_that_does_not_lead_to_what_a_run_knows_is_told(archive: Archive) -> None:
    """Even under a seal that fits: the run knows which manifest it was."""
    pack(archive, older_than=0)
    (ref,) = archive.refs()
    _resealed(ref, lambda packed: packed.update(manifests=["0" * 64]))
    (problem,) = _problems(archive)
    assert "has changed since runs/" in problem


@pytest.mark.parametrize("values", [{"fine-0.zarr": "0" * 64}, {"../elsewhere": "0" * 64}])
def test_other_numbers_than_before_are_told(archive: Archive, values: dict[str, str]) -> None:
    """Even where files, manifest and chain fit each other."""
    pack(archive, older_than=0)
    (ref,) = archive.refs()
    _resealed(ref, lambda packed: packed.update(values=values))
    (problem,) = _problems(archive)
    assert "has other numbers than it had before it was packed" in problem


def test_no_flipped_bit_of_a_packed_shard_is_read_silently(archive: Archive) -> None:
    """The checksum after pcodec stands for every chunk."""
    pack(archive, older_than=0)
    (ref,) = archive.refs()
    shard = ref.path / "fine-0.zarr/dn/c/0/0/0"
    for at in (0, 500, -10):
        flip(shard, at)
        with pytest.raises(IncompleteStoreError, match="dn cannot be read"):
            open_raw_cube(ref.path / "fine-0.zarr").read(0, 64)
        flip(shard, at)
    flip(shard, 500)
    assert any("unreadable: lines 0 to 31, samples 0 to 31" in problem for problem in _problems(archive))


def test_a_damaged_store_gets_no_new_seal(archive: Archive) -> None:
    """It stays as it is, and is named."""
    (ref,) = archive.refs()
    flip(ref.path / "fine-1.zarr/time/c/0")
    before = archive.manifest_hash(ref)
    (one,) = pack(archive, older_than=0).stores
    assert one.state == "failed"
    assert "fine-1.zarr/time/c/0 has changed since it was published" in one.why
    assert archive.manifest_hash(ref) == before
    assert not list(ref.path.parent.glob("*.part"))


@pytest.mark.parametrize("name", ["fine-0.zarr/time/c/0", "fine-1.zarr/zarr.json"])
def test_a_file_that_changes_on_its_way_gets_no_seal(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Between its check and its copy, or in the copy: the store stays as it is."""
    (ref,) = archive.refs()
    before, copy = archive.manifest_hash(ref), shutil.copyfile

    def spoiling(path: Path, to: Path) -> None:
        copy(path, to)
        if path == ref.path / name:
            to.write_bytes(to.read_bytes() + b" ")

    monkeypatch.setattr(shutil, "copyfile", spoiling)
    (one,) = pack(archive, older_than=0).stores
    assert one.state == "failed"
    assert f"{name} changed while it was copied" in one.why
    assert archive.manifest_hash(ref) == before
    assert not list(ref.path.parent.glob("*.part"))


def test_verify_does_not_doubt_what_is_packed_meanwhile(archive: Archive) -> None:
    """Neither a store that is packed before it is read again, nor one that is packed while it is read."""
    _capture(archive, seed=2)
    states: list[str] = []

    def progress(uri: str, done: float) -> None:
        if uri.startswith("stages/") and not states:
            states.extend(one.state for one in pack(archive, older_than=0).stores)

    assert [one.problem for one in archive.verify_all(progress) if one.problem is not None] == []
    assert states == ["packed", "packed"]


def test_verify_reads_a_store_again_that_was_exchanged_under_it(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it had read of the store before does not count against the store after."""
    (ref,) = archive.refs()
    packed: list[int] = []
    hashed = manifests.file_hash

    def packing(path: Path) -> str:
        digest = hashed(path)
        if path == ref.path / "fine-1.zarr/dn/c/0/0/0" and not packed:
            packed.append(0)
            packed[0] = pack(Archive.open(archive.root), older_than=0).saved
        return digest

    monkeypatch.setattr(manifests, "file_hash", packing)
    assert _problems(archive) == []
    assert packed[0] > 0


def test_a_reader_whose_store_is_packed_under_it_reads_the_same(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even between an array's description and its numbers; damage is still told."""
    (ref,) = archive.refs()
    cube = open_raw_cube(ref.path / "fine-0.zarr")
    before, read = cube.read(), zarr.Array.__getitem__
    states: list[str] = []

    def packing(array: zarr.Array[Any], place: object) -> object:
        if array.basename == "dn" and not states:
            states.append("")
            states.extend(one.state for one in pack(archive, older_than=0).stores)
        return read(array, place)  # type: ignore[arg-type]

    monkeypatch.setattr(zarr.Array, "__getitem__", packing)
    np.testing.assert_array_equal(cube.read(), before)
    assert states == ["", "packed"]
    flip(ref.path / "fine-0.zarr/dn/c/0/0/0")
    with pytest.raises(IncompleteStoreError, match="dn cannot be read"):
        cube.read()


def test_what_does_not_read_back_is_not_swapped_in(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """A codec that changes a number is found before the store is touched."""
    (ref,) = archive.refs()
    before = archive.manifest_hash(ref)
    create = layout.create_array

    def spoiling(*given: object, **more: object) -> object:
        array = create(*given, **{**more, "tier": "live"})  # type: ignore[arg-type]

        class Spoilt:
            def __setitem__(self, place: slice, block: NDArray[np.uint16]) -> None:
                array[place] = block ^ (np.arange(block.size).reshape(block.shape) == 77)

            def __getitem__(self, place: slice) -> object:
                return array[place]

        return Spoilt()

    monkeypatch.setattr(packed_arrays, "create_array", spoiling)
    with pytest.raises(ArchiveError, match="lines 0 to 63 do not read back as they were written; nothing was changed"):
        pack(archive, older_than=0)
    assert archive.manifest_hash(ref) == before
    assert _problems(archive) == []
    assert not list(ref.path.parent.glob("*.part"))


def test_only_old_stores_are_packed(archive: Archive) -> None:
    """Age counts from when a store was made; a clock that runs ahead makes it young."""
    _capture(archive, seed=2)
    soon = datetime.now(UTC) + timedelta(days=29)
    assert {one.why for one in plan_packing(archive, now=soon)} == {"younger than 30 days"}
    later = datetime.now(UTC) + timedelta(days=31)
    assert [one.state for one in plan_packing(archive, now=later)] == ["to pack", "to pack"]
    assert [one.state for one in plan_packing(archive, now=datetime(2000, 1, 1, tzinfo=UTC), older_than=0)] == [
        "skipped", "skipped"
    ]  # fmt: skip
    for wrong in (-1.0, float("nan")):
        with pytest.raises(SettingsError, match="expected a number of days"):
            pack(archive, older_than=wrong)


def test_ingested_cubes_are_packed_where_they_hold_uint16(tmp_path: Path) -> None:
    """Others are left alone, with the reason, and so is what is no raw store."""
    archive = Archive.open(tmp_path)
    refs = [_ingest(archive, _light(70).astype(kind)) for kind in (np.uint16, np.float32, np.uint8)]
    archive.produce("rectify", lambda path: (path / "x").touch(), version=1, params={})
    found = {one.uri: one for one in pack(archive, older_than=0).stores}
    assert len(found) == 3
    assert [found[ref.uri].state for ref in refs] == ["packed", "skipped", "skipped"]
    assert found[refs[1].uri].why == "holds float32: only uint16 is packed, raw numbers as a camera gives them"
    assert found[refs[2].uri].why.startswith("holds uint8")
    source = open_cube_source(str(refs[0].path / "cube.zarr"))
    np.testing.assert_array_equal(source.read(0, 70), _light(70))
    assert _problems(archive) == []


def test_what_would_not_become_smaller_stays(tmp_path: Path) -> None:
    """Pure chance takes its bits with any codec."""
    archive = Archive.open(tmp_path)
    ref = _ingest(archive, np.random.default_rng(1).integers(0, 1 << 16, (64, 64, 30), np.uint16))
    before = archive.manifest_hash(ref)
    assert [(one.state, one.why) for one in pack(archive, older_than=0).stores] == [
        ("skipped", "would save less than 1%")
    ]
    assert archive.manifest_hash(ref) == before
    assert not list(ref.path.parent.glob("*.part"))


def test_an_archive_in_use_is_left_alone(archive: Archive) -> None:
    """Nothing waits: pack says so, and packs when the other has ended."""
    with archive.in_use():
        done = pack(archive, older_than=0)
        assert (done.obstacle, done.saved) == (IN_USE, 0)
        assert [one.state for one in done.stores] == ["to pack"]
    assert pack(archive, older_than=0).saved > 0


def test_somebody_who_waits_comes_in_between(archive: Archive) -> None:
    """The archive is free between two stores; what was packed by then is told, and the rest is packed later."""
    _capture(archive, seed=2)
    begun, enough = threading.Event(), threading.Event()

    def survey() -> None:
        begun.wait(20)
        with archive.in_use():
            enough.wait(20)

    other = threading.Thread(target=survey)
    other.start()
    done = pack(archive, older_than=0, progress=lambda uri, share: begun.set())
    enough.set()
    other.join()
    assert done.obstacle == IN_USE
    assert [one.state for one in done.stores] == ["packed", "to pack"]
    assert [one.state for one in pack(archive, older_than=0).stores] == ["skipped", "packed"]


def test_a_file_system_that_cannot_exchange_refuses(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is changed, and the message says what to do."""
    (ref,) = archive.refs()
    before = archive.manifest_hash(ref)
    monkeypatch.setattr(folder_exchange, "_renameat2", lambda one, other: errno.EINVAL)
    with pytest.raises(ArchiveError, match=r"cannot exchange two folders in one step.*pack a copy of the archive"):
        pack(archive, older_than=0)
    assert archive.manifest_hash(ref) == before
    assert not list(ref.path.parent.glob("*.part"))


def test_folders_exchange_their_names(tmp_path: Path) -> None:
    """Each has what the other had; a name that leads nowhere is the system's own error."""
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "who").write_text(name)
    exchange(tmp_path / "a", tmp_path / "b")
    assert [(tmp_path / name / "who").read_text() for name in "ab"] == ["b", "a"]
    with pytest.raises(FileNotFoundError):
        exchange(tmp_path / "a", tmp_path / "c")


def _killed(archive: Archive, at: float, count: Path | None = None) -> bool:
    """Pack in a process that dies at the ``at``-th thing it asks of the archive's files; whether it died."""
    child = os.fork()
    if child == 0:
        asked = 0

        def watch(event: str, given: tuple[object, ...]) -> None:
            nonlocal asked
            if event in ("open", "os.rename", "os.remove", "os.rmdir", "os.mkdir"):
                asked += event.startswith("os.r") or str(archive.root) in str(given[0])  # trees go by names alone
                if asked >= at:
                    os._exit(9)

        sys.addaudithook(watch)
        try:
            repacking.pack(Archive.open(archive.root), older_than=0)
            if count is not None:
                count.write_text(str(asked))
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


def test_a_kill_anywhere_leaves_the_store_whole(tmp_path: Path) -> None:
    """Under its key lies what was there or what will be; numbers are the same, and the next pack ends the work."""
    archive = Archive.open(tmp_path / "a")
    ref = _capture(archive, sweeps=(70,))
    path, truth = ref.path / "fine-0.zarr", values_hash(ref.path / "fine-0.zarr")
    old = archive.manifest_hash(ref)
    shutil.copytree(ref.path, tmp_path / "copy")
    assert not _killed(archive, float("inf"), tmp_path / "count")
    count = int((tmp_path / "count").read_text())
    died, seen = 0, set[str]()
    for at in (*np.linspace(1, count, KILLS).astype(int).tolist(), *range(count - 7 * KILLS, count, 7)):
        shutil.rmtree(ref.path.parent)
        shutil.copytree(tmp_path / "copy", ref.path)
        died += _killed(archive, at)
        assert _problems(archive) == []
        assert values_hash(path) == truth
        seen.add("old" if archive.manifest_hash(ref) == old else "new")
    assert died >= 2 * KILLS - 3  # a thread may ask once more or less
    assert seen == {"old", "new"}
    assert pack(archive, older_than=0).obstacle is None
    assert archive.manifest(ref)["packed"]["manifests"] == [old]
    assert not list(ref.path.parent.glob("*.part"))


def test_a_missing_codec_is_one_clear_message(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading and verifying say what to install, and that nothing is damaged."""
    pack(archive, older_than=0)
    (ref,) = archive.refs()
    registry = importlib.import_module("numcodecs.registry").codec_registry
    monkeypatch.delitem(registry, "pcodec")
    cube = open_raw_cube(ref.path / "fine-0.zarr")
    words = r"packed with pcodec, which is not installed; pip install pcodec \(nothing is damaged\)"
    with pytest.raises(IncompleteStoreError, match=words):
        cube.read(0, 1)
    with pytest.raises(IncompleteStoreError, match=words):
        archive.verify_all()


def test_no_warning_of_the_codec_reaches_anybody(archive: Archive) -> None:
    """Neither packing, reading, verifying nor opening as a scene warns; other warnings of zarr still do."""
    (ref,) = archive.refs()
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        pack(archive, older_than=0)
        open_raw_cube(ref.path / "fine-0.zarr").read()
        archive.verify_all()
        open_cube_source(str(ref.path / "fine-0.zarr")).read(0, 3)
        assert [str(one.message) for one in heard] == []
        from zarr.errors import ZarrUserWarning

        warnings.warn("something else", ZarrUserWarning, stacklevel=1)
        assert [str(one.message) for one in heard] == ["something else"]


def test_progress_goes_up_to_all_of_it(archive: Archive) -> None:
    """By the bytes of the stores."""
    _capture(archive, seed=2)
    seen: list[float] = []
    done = pack(archive, older_than=0, progress=lambda uri, share: seen.append(share))
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(1.0)
    assert {one.state for one in done.stores} == {"packed"}
    assert done.saved == sum(one.before - (one.after or 0) for one in done.stores)


@pytest.mark.parametrize("verb", [pack, plan_packing])
def test_an_archive_in_a_bucket_is_refused(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, verb: Callable[[Archive], object]
) -> None:
    """By what would only look, too: nothing there can be packed."""
    monkeypatch.setattr(archive, "in_bucket", True)
    with pytest.raises(ArchiveError, match="is in a bucket, where no store can change: copy it to a disk"):
        verb(archive)


def test_another_process_at_a_store_leaves_it(archive: Archive) -> None:
    """Whoever holds its lock is not waited for."""
    (ref,) = archive.refs()
    with archive._locked(f"{ref.stage}-{ref.key}"):
        (one,) = pack(archive, older_than=0).stores
    assert one == Packing(ref.uri, "failed", one.before, None, "another process works on it")

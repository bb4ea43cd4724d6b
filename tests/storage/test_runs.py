"""Runs appear whole and keep their stores; verify finds every change, and gc removes only what is not needed."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, NoRunError, SettingsError
from spectralzoom.storage import runs
from spectralzoom.storage.runs import (
    IN_USE,
    Catalogue,
    Clearance,
    Removal,
    Run,
    clear_up,
    find_product,
    is_only_copy,
    verify_everything,
)
from spectralzoom.storage.store import Archive, ancestors, inputs_first, manifest_path, publish
from tests.storage.small_archive import flip, grow_old, make_store, problems, publish_receipt, rewrite, small_survey


def uris(archive: Archive) -> set[str]:
    """Return the addresses of all stores."""
    return {ref.uri for ref in archive.refs()}


# --- runs -------------------------------------------------------------------------------------------------------------


def test_a_run_appears_with_all_its_files(archive: Archive) -> None:
    """No run is listed before; its manifest names its stores and all that they were made of, with their hashes."""
    drawn = small_survey(archive, named=False).map

    def write(folder: Path, uri: str) -> dict[str, Any]:
        (folder / "receipt.json").write_text(json.dumps({"survey": uri}))
        assert archive.runs() == []
        assert archive.reclaim() == []
        assert clear_up(archive, keep_days=9).removals == []
        return {"settings": {"seed": 1}}

    folder = archive.publish_run("field 7 / north", write, [drawn])
    assert archive.runs() == [folder]
    assert re.search(r"-field-7-north-[0-9a-f]{8}$", folder.name)  # of its name, which no file can have
    run = runs.read_run(folder)
    assert (run.receipt, run.settings, run.problem) == ({"survey": f"runs/{folder.name}"}, {"seed": 1}, None)
    assert run.names == uris(archive)
    assert run.facts["inputs"] == [drawn.uri]
    assert problems(archive) == []


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), ArchiveError("the disk is full"), OSError(28, "full")], ids=repr
)
def test_a_failed_run_leaves_nothing(archive: Archive, error: BaseException) -> None:
    """The folder in which it was written is removed."""

    def fail(folder: Path, uri: str) -> None:
        (folder / "receipt.json").write_text("{}")
        raise error

    with pytest.raises((KeyboardInterrupt, ArchiveError)):
        archive.publish_run("farm", fail)
    assert list((archive.root / "runs").iterdir()) == []


def test_runs_of_one_second_are_numbered_and_listed_as_published(archive: Archive) -> None:
    """Alphabetical order would put a later run before an earlier one."""
    folders = [publish_receipt(archive, {}, name=name) for name in ("zebra", "apple", "apple")]
    assert len({folder.name for folder in folders}) == 3
    same = [archive.root / "runs" / f"20260101T000000-{number}" for number in (3, 1, 2)]
    for number, (folder, name) in enumerate(zip(folders, same, strict=True)):
        folder.rename(name)
        os.utime(name / "manifest.json", ns=(number, number))
    assert archive.runs() == same
    assert archive.run_folder("latest") == same[-1] == archive.run_folder(f"runs/{same[-1].name}/")


@pytest.mark.parametrize("where", ["the name", "the manifest"])
def test_a_run_of_the_future_is_never_the_latest(
    archive: Archive, where: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The clock was set back since, or was wrong then: the run is named in a warning, and found by its name."""
    small, other = small_survey(archive), small_survey(archive, seed=1)
    ahead = datetime.now(UTC) + timedelta(hours=1)
    later = other.run
    if where == "the name":
        later = other.run.rename(other.run.with_name(f"{ahead:%Y%m%dT%H%M%S}-later"))
    else:
        rewrite(later / "manifest.json", created=ahead.isoformat())
    assert archive.run_folder("latest") == small.run
    assert f"{later.name} lies in the future" in caplog.text
    assert archive.run_folder(later.name) == later
    found = find_product(Catalogue.read(archive), "latest")
    assert isinstance(found, Run)
    assert found.folder == small.run
    shutil.rmtree(small.run)
    with pytest.raises(NoRunError, match="has no run 'latest'"):
        archive.run_folder("latest")


@pytest.mark.parametrize(
    "receipt", ["[1, 2]", '{"stages": [3, {"key": 4}], "products": 5, "settings": null}', '"text"']
)
def test_receipts_of_any_shape_are_read(archive: Archive, receipt: str) -> None:
    """A receipt of wrong types names no product or setting."""
    publish_receipt(archive, receipt)
    (run,) = Catalogue.read(archive).runs
    assert (run.products, run.settings, run.names) == ({}, {}, frozenset())


@pytest.mark.parametrize(
    "change", [flip, lambda path: path.write_text(path.read_text().replace('"seed": 0', '"seed": 7'))]
)
def test_a_run_with_a_damaged_receipt_has_its_manifest(archive: Archive, change: Callable[[Path], object]) -> None:
    """The content of the receipt is ignored, even where one digit changed and it is valid JSON."""
    small = small_survey(archive)
    change(small.run / "receipt.json")
    (run,) = Catalogue.read(archive).runs
    assert (run.receipt, run.settings["seed"], run.names) == ({}, 0, uris(archive))
    assert "receipt.json has changed since it was published" in str(run.problem)


# --- lineage and products ---------------------------------------------------------------------------------------------


def test_lineage_includes_indirect_inputs(archive: Archive) -> None:
    """A map depends on its mosaic and, through it and directly, on the raw lines; circles end."""
    small = small_survey(archive)
    catalogue = Catalogue.read(archive)
    assert set(ancestors(archive.manifests(), [f"runs/{small.run.name}"])) == set(catalogue.stores)
    assert inputs_first(catalogue.stores, catalogue.stores) == [small.raw.uri, small.mosaic.uri, small.map.uri]
    assert [run.folder for run in catalogue.named_by(small.raw.uri)] == [small.run]
    assert catalogue.called(small.raw.uri) == {"capture_coarse"}
    rewrite(small.raw.path / "manifest.json", inputs=[small.map.uri])
    assert {small.raw.uri, *ancestors(archive.manifests(), [small.raw.uri])} == set(catalogue.stores)


def test_products_are_found_by_address_key_run_and_name(archive: Archive) -> None:
    """Accepted are addresses of stores and files, stage and key, a key's start, a run, and a name in the newest run."""
    small = small_survey(archive)
    catalogue = Catalogue.read(archive)
    key = small.map.key
    for text in (small.map.uri, f"{small.map.uri}/class_map.zarr/", f"segment/{key}", key, key[:8], "class_map"):
        assert find_product(catalogue, text) == small.map.uri
    for text in (small.run.name, f"runs/{small.run.name}", f"runs/{small.run.name}/receipt.json", "latest"):
        found = find_product(catalogue, text)
        assert isinstance(found, Run)
        assert found.folder == small.run


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("../x", "cannot be a name"),
        ("stages/../../etc", "cannot be a name"),
        ("/etc/passwd", "cannot be a name"),
        ("", "cannot be a name"),
        ("stages/segment/none", "is no product, store or run"),
        ("runs/none", "there is no run none"),
        ("xyz", "there is class_map, mosaic"),
        ("segment", "segment begins 2 stores"),
        ("mosaic", "the mosaic of runs/.* lacks its store stages/.*; survey again to make it"),
    ],
)
def test_unknown_products_are_refused(archive: Archive, text: str, words: str) -> None:
    """The error lists the products of the newest run; a product whose store is missing has its own message."""
    make_store(archive, "segment", {"other": 1}, [])
    shutil.rmtree(small_survey(archive).mosaic.path)
    with pytest.raises(ArchiveError, match=words):
        find_product(Catalogue.read(archive), text)


def test_lines_of_unknown_origin_are_the_only_copy(archive: Archive) -> None:
    """Simulated lines say so; of a damaged store its runs do. What was made of lines that went is the only copy too."""
    refs = {
        name: make_store(archive, stage, params, [])
        for name, stage, params in (
            ("bare", "capture", {}),
            ("sim", "capture", {"light": {"source": "sim"}}),
            ("rig", "capture", {"light": {"source": "rig"}}),
            ("raster", "rectify", {"scene": "a"}),
            ("effects", "effects", {"source": "rig"}),
        )
    }
    for name in ("sim", "rig"):
        refs[f"signal of {name}"] = make_store(archive, "condense", {}, [refs[name]])
        publish_receipt(archive, {}, refs[f"signal of {name}"], settings={"source": name})

    def only() -> set[str]:
        known = archive.manifests()
        return {name for name, ref in refs.items() if is_only_copy(known, ref.uri)}

    assert only() == {"bare", "rig", "raster"}
    for name in ("sim", "rig"):
        archive.clear(refs[name])
    assert only() == {"bare", "rig", "raster", "signal of rig"}
    for ref in refs.values():
        flip(manifest_path(ref.path), at=40)
    assert only() == {"bare", "rig", "signal of rig"}


# --- verification -----------------------------------------------------------------------------------------------------


def test_verify_finds_flipped_bits_in_any_file(archive: Archive) -> None:
    """30 places are drawn from all bytes and all files, manifests and receipts among them."""
    small_survey(archive)
    files = [path for path in sorted(archive.root.rglob("*")) if path.is_file() and path.suffix != ".lock"]
    chance = random.Random(4)
    for number in range(30):
        weights = [path.stat().st_size if number % 2 else 1 for path in files]
        (path,) = chance.choices(files, weights)
        at, bit = chance.randrange(path.stat().st_size), chance.randrange(8)
        flip(path, at, bit)
        (problem,) = problems(archive)
        uri, name = path.parent.relative_to(archive.root).as_posix(), path.name
        assert problem.startswith(f"{uri} {name} "), (path, at, bit, problem)
        flip(path, at, bit)
    assert problems(archive) == []


def test_missing_short_and_extra_files_and_strays_are_findings(archive: Archive) -> None:
    """Each finding names its file; a lost store is known by the run or the store that names it, and reported once."""
    small, other = small_survey(archive), small_survey(archive, seed=1, named=False)
    small_survey(archive)
    (small.map.path / "data.bin").unlink()
    (small.mosaic.path / "data.bin").write_bytes(b"short")
    (small.mosaic.path / "notes.txt").write_text("x")
    (other.map.path / "manifest.json").unlink()
    shutil.rmtree(small.raw.path)
    archive.discard(other.raw.uri)
    (archive.root / "stages" / "note.txt").write_text("x")
    found = sorted((one.uri, one.kind, one.problem) for one in verify_everything(archive) if one.problem is not None)
    assert [(uri, kind) for uri, kind, _ in found] == sorted(
        [
            (small.map.uri, "broken"),
            *[(small.mosaic.uri, "broken")] * 2,
            (other.map.uri, "broken"),
            (small.raw.uri, "missing"),
            (other.raw.uri, "missing"),
            ("stages/note.txt", "stray"),
        ]
    )
    said = " ".join(str(problem) for *_, problem in found)
    for words in (
        *(
            "data.bin is missing",
            "data.bin has 5 bytes",
            "notes.txt is not in the manifest",
            "manifest.json is missing",
        ),
        *("expected a folder", "is not there, but runs/", f"is not there, but {other.mosaic.uri} was made of it"),
    ):
        assert words in said


def test_a_store_removed_during_verify_is_not_damage(archive: Archive) -> None:
    """gc may run at the same time; a store that a run names must be there."""
    named, other = small_survey(archive), small_survey(archive, seed=1, named=False)

    def bad(uri: str) -> list[str]:
        return [one.uri for one in verify_everything(archive, lambda *_: archive.discard(uri) and None) if one.problem]

    assert bad(other.map.uri) == []
    assert bad(named.map.uri) == [named.map.uri]


# --- clearing up ------------------------------------------------------------------------------------------------------


def test_gc_removes_only_stores_that_no_run_needs(archive: Archive) -> None:
    """Inputs of a named store stay, also shared ones; a dry run lists the same removals."""
    kept, gone = small_survey(archive), small_survey(archive, seed=1, named=False)
    shared = small_survey(archive, kernel="nearest", named=False)
    planned = clear_up(archive, keep_days=0, dry_run=True)
    removed = {one.uri for one in planned.removals}
    assert removed == {gone.map.uri, gone.mosaic.uri, gone.raw.uri, shared.map.uri, shared.mosaic.uri}
    assert len(archive.refs()) == 8
    assert clear_up(archive, keep_days=0) == planned
    assert planned.size > 5 * 40 * 40
    assert uris(archive) == {kept.raw.uri, kept.mosaic.uri, kept.map.uri}
    assert problems(archive) == []
    assert clear_up(archive, keep_days=0).removals == []


def test_gc_keeps_young_stores_and_their_inputs(archive: Archive) -> None:
    """A survey in progress has made a map from old raw lines: both stay. An age that is no number is refused."""
    small, other = small_survey(archive, named=False), small_survey(archive, seed=5, named=False)
    for ref in (small.raw, small.mosaic, other.raw, other.mosaic, other.map):
        grow_old(ref, days=3)
    plan = clear_up(archive, keep_days=2, dry_run=True)
    assert {one.uri for one in plan.removals} == {other.raw.uri, other.mosaic.uri, other.map.uri}
    assert plan.kept == {
        small.raw.uri: "an input of a store that stays",
        small.mosaic.uri: "an input of a store that stays",
        small.map.uri: "no run names it, and it is younger than 2 days",
    }
    assert clear_up(archive, keep_days=4).removals == []
    for days in (-1.0, float("nan")):
        with pytest.raises(SettingsError, match="expected a number of days"):
            clear_up(archive, keep_days=days)


def test_a_cleared_store_has_the_age_size_and_inputs_of_its_manifest(archive: Archive) -> None:
    """It is young, and the raw lines that it names are missed."""
    small = small_survey(archive, named=False)
    archive.discard(small.map.uri)
    archive.clear(small.mosaic)
    assert clear_up(archive, keep_days=1).removals == []
    assert archive.size_of(small.mosaic.uri) == manifest_path(small.mosaic.path).stat().st_size
    archive.discard(small.raw.uri)
    assert problems(archive) == [f"{small.raw.uri} is not there, but {small.mosaic.uri} was made of it"]


def test_gc_removes_raw_lines_of_a_rig_only_on_request(archive: Archive) -> None:
    """A survey that broke off after its capture has lines that no run names and that cannot be captured again."""
    small = small_survey(archive, named=False, simulated=False)
    assert small.raw.uri in clear_up(archive, keep_days=0).kept
    assert uris(archive) == {small.raw.uri}
    clear_up(archive, keep_days=0, raw_too=True)
    assert archive.refs() == []


def test_gc_removes_leftovers_and_locks_and_nothing_in_use(archive: Archive) -> None:
    """A spool of a published capture and unfinished folders go; those of a living process and strays stay."""
    small = small_survey(archive)
    for name in (f"spool/{small.raw.key}", "spool/underway", "stages/rectify/dead.part"):
        (archive.root / name).mkdir(parents=True)
        (archive.root / name / "x").write_bytes(bytes(10))
    (archive.root / "runs" / "notes.txt").write_text("mine")
    found: list[Clearance] = []

    def build(folder: Path) -> None:
        found.append(clear_up(archive, keep_days=0))

    archive.produce("ground", build, version=1, params={})
    assert [(one.uri, one.what, one.size) for one in found[0].removals] == [
        (f"spool/{small.raw.key}", "leftover", 10),
        ("stages/rectify/dead.part", "leftover", 10),
    ]
    assert [path.name for path in (archive.root / "spool").iterdir()] == ["underway"]
    assert (archive.root / "runs" / "notes.txt").exists()
    clear_up(archive)
    assert [path.name for path in (archive.root / ".locks").iterdir()] == ["use.lock"]
    with archive.in_use(), Archive.open(archive.root).in_use():
        done = clear_up(archive, keep_days=0)
        assert (done.removals, done.obstacle) == ([], IN_USE)


def test_gc_does_not_report_a_failed_removal(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk refuses the removal; the next gc tries again."""
    (archive.root / "stages/segment/aaaa.part").mkdir(parents=True)
    with monkeypatch.context() as broken:
        broken.setattr("spectralzoom.storage.store.remove", lambda path: None)
        assert clear_up(archive).removals == []
    assert [removal.uri for removal in clear_up(archive).removals] == ["stages/segment/aaaa.part"]


def test_gc_keeps_all_stores_if_a_run_cannot_be_read(archive: Archive) -> None:
    """The run's manifest replaces a damaged receipt; if the manifest is damaged or missing, all stores stay."""
    small, _ = small_survey(archive), small_survey(archive, seed=1, named=False)
    flip(small.run / "receipt.json")
    found = clear_up(archive, keep_days=0, dry_run=True)
    assert (found.obstacle, len(found.removals)) == (None, 3)
    flip(small.run / "manifest.json")
    for _ in range(2):
        obstacle = str(clear_up(archive, keep_days=0).obstacle)
        assert f"no store is removed: the stores of runs/{small.run.name} are not known" in obstacle
        assert "; restore this folder from a copy, or delete it" in obstacle
        (small.run / "manifest.json").unlink(missing_ok=True)
    assert len(archive.refs()) == 6


def test_gc_keeps_all_stores_if_inputs_are_unknown(archive: Archive) -> None:
    """The map is young and its manifest is damaged: the old mosaic might be its input."""
    small = small_survey(archive, named=False)
    for ref in (small.raw, small.mosaic):
        grow_old(ref, days=3)
    (small.map.path / "manifest.json").write_text("{")
    assert f"the inputs of {small.map.uri} are not known" in str(clear_up(archive, keep_days=2).obstacle)
    assert len(archive.refs()) == 3


@pytest.mark.parametrize("at", range(4))
def test_an_interrupted_gc_leaves_a_whole_archive(archive: Archive, at: int) -> None:
    """Stores are removed before their inputs; the next gc removes the rest."""
    small_survey(archive)
    small_survey(archive, seed=1, named=False)
    (archive.root / "spool" / archive.refs("capture")[0].key).mkdir(parents=True)
    steps: list[Removal] = []

    def stop(removal: Removal, done: float) -> None:
        steps.append(removal)
        if len(steps) > at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        clear_up(archive, keep_days=0, progress=stop)
    assert problems(archive) == []
    clear_up(archive, keep_days=0)
    assert len(archive.refs()) == 3


# --- damaged stores ---------------------------------------------------------------------------------------------------


def remove_damaged(archive: Archive, *, raw_too: bool = False, dry_run: bool = False) -> Clearance:
    """Verify an archive, and remove what is damaged."""
    return clear_up(archive, raw_too=raw_too, damaged=verify_everything(archive), dry_run=dry_run)


def test_a_damaged_store_goes_with_what_was_made_of_it(archive: Archive) -> None:
    """A dry run lists the same removals; the next survey makes them again, and the run is whole."""
    small, other = small_survey(archive), small_survey(archive, seed=1)
    flip(small.mosaic.path / "data.bin")
    with archive.in_use():
        assert remove_damaged(archive).obstacle == IN_USE
    planned = remove_damaged(archive, dry_run=True)
    assert [(one.uri, one.why) for one in planned.removals] == [
        (small.map.uri, "it was made of a damaged store"),
        (small.mosaic.uri, "it is damaged"),
    ]
    assert remove_damaged(archive) == planned
    assert uris(archive) == {small.raw.uri, other.raw.uri, other.mosaic.uri, other.map.uri}
    assert len(archive.runs()) == 2
    assert len(problems(archive)) == 2  # which the run names
    small_survey(archive, named=False)
    assert problems(archive) == []
    assert remove_damaged(archive).removals == []


@pytest.mark.parametrize("damage", ["a flipped bit", "a damaged manifest", "no manifest"])
def test_damaged_lines_of_a_rig_go_on_request(archive: Archive, damage: str) -> None:
    """They cannot be captured again, so they stay with what was made of them, with a reason."""
    small = small_survey(archive, simulated=False)
    if damage == "no manifest":
        (small.raw.path / "manifest.json").unlink()
    else:
        flip(small.raw.path / ("data.bin" if damage == "a flipped bit" else "manifest.json"), at=40)
    kept = remove_damaged(archive)
    assert (kept.removals, list(kept.kept)) == ([], [small.raw.uri])
    assert "restore it from a copy" in kept.kept[small.raw.uri]
    assert small.raw.uri in {one.uri for one in remove_damaged(archive, raw_too=True).removals}
    small_survey(archive, named=False, simulated=False)
    assert problems(archive) == []


def test_lines_of_a_rig_outlive_the_damaged_store_that_planned_them(archive: Archive) -> None:
    """The lines of a second pass were captured by the scores of a mosaic, and cannot be captured again."""
    small = small_survey(archive, simulated=False)
    fine = make_store(archive, "capture", {"light": {"source": "rig"}}, [small.mosaic])
    drawn = make_store(archive, "segment", {"pass": 2}, [fine])
    flip(small.mosaic.path / "data.bin")
    assert {one.uri for one in remove_damaged(archive).removals} == {small.map.uri, small.mosaic.uri, drawn.uri}
    assert archive.find("capture", fine.key) is not None


def test_a_damaged_run_goes_and_its_stores_stay(archive: Archive) -> None:
    """Without it nothing stands in the way of gc, which spares its stores for a day."""
    small = small_survey(archive)
    (small.run / "manifest.json").unlink()
    assert clear_up(archive, keep_days=9).obstacle is not None
    assert [(one.uri, one.what) for one in remove_damaged(archive).removals] == [(f"runs/{small.run.name}", "run")]
    assert problems(archive) == []
    assert len(archive.refs()) == 3
    assert clear_up(archive, keep_days=9).obstacle is None


@pytest.mark.parametrize("change", [flip, lambda path: (path.unlink(), path.mkdir())])
def test_the_damaged_manifest_of_a_cleared_store_goes(archive: Archive, change: Callable[[Path], object]) -> None:
    """It lies beside the place of its folder."""
    small = small_survey(archive)
    archive.clear(small.mosaic)
    change(manifest_path(small.mosaic.path))
    with pytest.raises(IncompleteStoreError, match=rf"{small.mosaic.key}\.cleared is damaged"):
        archive.find("rectify", small.mosaic.key)
    assert len(problems(archive)) == 1
    assert small.mosaic.uri in {one.uri for one in remove_damaged(archive).removals}
    assert not list(small.mosaic.path.parent.iterdir())


def test_a_linked_store_goes_and_not_what_it_leads_to(archive: Archive, tmp_path: Path) -> None:
    """A link counts as a damaged store."""
    elsewhere = tmp_path / "elsewhere"
    publish(elsewhere / "stages" / "x" / "y", lambda folder: {})
    place = archive.ref("segment", "linked").path
    place.parent.mkdir(parents=True)
    place.symlink_to(elsewhere / "stages" / "x" / "y")
    assert problems(archive) == ["stages/segment/linked it is a link, expected a folder"]
    assert [one.uri for one in remove_damaged(archive).removals] == ["stages/segment/linked"]
    assert (elsewhere / "stages" / "x" / "y" / "manifest.json").is_file()

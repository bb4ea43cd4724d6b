"""Several machines at one archive in a bucket: what one clears away, repairs or uploads late harms no other's."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("obstore", reason="obstore is not installed (extra s3)")

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.maintenance.garbage import clear_up
from storage.maintenance.verification import Finding
from storage.remote import object_checks, object_copies
from storage.remote.object_archive import ObjectArchive
from storage.remote.object_stores import Objects, UnreachableError
from storage.remote.opening import put_back_objects, repair_objects, verify_archive
from tests.storage.small_archive import Small, problems, small_survey
from tests.storage.small_bucket import FIRST, SECOND, Machine, make, object_of, rot

THIRD = "third"


@contextmanager
def silence(monkeypatch: pytest.MonkeyPatch, *names: str) -> Iterator[None]:
    """Have the bucket not answer what these methods ask."""

    def refuse(*given: Any, **more: Any) -> None:
        raise UnreachableError("the bucket cannot be reached", passing=True)

    with monkeypatch.context() as patch:
        for name in names:
            patch.setattr(Objects, name, refuse)
        yield


def survey_in_silence(archive: ObjectArchive, monkeypatch: pytest.MonkeyPatch) -> Small:
    """A survey whose bucket takes nothing, from its first upload on."""
    done: list[Small] = []

    def survey() -> None:
        with archive.in_use(), silence(monkeypatch, "write"):
            make(archive, b"the first of it", seed=77)
            done.append(small_survey(archive))

    with pytest.raises(UnreachableError, match="is kept in"):
        survey()
    return done[0]


def test_gc_counts_runs_that_others_published_since_it_was_opened(machine: Machine) -> None:
    """Between opening and clearing up another machine names old stores: they stay."""
    archive = machine(FIRST)
    small_survey(archive, named=False)
    opened = machine(SECOND, create=False)
    small_survey(archive)
    assert clear_up(opened, keep_days=0).removals == ()
    assert problems(archive) == []


def test_what_was_cleared_away_elsewhere_is_made_again(machine: Machine) -> None:
    """A manifest here, of whose files none was fetched, does not stand for a store that is gone."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    assert machine(SECOND).find("rectify", ref.key) is not None
    archive.discard(ref)
    found, built = make(machine(SECOND), b"again")
    assert built
    assert (found.path / "deep" / "a.bin").read_bytes() == b"again"
    assert problems(archive) == []


@pytest.mark.parametrize("opened", [True, False])
def test_what_was_made_again_elsewhere_is_fetched_as_it_is_now(machine: Machine, opened: bool) -> None:
    """Cleared away and made with other bytes: the old manifest here is replaced, also while the archive is open."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    other = machine(SECOND)
    found = other.find("rectify", ref.key)
    archive.discard(ref)
    make(archive, b"later")
    if not opened:
        other = machine(SECOND)
        found = other.find("rectify", ref.key)
    assert found is not None
    assert (found.path / "deep" / "a.bin").read_bytes() == b"later"
    assert other.manifest_hash(found) == archive.manifest_hash(ref)


def test_a_store_that_goes_while_the_archive_is_open_is_told_of(machine: Machine) -> None:
    """Nothing can be fetched then; the next run makes it."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    other = machine(SECOND)
    found = other.find("rectify", ref.key)
    assert found is not None
    archive.discard(ref)
    with pytest.raises(IncompleteStoreError, match="was removed meanwhile; run again, and it is made again"):
        _ = found.path
    assert make(other)[1]


def test_a_late_upload_rests_on_what_others_published_meanwhile(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the same stores, made twice, the run that comes late names those that stand: verify finds nothing."""
    mine = machine(FIRST)
    small_survey(machine(SECOND))
    late = survey_in_silence(mine, monkeypatch)
    archive = machine(FIRST)
    assert problems(archive) == []
    runs = Catalogue.read(machine(THIRD, create=False).root).runs
    assert {run.folder.name for run in runs} >= {late.run.name}
    assert [run.recorded for run in runs] == [runs[0].recorded] * 2
    assert (archive.root / "runs" / late.run.name / "receipt.json").is_file()


def test_runs_begun_without_a_network_have_names_of_their_own(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two machines survey by one clock, and one has no network: it uploads later, beside the other's run."""
    begin = ObjectArchive._begin_run
    monkeypatch.setattr(ObjectArchive, "_begin_run", lambda self, name: begin(self, "20261120T101010-farm"))
    survey_in_silence(machine(FIRST), monkeypatch)
    small_survey(machine(SECOND))
    machine(FIRST)
    assert len(Catalogue.read(machine(THIRD, create=False).root).runs) == 2


def test_a_broken_off_repair_keeps_its_files_from_gc(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is withdrawn is no leftover: verify tells of it, and the next repair puts it back as it was."""
    small = small_survey(machine(FIRST))
    archive = machine(SECOND, create=False)
    rot(archive, object_of(archive, small.raw, "data.bin"))
    before = problems(archive)

    def kill(settings: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    found = [one for one in verify_archive(archive) if one.problem]
    with monkeypatch.context() as patch:
        _put_back_once(patch)
        with pytest.raises(KeyboardInterrupt):
            repair_objects(archive, found, kill)
    other = machine(THIRD, create=False)
    assert "a repair was broken off; run verify --repair again" in problems(other)[-1]
    assert clear_up(other, keep_days=0).removals == ()
    assert len(put_back_objects(other)) == 3
    assert problems(other) == before


def _put_back_once(patch: pytest.MonkeyPatch) -> None:
    """As if the process had been killed: what was withdrawn is put back before it, and not at its end."""
    calls: list[Archive] = []

    def put_back(archive: Archive) -> list[str]:
        calls.append(archive)
        return put_back_objects(archive) if len(calls) == 1 else []

    patch.setattr("storage.remote.opening.put_back_objects", put_back)


def test_a_run_that_lost_its_manifest_keeps_its_stores(machine: Machine) -> None:
    """verify names it, gc removes no store and nothing of the run; where the run is known, verify --repair cures it."""
    archive = machine(FIRST)
    small = small_survey(archive)
    archive.objects.remove([f"runs/{small.run.name}/manifest.json"])
    other = machine(SECOND, create=False)
    (found,) = problems(other)
    assert found == f"runs/{small.run.name} manifest.json is missing, or its upload was broken off"
    done = clear_up(other, keep_days=0)
    assert done.removals == ()
    assert "has lost its manifest.json" in str(done.obstacle)
    done_here = repair_objects(archive, [one for one in verify_archive(archive) if one.problem], lambda settings: None)
    assert done_here.complete
    assert problems(other) == []


def test_gc_clears_away_runs_that_were_only_begun(machine: Machine) -> None:
    """A killed survey leaves the claim of a name; a published run's stays."""
    archive = machine(FIRST)
    small = small_survey(archive)
    archive.objects.write("runs/20261120T101010-killed/begun", b"0")
    archive.objects.write("elsewhere/runs/20261120T101010-other/begun", b"another archive, below this one")
    (removal,) = clear_up(machine(SECOND, create=False), keep_days=0).removals
    assert removal.uri == "runs/20261120T101010-killed"
    left = set(archive.objects.listing())
    assert f"runs/{small.run.name}/begun" in left
    assert "elsewhere/runs/20261120T101010-other/begun" in left
    assert problems(archive) == []


def test_ages_are_told_by_the_clock_of_the_store(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine whose clock is days ahead takes nothing for old that is new."""
    small_survey(machine(FIRST), named=False)
    opened = machine(SECOND, create=False)
    monkeypatch.setattr(Archive, "now", lambda self: datetime.now(UTC) + timedelta(days=9))
    assert clear_up(opened, keep_days=1).removals == ()


def test_reading_verbs_take_nothing_from_a_survey_here(machine: Machine) -> None:
    """What was cleared away in the bucket is forgotten here, but not while somebody may be reading it."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    with archive.in_use():
        machine(SECOND).objects.remove(archive.objects.listing(ref.uri))
        machine(FIRST, create=False, write=False)
        assert (archive.root / ref.uri / "deep" / "a.bin").read_bytes() == b"light"
    machine(FIRST, create=False, write=False)
    assert not (archive.root / ref.uri).exists()


def test_a_store_that_is_cleared_away_under_verify_is_no_damage(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """gc on another machine takes a store whose manifest was read, and its files not yet."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    measure = Objects.measure

    def clear_first(self: Objects, name: str) -> tuple[int, str]:
        archive.discard(ref)
        return measure(self, name)

    monkeypatch.setattr(Objects, "measure", clear_first)
    assert problems(archive) == []


def test_a_damaged_store_that_waits_holds_nobody_up(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It cannot be uploaded, nor the run that names it; they stay here, all else goes on, and why is said."""
    late = survey_in_silence(machine(FIRST), monkeypatch)
    folder = late.raw.path
    kept = (folder / "data.bin").read_bytes()
    (folder / "data.bin").write_bytes(kept[:-1])
    archive = machine(FIRST)
    assert "waits for its upload, which is not possible" in caplog.text
    assert f"{folder} is damaged and was never uploaded" in caplog.text
    assert (folder / "data.bin").read_bytes() == kept[:-1]
    assert make(archive, b"dark", seed=5)[1]
    (folder / "data.bin").write_bytes(kept)
    assert problems(machine(FIRST)) == []
    assert len(Catalogue.read(machine(SECOND, create=False).root).runs) == 1


@pytest.mark.parametrize("method", ["write", "create"])
def test_a_bucket_that_fails_at_the_upload_of_what_waits_holds_no_survey_up(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    """What waited waits on, and the survey goes on in the working copy."""
    survey_in_silence(machine(FIRST), monkeypatch)
    create = Objects.create
    with silence(monkeypatch, "write"), monkeypatch.context() as patch:
        if method == "create":  # all but the mark, which is the first thing asked for
            refused = Objects.write
            patch.setattr(
                Objects,
                "create",
                lambda self, name, text: (create if name == "archive.json" else refused)(self, name, text),
            )
        archive = machine(FIRST)
        with pytest.raises(UnreachableError, match="the same command uploads it"), archive.in_use():
            assert make(archive, seed=6)[1]
    machine(FIRST)
    assert len(Catalogue.read(machine(SECOND, create=False).root).runs) == 1


def test_a_survey_begins_where_a_lease_cannot_be_had(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """The network goes between opening and beginning; clearing up is refused then."""
    archive = machine(FIRST)
    with (
        silence(monkeypatch, "create", "write", "read_dated", "listing"),
        pytest.raises(UnreachableError, match="is kept in"),
        archive.in_use(),
    ):
        assert make(archive)[1]
    again = machine(FIRST)
    with silence(monkeypatch, "listing"), pytest.raises(UnreachableError), again.in_use(alone=True):
        pytest.fail("alone, and nobody was asked")


def test_a_repair_that_changes_nothing_is_no_cure(machine: Machine) -> None:
    """A file that nobody listed is not cured by writing what is whole; the store is made again."""
    archive = machine(FIRST)
    small = small_survey(archive)
    archive.objects.write(object_of(archive, small.map, "data.bin") + ".more", b"x")
    found = [one for one in verify_archive(archive) if one.problem]
    done = repair_objects(archive, found, lambda settings: small_survey(machine(FIRST)) and None)
    assert done.remade == [small.map.uri]
    assert problems(archive) == []


def test_a_repair_knows_its_old_copy_from_what_stands(machine: Machine) -> None:
    """Another machine made the store anew, and runs know that one: an older copy here is not written over it."""
    archive = machine(FIRST)
    small = small_survey(archive, named=False)
    other = machine(SECOND)
    for ref in (small.map, small.mosaic, small.raw):
        other.discard(ref)
    time.sleep(0.01)
    small_survey(other)
    rot(other, object_of(other, small.raw, "data.bin"))
    mended = machine(FIRST, create=False)
    assert mended.copy.is_known(small.raw.uri)
    found = [one for one in verify_archive(mended) if one.problem]
    done = repair_objects(mended, found, lambda settings: small_survey(machine(FIRST)) and None)
    assert done.complete
    assert problems(mended) == []


def test_a_full_disk_under_the_working_copy_is_one_clear_error(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a file is fetched, and while what is known is noted; what was there stays, and the next try goes on."""
    ref, _ = make(machine(FIRST))
    other = machine(SECOND)

    def full(*given: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(object_copies, "sync_path", full)
        with pytest.raises(ArchiveError, match="the disk is full: free some space"):
            other.find("rectify", ref.key)
    found = other.find("rectify", ref.key)
    assert found is not None
    with monkeypatch.context() as patch:
        patch.setattr(Objects, "save", full)
        with pytest.raises(ArchiveError, match="the disk is full: free some space"):
            _ = found.path
    assert (found.path / "deep" / "a.bin").read_bytes() == b"light"


def test_what_a_killed_fetch_left_goes_with_a_later_one(machine: Machine) -> None:
    """Halves of files are no use to anybody after a day."""
    ref, _ = make(machine(FIRST))
    other = machine(SECOND)
    dead, living = (other.root / ".fetch" / name for name in ("dead", "living"))
    for folder in (dead, living):
        folder.mkdir(parents=True)
        (folder / "half").write_bytes(b"half")
    os.utime(dead, (time.time() - 90_000,) * 2)
    found = other.find("rectify", ref.key)
    assert found is not None
    assert found.path.is_dir()
    assert (dead.exists(), living.exists()) == (False, True)


def test_what_is_brought_while_it_is_made_here_is_kept(machine: Machine) -> None:
    """Another process of this machine has fetched the store that another machine published: it is not taken away."""
    mine, read = machine(FIRST), list[int]()

    def build(path: Path) -> None:
        (path / "a.bin").write_bytes(b"mine")
        ref, _ = machine(SECOND).produce("rectify", _writing(b"theirs"), version=1, params={})
        beside = machine(FIRST).find("rectify", ref.key)
        assert beside is not None
        read.append((beside.path / "a.bin").stat().st_ino)

    ref, _ = mine.produce("rectify", build, version=1, params={})
    assert (ref.path / "a.bin").read_bytes() == b"theirs"
    assert read == [(ref.path / "a.bin").stat().st_ino]


def _writing(content: bytes) -> Callable[[Path], None]:
    def build(path: Path) -> None:
        (path / "a.bin").write_bytes(content)

    return build


def test_findings_of_a_bucket_are_of_known_kinds(machine: Machine) -> None:
    """What a repair withdrew is stray, as in a folder; verify --repair puts it back."""
    archive = machine(FIRST)
    archive.objects.write(".withdrawn/stages/rectify/key/manifest.json", b"{}")
    expected = "a repair was broken off; run verify --repair again"
    assert verify_archive(archive) == [Finding(".withdrawn/stages/rectify/key/manifest.json", expected, "stray")]


def test_a_manifest_that_is_lost_is_written_again_from_any_machine_that_knows_it(machine: Machine) -> None:
    """The files lie in the bucket yet: none has to be here."""
    small = small_survey(machine(FIRST))
    other = machine(SECOND, create=False)
    other.objects.remove([f"{small.raw.uri}/manifest.json"])
    assert not (other.root / small.raw.uri / "data.bin").exists()
    done = repair_objects(other, [one for one in verify_archive(other) if one.problem], lambda settings: None)
    assert (done.remade, done.complete) == ([small.raw.uri], True)
    assert problems(other) == []


def test_what_waits_is_uploaded_under_a_lease(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or gc elsewhere could take the files of an upload that was broken off just before its manifest comes."""
    survey_in_silence(machine(FIRST), monkeypatch)
    write, leases = Objects.write, list[int]()

    def look(self: Objects, name: str, source: Path | bytes) -> None:
        leases.append(len(self.listing(".in-use")))
        write(self, name, source)

    monkeypatch.setattr(Objects, "write", look)
    archive = machine(FIRST)
    assert set(leases) == {1}
    assert archive.objects.listing(".in-use") == {}


def test_a_bucket_that_refuses_what_waits_is_no_network_to_wait_for(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Credentials that may not write do not become better by going on."""
    survey_in_silence(machine(FIRST), monkeypatch)

    def deny(*given: Any) -> None:
        raise UnreachableError("access is denied")

    monkeypatch.setattr(Objects, "write", deny)
    with pytest.raises(UnreachableError, match="access is denied"):
        machine(FIRST)


def test_what_a_run_names_is_not_forgotten_where_the_bucket_lost_it(machine: Machine) -> None:
    """All its objects are gone: the copy here stays, and verify --repair uploads it."""
    small = small_survey(machine(FIRST))
    archive = machine(SECOND)
    archive.objects.remove(archive.objects.listing(small.raw.uri))
    here = machine(FIRST, create=False)
    done = repair_objects(here, [one for one in verify_archive(here) if one.problem], lambda settings: None)
    assert (done.remade, done.complete) == ([small.raw.uri], True)
    assert problems(archive) == []


def test_a_run_on_its_way_is_no_lost_one(machine: Machine) -> None:
    """While somebody uses the archive, a run's files may be there before its manifest."""
    archive = machine(FIRST)
    archive.objects.write("runs/20261120T101010-farm/0123456789abcdef/receipt.json", b"{}")
    with archive.in_use():
        assert problems(machine(SECOND)) == []
    assert problems(machine(SECOND)) == [
        "runs/20261120T101010-farm manifest.json is missing, or its upload was broken off"
    ]


def test_a_survey_does_not_begin_under_somebody_who_clears_up(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waits, and says at last which object to remove; two surveys do not disturb each other."""
    one, other = machine(FIRST), machine(SECOND)
    monkeypatch.setattr(object_checks, "WAIT_S", 0.1)
    with (
        one.in_use(alone=True) as alone,
        pytest.raises(ArchiveError, match=r"cleared up or repaired elsewhere \(\.in-use/alone-"),
        other.in_use(),
    ):
        pytest.fail(f"used by two at a time, one of them alone: {alone}")
    with one.in_use(), other.in_use():
        assert len(one.objects.listing(".in-use")) == 2
    assert one.objects.listing(".in-use") == {}


def test_a_lease_of_a_machine_that_never_returned_counts_for_a_day(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until then nobody is alone; afterwards it holds nobody up."""
    archive = machine(FIRST)
    archive.objects.write(".in-use/shared-lost", b"")
    with archive.in_use(alone=True) as alone:
        assert not alone
    monkeypatch.setattr(object_checks, "LIFE_S", -1.0)
    with archive.in_use(alone=True) as alone:
        assert alone


def test_a_lease_that_was_taken_away_is_taken_again(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as by another process of this machine that found nobody behind it yet."""
    archive, create, names = machine(FIRST), Objects.create, list[str]()

    def create_in_vain(self: Objects, name: str, content: bytes) -> bool:
        names.append(name)
        return len(names) == 1 or create(self, name, content)

    monkeypatch.setattr(Objects, "create", create_in_vain)
    monkeypatch.setattr(object_checks, "_PAUSE_S", 0.01)
    with archive.in_use():
        assert list(archive.objects.listing(".in-use")) == [names[0]]


def test_what_one_machine_cleared_another_makes_again(machine: Machine) -> None:
    """Files go from the bucket, the manifest stays; a machine that has them yet uses them, one without makes them."""
    first, second = machine(FIRST), machine(SECOND)
    small = small_survey(first)
    assert second.find("rectify", small.mosaic.key) is not None
    kept = second.ref("rectify", small.mosaic.key).path
    done = clear_up(first, keep_days=0, made_again={"rectify": 1})
    assert [(one.uri, one.what) for one in done.removals] == [(small.mosaic.uri, "files")]
    assert [name.rpartition("/")[2] for name in first.objects.listing(small.mosaic.uri)] == ["manifest.json"]
    assert problems(first) == []
    assert first.find("rectify", small.mosaic.key) is None
    assert (kept / "data.bin").is_file()
    assert second.find("rectify", small.mosaic.key) is not None
    third = machine(THIRD)
    assert third.find("rectify", small.mosaic.key) is None
    again = small_survey(third)
    assert any(name.endswith("/data.bin") for name in third.objects.listing(again.mosaic.uri))
    assert (third.root / again.mosaic.uri / "data.bin").read_bytes() == (kept / "data.bin").read_bytes()
    assert problems(third) == []


def test_a_run_that_rests_on_what_was_cleared_brings_it_back(machine: Machine) -> None:
    """A machine that has the files yet uploads them with the run that it publishes."""
    first, second = machine(FIRST), machine(SECOND)
    small = small_survey(first)
    assert (second.ref("rectify", small.mosaic.key).path / "manifest.json").parent == second.root / small.mosaic.uri
    assert second.find("rectify", small.mosaic.key) is not None
    assert (second.ref("rectify", small.mosaic.key).path / "data.bin").is_file()
    clear_up(first, keep_days=0, made_again={"rectify": 1})
    small_survey(second, kernel="bilinear")
    assert any(name.endswith("/data.bin") for name in second.objects.listing(small.mosaic.uri))
    assert problems(second) == []


def test_a_clearing_that_never_reached_the_bucket_is_undone(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed before it told the bucket: what stands there counts, for others may have gone on with it."""
    first = machine(FIRST)
    small = small_survey(first)
    with monkeypatch.context() as patch:
        patch.setattr(object_copies.WorkingCopy, "send_cleared", lambda copy, uri: None)
        clear_up(first, keep_days=0, made_again={"rectify": 1})
    again = machine(FIRST)
    assert again.find("rectify", small.mosaic.key) is not None
    assert (again.ref("rectify", small.mosaic.key).path / "data.bin").is_file()
    assert problems(again) == []

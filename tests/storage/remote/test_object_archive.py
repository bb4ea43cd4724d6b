"""An archive on S3: the first publisher wins, a partial upload does not count, and all used bytes are checked."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from storage.remote.opening import is_archive, open_archive, verify_archive

pytest.importorskip("obstore", reason="obstore is not installed (extra s3)")

from pipeline.errors import ArchiveError, IncompleteStoreError, SettingsError
from storage.archive.keys import StageRef
from storage.archive.lineage import Catalogue
from storage.archive.manifests import check_files
from storage.arrays.layout import create_group, write_image
from storage.maintenance.garbage import clear_up
from storage.remote import object_stores
from storage.remote.object_stores import Objects, UnreachableError, is_remote, parse_place
from tests.storage.small_archive import problems, small_survey
from tests.storage.small_bucket import FIRST, SECOND, Machine, make, object_of, rot


def test_a_store_is_found_and_fetched_by_another_machine(machine: Machine) -> None:
    """The second machine makes nothing, and has the same bytes; it fetches files only when it asks for their path."""
    ref, built = make(machine(FIRST))
    other = machine(SECOND)
    found, rebuilt = make(other, b"never written")
    assert (built, rebuilt) == (True, False)
    assert found == ref
    folder = other.root / found.uri
    assert [path.name for path in folder.iterdir()] == ["manifest.json"]
    assert (found.path / "deep" / "a.bin").read_bytes() == b"light"
    assert (folder / "manifest.json").read_bytes() == (ref.path / "manifest.json").read_bytes()
    check_files(found.path, hashes=True)


def test_a_second_writer_takes_the_published_store(bucket: str, machine: Machine) -> None:
    """If two machines make one key at the same time, one publishes; both end with its store."""
    archives = [machine(FIRST), machine(SECOND)]
    together = threading.Barrier(2)

    def publish(number: int) -> StageRef:
        def build(path: Path) -> None:
            together.wait(20)
            (path / "a.bin").write_bytes(b"made by %d" % number)

        return archives[number].produce("rectify", build, version=1, params={})[0]

    with ThreadPoolExecutor(2) as pool:
        made = list(pool.map(publish, (0, 1)))
    assert made[0] == made[1]
    assert archives[0].manifest_hashes(made[:1]) == archives[1].manifest_hashes(made[1:])
    assert (made[0].path / "a.bin").read_bytes() == (made[1].path / "a.bin").read_bytes()
    assert sum(name.endswith("manifest.json") for name in archives[0].objects.listing(made[0].uri)) == 1
    assert problems(archives[0]) == []


def test_a_store_without_conditional_puts_is_refused(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """If conditional puts overwrite, two surveys could destroy each other's stores: no archive is created."""
    monkeypatch.setattr(Objects, "create", lambda self, name, content: True)
    with pytest.raises(ArchiveError, match="ignores conditional puts"):
        open_archive(bucket)


def test_a_publisher_killed_before_the_manifest_can_resume(bucket: str, machine: Machine, tmp_path: Path) -> None:
    """Other machines find no store; the rerun uploads the manifest, and no file again."""
    script = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from storage.remote.opening import open_archive\n"
        "from storage.remote.object_stores import Objects\n"
        "archive = open_archive(sys.argv[1])\n"
        "Objects.create = lambda *given: os.kill(os.getpid(), signal.SIGKILL)\n"
        "def build(path):\n"
        "    (path / 'deep').mkdir()\n"
        "    (path / 'deep' / 'a.bin').write_bytes(b'light')\n"
        "    (path / 'b.json').write_text('{}')\n"
        "archive.produce('rectify', build, version=1, params={})\n"
    )
    other = machine(SECOND)
    mine = machine(FIRST)  # the process inherits this environment
    ended = subprocess.run([sys.executable, "-c", script, bucket], cwd=Path(__file__).parents[3], check=False)
    assert ended.returncode == -9
    assert len(other.objects.listing("stages")) == 2
    key = next((mine.root / "stages" / "rectify").iterdir()).name
    assert other.find("rectify", key) is None
    before = other.objects.listing("stages")
    ref, built = make(machine(FIRST))
    assert not built
    after = other.objects.listing("stages")
    assert {name: after[name] for name in before} == before
    assert other.find("rectify", key) == ref


def test_a_flipped_bit_is_found_and_its_file_refused(machine: Machine) -> None:
    """Verify names the file; a machine that fetches it gets an error and no file."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    rot(archive, object_of(archive, ref, "a.bin"))
    assert problems(archive) == [f"{ref.uri} deep/a.bin has changed since it was published (its SHA-256 differs)"]
    other = machine(SECOND)
    found = other.find("rectify", ref.key)
    assert found is not None
    with pytest.raises(IncompleteStoreError, match=r"a\.bin has changed since it was published"):
        _ = found.path
    assert not (other.root / found.uri / "deep" / "a.bin").exists()


def test_a_flipped_bit_in_a_manifest_is_found(machine: Machine) -> None:
    """A manifest holds its own checksum, in the bucket too."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    rot(archive, f"{ref.uri}/manifest.json", 200)
    assert [finding.uri for finding in verify_archive(archive) if finding.problem] == [ref.uri]
    with pytest.raises(IncompleteStoreError, match=r"no valid manifest\.json"):
        machine(SECOND).find("rectify", ref.key)


def test_missing_and_foreign_objects_are_found(machine: Machine) -> None:
    """Verify finds a missing file, an unlisted file, and a missing store that a run names."""
    archive = machine(FIRST)
    small = small_survey(archive)
    ref, _ = make(archive)
    archive.objects.remove([object_of(archive, ref, "b.json")])
    archive.objects.write(object_of(archive, ref, "a.bin") + ".more", b"x")
    archive.objects.remove(archive.objects.listing(small.mosaic.uri))
    assert set(problems(archive)) == {
        f"{small.mosaic.uri} is not there, but runs/{small.run.name} names it",
        f"{ref.uri} b.json cannot be read: it is missing",
        f"{ref.uri} deep/a.bin.more is not in the manifest: take it out of the archive",
    }


def test_runs_of_one_second_have_different_names(machine: Machine) -> None:
    """Two machines begin a run in the same second."""
    drafts = [machine(name)._begin_run("20261120T101010-farm") for name in (FIRST, SECOND)]
    assert len({draft.id for draft in drafts if draft is not None}) == 2


@pytest.mark.parametrize("method", ["write", "create"])
def test_an_interrupted_run_is_uploaded_later(machine: Machine, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """The machine was killed before its files or its manifest were sent; opening the archive there uploads them."""
    archive = machine(FIRST)
    small_survey(archive, named=False)
    with monkeypatch.context() as patch:
        patch.setattr(Objects, method, Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            small_survey(archive)
    assert Catalogue.read(machine(SECOND, create=False).root).runs == []
    machine(FIRST)
    opened = machine(SECOND, create=False)
    assert len(Catalogue.read(opened.root).runs) == 1
    assert problems(opened) == []


def test_an_unsent_run_with_missing_stores_stops_no_command(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Another machine removed a store of the unsent run; the same survey, run again, repairs it."""
    small_survey(machine(FIRST), named=False)
    archive = machine(SECOND)
    with monkeypatch.context() as patch:
        patch.setattr(archive, "_upload", lambda uri, first: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            small_survey(archive)
    other = machine(FIRST)
    other.discard(other.refs("segment")[0])
    again = machine(SECOND)
    assert "stays on this machine until its survey runs again" in caplog.text
    assert len(again.runs()) == 1
    small_survey(again)
    machine(SECOND)
    assert len(machine(FIRST).runs()) == 2
    assert problems(machine(FIRST)) == []


def test_gc_removes_unnamed_stores_and_interrupted_uploads(machine: Machine) -> None:
    """Stores named by a receipt stay, on every machine; with `keep_days=1` nothing is removed."""
    archive = machine(FIRST)
    kept, gone = small_survey(archive), small_survey(archive, seed=1, named=False)
    archive.objects.write("stages/rectify/half/0123456789abcdef/a.bin", b"half")
    opened = machine(SECOND, create=False)
    assert [removal.what for removal in clear_up(opened, keep_days=1).removals] == []
    planned, done = clear_up(opened, keep_days=0, dry_run=True), clear_up(opened, keep_days=0)
    assert done == planned
    gone_uris = [gone.map.uri, gone.mosaic.uri, gone.raw.uri, "stages/rectify/half/0123456789abcdef"]
    assert [removal.uri for removal in done.removals] == gone_uris
    left = {name.rpartition("/")[0] for name in archive.objects.listing("stages")}
    assert {name.split("/")[2] for name in left} == {kept.map.key, kept.mosaic.key, kept.raw.key}
    assert problems(opened) == []


def test_a_cached_store_removed_elsewhere_is_uploaded_again(machine: Machine) -> None:
    """Another machine removed it; it is uploaded before a run names it."""
    archive, other = machine(FIRST), machine(SECOND, create=False)
    small = small_survey(archive, named=False)
    other.discard(small.raw)
    small_survey(archive)
    assert problems(archive) == []


def test_a_lost_working_copy_is_fetched_again(machine: Machine) -> None:
    """One file or the whole copy may be deleted; the store is not made again."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    (ref.path / "deep" / "a.bin").unlink()
    assert (machine(FIRST).find("rectify", ref.key).path / "deep" / "a.bin").read_bytes() == b"light"
    shutil.rmtree(archive.root)
    found, built = make(machine(FIRST))
    assert not built
    assert (found.path / "deep" / "a.bin").read_bytes() == b"light"


def test_a_published_store_opens_with_plain_zarr(bucket: str, machine: Machine) -> None:
    """Without SpectralZoom, the manifest's hash gives the folder; zarr and obstore read it."""
    import hashlib

    import zarr
    from obstore.store import S3Store

    def build(path: Path) -> None:
        write_image(create_group(path / "m.zarr", "m", {}), "values", ("y", "x"), np.eye(40, dtype=np.uint8), {})

    ref, _ = machine(FIRST).produce("rectify", build, version=1, params={})
    name, _, prefix = bucket.removeprefix("s3://").partition("/")
    store = S3Store(name, prefix=f"{prefix}/{ref.uri}", client_options={"allow_http": True})
    text = bytes(store.get("manifest.json").bytes())
    assert "m.zarr/zarr.json" in json.loads(text)["files"]
    folder = f"{prefix}/{ref.uri}/{hashlib.sha256(text).hexdigest()[:16]}/m.zarr"
    inner = S3Store(name, prefix=folder, client_options={"allow_http": True})
    group = zarr.open_group(zarr.storage.ObjectStore(inner, read_only=True), mode="r", use_consolidated=False)
    np.testing.assert_array_equal(group["values"][:], np.eye(40))


@pytest.mark.parametrize("text", ["s3://", "s3:///bucket", "s3://ok/../x", "s3://bucket/a//b", "s3://bucket/a b"])
def test_invalid_addresses_are_refused(text: str) -> None:
    """A prefix has plain letters only and cannot lead upwards."""
    assert is_remote(text)
    with pytest.raises(SettingsError, match=r"expected s3://bucket/prefix"):
        parse_place(text)


@pytest.mark.parametrize(
    ("endpoint", "words"),
    {"nonsense": "is no address", "http://10.0.0.1:90": "plain http", "ftp://x": "no address", "http://": "no"}.items(),
)
def test_unusable_endpoints_are_refused(endpoint: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plain http is allowed for this machine only, unless a setting permits it."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    with pytest.raises(SettingsError, match=words):
        parse_place("s3://bucket/x")


def test_a_missing_bucket_or_archive_is_one_clear_error(bucket: str) -> None:
    """The error says what is missing and what to do."""
    with pytest.raises(ArchiveError, match=r"s3://no-such-bucket/x at http://.*: there is no such bucket: create it"):
        open_archive("s3://no-such-bucket/x")
    with pytest.raises(ArchiveError, match="is not there; check the name"):
        open_archive(f"{bucket}-none", create=False)
    assert not is_archive(f"{bucket}-none")


@pytest.mark.parametrize("text", ["gs://bucket/x", "http://host/x", "S3://bucket/x"])
def test_other_kinds_of_addresses_are_refused(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such addresses are not taken for folders, and no folder of that name is created."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingsError, match=r"expected a folder, or s3://bucket/prefix"):
        open_archive(text)
    with pytest.raises(SettingsError, match=r"expected a folder, or s3://bucket/prefix"):
        is_archive(text)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("Server returned non-2xx status code: 503 Service Unavailable: SlowDown", "run again later"),
        ("Server returned non-2xx status code: 418 I'm a teapot", "418 I'm a teapot"),
        ("403 Forbidden: <Error><Code>RequestTimeTooSkewed</Code></Error>", "the clock of this machine is wrong"),
        ("HTTP error: request or response body error", "check the network"),
        ("Received redirect without LOCATION", "set AWS_REGION"),
        ("The AWS Access Key Id does not exist: InvalidAccessKeyId", "check the credentials"),
    ],
)
def test_errors_of_a_bucket_are_explained(bucket: str, answer: str, words: str) -> None:
    """The message separates failures that pass by themselves from those that a person has to fix."""
    from obstore.exceptions import GenericError

    with pytest.raises(UnreachableError, match=re.escape(words)), object_stores.answers_of(parse_place(bucket)):
        raise GenericError(answer)


def test_copies_between_bucket_and_folder_are_no_archives(bucket: str, machine: Machine, tmp_path: Path) -> None:
    """Bucket and folder have other layouts: a copy is neither verified nor repaired nor continued."""
    ref, _ = make(machine(FIRST))
    objects = Objects(parse_place(bucket))
    for path in objects.listing():
        (tmp_path / "copy" / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "copy" / path).write_bytes(objects.read(path) or b"")
    with pytest.raises(ArchiveError, match="is a copy of the objects of a bucket"):
        open_archive(tmp_path / "copy", create=False)
    other = Objects(parse_place(f"{bucket}-folder"))
    other.create(f"{ref.uri}/manifest.json", b"{}")
    with pytest.raises(ArchiveError, match=r"has stages and no archive\.json"):
        open_archive(f"{bucket}-folder")
    assert other.read("archive.json") is None


@pytest.mark.parametrize("create", [True, False])
def test_an_archive_with_another_marker_is_refused(bucket: str, machine: Machine, create: bool) -> None:
    """The file may be a network's login page, which answers every request, or of a later version."""
    machine(FIRST).objects.write("archive.json", b"<html>welcome</html>")
    with pytest.raises(ArchiveError, match=r"archive\.json is not as expected"):
        open_archive(bucket, create=create)

"""Archives that are copied to a bucket and back: every byte is compared, and the first writer of a store wins."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("obstore", reason="obstore is not installed (extra s3)")

from spectralzoom.flows.cli.main import main
from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, SettingsError
from spectralzoom.storage.remote.bucket import Copied, pull, push
from spectralzoom.storage.remote.objects import Objects, UnreachableError, answers_of, parse_place
from spectralzoom.storage.runs import clear_up, verify_everything
from spectralzoom.storage.store import Archive, Ref
from tests.storage.small_archive import small_survey


def send(archive: Archive, bucket: str) -> Copied:
    """Push an archive without a progress bar."""
    return push(archive, Objects(parse_place(bucket)), lambda uri, part: None)


def fetch(bucket: str, folder: Path, run: str | None = None) -> tuple[Archive, Copied]:
    """Pull an archive into a folder without a progress bar."""
    archive = Archive.open(folder)
    return archive, pull(Objects(parse_place(bucket)), archive, lambda uri, part: None, run)


def contents(root: Path) -> dict[str, bytes]:
    """Return every file of stores and runs by its address."""
    files = [path for name in ("stages", "runs") for path in (root / name).rglob("*") if path.is_file()]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def problems(root: Path) -> list[str]:
    """Return the problems that verify finds."""
    return [one.problem for one in verify_everything(Archive.open(root)) if one.problem]


def flip(bucket: str, ending: str) -> None:
    """Flip one bit of the first object whose name ends so."""
    objects = Objects(parse_place(bucket))
    name = min(name for name in objects.listing() if name.endswith(ending))
    content = bytearray(objects.read(name) or b"")
    content[-9] ^= 4
    objects.write(name, bytes(content))


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """Return an archive of one survey."""
    one = Archive.open(tmp_path / "here")
    small_survey(one)
    return one


def test_another_machine_gets_the_same_bytes(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """Stores and runs have equal files, verify finds nothing, and a second copy moves nothing."""
    sent = send(archive, bucket)
    other, fetched = fetch(bucket, tmp_path / "there")
    assert contents(other.root) == contents(archive.root)
    assert (sent.copied, sent.bytes, sent.there, sent.conflicts) == (fetched.copied, fetched.bytes, 0, [])
    assert problems(other.root) == []
    assert (send(archive, bucket).bytes, fetch(bucket, other.root)[1].copied) == (0, [])


def test_additions_of_another_machine_come_back(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """Two machines survey in turns, by pull and push."""
    send(archive, bucket)
    other, _ = fetch(bucket, tmp_path / "there")
    small_survey(other, seed=1)
    send(other, bucket)
    assert len(fetch(bucket, archive.root)[1].copied) == 4
    assert contents(other.root) == contents(archive.root)


def test_one_run_comes_with_the_stores_that_it_names(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """Other runs and their stores stay in the bucket; an unknown run is named."""
    second = small_survey(archive, seed=1)
    send(archive, bucket)
    other, fetched = fetch(bucket, tmp_path / "there", second.run.name)
    assert {*fetched.copied} == {second.raw.uri, second.mosaic.uri, second.map.uri, f"runs/{second.run.name}"}
    assert [folder.name for folder in other.runs()] == [second.run.name]
    assert fetch(bucket, tmp_path / "latest", "latest")[1].copied == fetched.copied
    with pytest.raises(ArchiveError, match=f"has no run 'none'; its latest are .*{second.run.name}"):
        fetch(bucket, tmp_path / "there", "none")


def test_a_flipped_bit_here_is_not_sent(archive: Archive, bucket: str) -> None:
    """The file is named, and the bucket has no manifest of its store."""
    (file,) = archive.root.glob("stages/rectify/*/data.bin")
    file.write_bytes(b"\0" + file.read_bytes()[1:])
    with pytest.raises(IncompleteStoreError, match=r"rectify/.*data\.bin has changed"):
        send(archive, bucket)
    assert not [one for one in Objects(parse_place(bucket)).listing() if re.search("rectify.*manifest", one)]


@pytest.mark.parametrize("ending", ["data.bin", "receipt.json", "manifest.json"])
def test_a_flipped_bit_in_the_bucket_is_not_taken(archive: Archive, bucket: str, tmp_path: Path, ending: str) -> None:
    """The object is named, and its store or run is not in the archive, nor a part of it."""
    send(archive, bucket)
    flip(bucket, ending)
    with pytest.raises(IncompleteStoreError, match=rf"{bucket}/(stages|runs)/"):
        fetch(bucket, tmp_path / "there")
    assert problems(tmp_path / "there") == []
    assert not [*(tmp_path / "there").rglob("*.part")]


def test_a_stopped_push_continues(
    archive: Archive, bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A store whose manifest is missing does not count for others; the same command sends the rest."""
    create = Objects.create

    def stopped(self: Objects, name: str, content: bytes) -> bool:
        return pytest.fail("stopped") if "segment" in name else create(self, name, content)

    with monkeypatch.context() as patched:
        patched.setattr(Objects, "create", stopped)
        with pytest.raises(pytest.fail.Exception, match="stopped"):
            send(archive, bucket)
    assert {uri.split("/")[1] for uri in fetch(bucket, tmp_path / "there")[1].copied} == {"capture", "rectify"}
    assert len(send(archive, bucket).copied) == 2
    assert contents(fetch(bucket, tmp_path / "there")[0].root) == contents(archive.root)


def test_the_first_writer_of_a_store_wins(bucket: str, tmp_path: Path) -> None:
    """Two machines make one key with other bytes; their files are never mixed."""

    def make(name: str) -> Ref:
        machine = Archive.open(tmp_path / name)

        def build(part: Path) -> None:
            (part / "a.bin").write_text(name)

        ref, _ = machine.produce("score", build, version=1, params={})
        send(machine, bucket)
        return ref

    assert make("first") == make("second")
    other, _ = fetch(bucket, tmp_path / "there")
    assert [path.read_text() for path in other.root.glob("stages/score/*/a.bin")] == ["first"]
    assert problems(other.root) == []


def test_runs_of_two_machines_with_one_name_are_named(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """Neither replaces the other; the command ends with the code for a part."""
    send(archive, bucket)
    other = Archive.open(tmp_path / "there")
    run = small_survey(other, seed=1).run
    run.rename(run.with_name(archive.runs()[0].name))
    assert send(other, bucket).conflicts == [f"runs/{archive.runs()[0].name}"]
    with pytest.raises(SystemExit) as ended:
        main(["push", str(other.root), bucket])
    assert ended.value.code == 3


def test_a_cleared_store_stays_cleared(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """Its manifest and its mark are copied."""
    raw = archive.refs("capture")[0]
    archive.clear(raw)
    send(archive, bucket)
    other, _ = fetch(bucket, tmp_path / "there")
    assert other.find(raw.stage, raw.key) is None
    assert other.is_known(raw)
    assert problems(other.root) == []


def test_gc_works_on_a_copy(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """Stores that no run names are removed from the copy alone; a pull brings them back."""
    small_survey(archive, seed=1, named=False)
    send(archive, bucket)
    other, _ = fetch(bucket, tmp_path / "there")
    assert len(clear_up(other, keep_days=0).removals) == 3
    assert len(fetch(bucket, other.root)[1].copied) == 3


def test_addresses_that_lead_out_of_the_archive_are_ignored(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """Objects of other programs lie in the bucket, some with hostile names."""
    send(archive, bucket)
    for name in ("manifest.json", "runs/a b/manifest.json", "stages/x/.hidden/manifest.json", "notes/manifest.json"):
        Objects(parse_place(bucket)).write(name, b"{}")
    other, _ = fetch(bucket, tmp_path / "there")
    assert contents(other.root) == contents(archive.root)


def test_a_store_without_conditional_puts_is_refused(
    archive: Archive, bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There two machines could destroy each other's stores: nothing is sent."""
    monkeypatch.setattr(Objects, "create", lambda self, name, content: True)
    monkeypatch.setattr(Objects, "remove", lambda self, name: None)
    with pytest.raises(ArchiveError, match="ignores conditional puts"):
        send(archive, bucket)
    assert Objects(parse_place(bucket)).listing() == set()


def test_the_verbs_copy_an_archive(
    archive: Archive, bucket: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their last line counts stores and runs."""
    for words in (["push", str(archive.root), bucket], ["pull", bucket, str(tmp_path / "there")]):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert not ended.value.code
        captured = capsys.readouterr()
        assert "Copied 3 stores and 1 run" in captured.out + captured.err
    assert contents(tmp_path / "there") == contents(archive.root)


BAD = ["s3://", "s3:///bucket", "s3://ok/../x", "s3://bucket/a//b", "s3://bucket/a b", "gs://bucket/x"]


@pytest.mark.parametrize("text", BAD)
def test_invalid_addresses_are_refused(text: str) -> None:
    """A prefix has plain letters only and cannot lead upwards."""
    with pytest.raises(SettingsError, match=r"expected s3://bucket/prefix"):
        parse_place(text)


@pytest.mark.parametrize("text", ["s3://bucket/x", "gs://bucket/x", "http://host/x", "S3://bucket/x"])
def test_an_address_is_no_archive(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message names the verbs that copy, and no folder of that name is created."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ArchiveError, match=f"{text} is not a folder: .* pull copies"):
        Archive.open(text)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("endpoint", "words"),
    {"nonsense": "is no address", "http://10.0.0.1:90": "plain http", "ftp://x": "no address", "http://": "no"}.items(),
)
def test_unusable_endpoints_are_refused(endpoint: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plain http is allowed for this machine only, unless a setting permits it."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    with pytest.raises(SettingsError, match=words):
        parse_place("s3://bucket/x")


def test_a_missing_bucket_or_archive_is_one_clear_error(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """The error says what is missing and what to do."""
    with pytest.raises(UnreachableError, match=r"s3://no-such-bucket/x at http://.*: there is no such bucket: create"):
        send(archive, "s3://no-such-bucket/x")
    with pytest.raises(ArchiveError, match=f"{bucket}-none has no archive: check the address"):
        fetch(f"{bucket}-none", tmp_path / "there")


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

    with pytest.raises(UnreachableError, match=re.escape(words)), answers_of(parse_place(bucket)):
        raise GenericError(answer)

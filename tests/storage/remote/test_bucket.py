"""Archives that are copied to a bucket and back: every byte is compared, and the first writer of a store wins."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from threading import Barrier
from time import monotonic
from typing import Any

import pytest

pytest.importorskip("obstore", reason="obstore is not installed (extra s3)")

from spectralzoom.flows.cli.main import main
from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, SettingsError
from spectralzoom.storage.remote import objects as requests
from spectralzoom.storage.remote.all_names import signed
from spectralzoom.storage.remote.bucket import Copied, pull, push
from spectralzoom.storage.remote.objects import Objects, UnreachableError
from spectralzoom.storage.runs import clear_up, verify_everything
from spectralzoom.storage.store import Archive, Ref, digest_of, is_cleared, manifest_text, publish
from tests.faulty_proxy import FAULTS, Choose, faulty_proxy
from tests.object_server import overwrite
from tests.storage.small_archive import make_store, publish_receipt, small_survey


def send(archive: Archive, bucket: str) -> Copied:
    """Push an archive without a progress bar."""
    return push(archive, Objects(bucket), lambda uri, part: None)


def fetch(bucket: str, folder: Path, run: str | None = None) -> tuple[Archive, Copied]:
    """Pull an archive into a folder without a progress bar."""
    archive = Archive.open(folder)
    return archive, pull(Objects(bucket), archive, lambda uri, part: None, run)


def contents(root: Path) -> dict[str, bytes]:
    """Return every file of stores and runs by its address."""
    files = [path for name in ("stages", "runs") for path in (root / name).rglob("*") if path.is_file()]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def problems(root: Path) -> list[str]:
    """Return the problems that verify finds."""
    return [one.problem for one in verify_everything(Archive.open(root)) if one.problem]


def flip(bucket: str, ending: str) -> None:
    """Flip one bit of the first object whose name ends so."""
    objects = Objects(bucket)
    name = min(name for name in objects.listing() if name.endswith(ending))
    content = bytearray(objects.read(name) or b"")
    content[-9] ^= 4
    overwrite(objects, name, bytes(content))


@pytest.fixture
def broken(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Choose], None]]:
    """Return a function that puts a proxy with the chosen faults before the server."""
    with ExitStack() as proxies:

        def start(choose: Choose) -> None:
            monkeypatch.setenv("AWS_ENDPOINT_URL", proxies.enter_context(faulty_proxy(s3_server, choose)))

        yield start


Broken = Callable[[Choose], None]


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


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_the_network_change_no_byte(bucket: str, tmp_path: Path, broken: Broken, fault: str) -> None:
    """Two machines push and pull while the first request of each kind fails."""
    asked: set[tuple[str, str]] = set()

    def choose(method: str, path: str) -> str | None:
        kind = method, path.rpartition("/")[2]
        is_new = kind not in asked
        asked.add(kind)
        return fault if is_new else None

    broken(choose)
    one, two = (Archive.open(tmp_path / name) for name in ("one", "two"))
    for seed, machine in enumerate((one, two)):
        run = small_survey(machine, seed=seed).run
        run.rename(run.with_name(f"2026010{seed + 1}T000000-farm"))
        send(machine, bucket)
        asked.clear()
    assert [len(fetch(bucket, machine.root)[1].copied) for machine in (one, two)] == [4, 4]
    assert contents(one.root) == contents(two.root)
    assert problems(one.root) == []


def test_large_objects_travel_in_parts(bucket: str, tmp_path: Path, broken: Broken) -> None:
    """Of three parts each is lost or cut once on its way."""
    counter = count()
    broken(lambda method, path: (None, "lost", None, "cut", None, "503")[next(counter) % 6])
    one = Archive.open(tmp_path / "here")
    content = os.urandom(2 * requests.PART_BYTES + 5)
    one.produce("capture", lambda folder: (folder / "lines.bin").write_bytes(content), version=1, params={})
    send(one, bucket)
    assert contents(fetch(bucket, tmp_path / "there")[0].root) == contents(one.root)


@pytest.mark.parametrize("fault", ["reset", "503", "flip"])
def test_a_fault_that_stays_leaves_nothing_partial(
    archive: Archive, bucket: str, tmp_path: Path, broken: Broken, fault: str
) -> None:
    """It ends in one message, and the same command continues later."""
    send(archive, bucket)
    failing = [fault]
    broken(lambda method, path: failing[0] if failing and "data.bin" in path and "rectify" in path else None)
    with pytest.raises(
        (ArchiveError, IncompleteStoreError), match=f"^{bucket}.*(run again|check the network|remove this store)"
    ):
        fetch(bucket, tmp_path / "there")
    assert [uri.split("/")[1] for uri in contents(tmp_path / "there")] == ["capture"] * 2
    assert not [*(tmp_path / "there").rglob("*.part")]
    failing.clear()
    assert contents(fetch(bucket, tmp_path / "there")[0].root) == contents(archive.root)


PULL = """
import sys
from pathlib import Path
from spectralzoom.storage.remote.bucket import pull
from spectralzoom.storage.remote.objects import Objects
from spectralzoom.storage.store import Archive
print("begun", flush=True)
pull(Objects(sys.argv[1]), Archive.open(sys.argv[2]), lambda uri, part: None)
"""


def test_a_killed_pull_continues(archive: Archive, bucket: str, tmp_path: Path, broken: Broken) -> None:
    """It is killed while it waits for a file: what is there is whole, and the leftover goes with the next pull."""
    send(archive, bucket)
    killed: list[subprocess.Popen[bytes]] = []

    def kill(method: str, path: str) -> str | None:
        if "segment" in path and "data.bin" in path and killed:
            killed[0].send_signal(signal.SIGKILL)
            killed.pop().wait()
        return None

    broken(kill)
    command = [sys.executable, "-c", PULL, bucket, str(tmp_path / "there")]
    with subprocess.Popen(command, cwd=Path(__file__).parents[3], stdout=subprocess.PIPE) as process:
        killed.append(process)
        assert process.wait() == -signal.SIGKILL
    assert problems(tmp_path / "there") == []
    assert len([*(tmp_path / "there").rglob("*.part")]) == 1
    assert len(fetch(bucket, tmp_path / "there")[1].copied) == 2
    assert contents(tmp_path / "there") == contents(archive.root)
    assert not [*(tmp_path / "there").rglob("*.part")]


def test_two_machines_push_at_the_same_time(bucket: str, tmp_path: Path, broken: Broken) -> None:
    """Both have made one store with other manifests, and other runs of one name: the first writer of each wins."""
    together, listed = Barrier(2), count()

    def meet(method: str, path: str) -> str | None:
        if method == "GET" and "list-type" in path and next(listed) < 2:
            together.wait(20)  # so that both find the bucket empty
        return None

    broken(meet)
    machines = [Archive.open(tmp_path / name) for name in ("one", "two")]
    for machine, name in zip(machines, ("one", "two"), strict=True):
        run = publish_receipt(machine, {"made by": name}, make_store(machine, "capture", {}, []))
        run.rename(run.with_name("20260101T000000-farm"))
    with ThreadPoolExecutor(2) as pool:
        sent = [*pool.map(lambda machine: send(machine, bucket), machines)]
    assert sorted(len(one.copied) + len(one.conflicts) for one in sent) in ([1, 2], [1, 3], [2, 2])
    assert sorted(one.conflicts for one in sent) == [[], ["runs/20260101T000000-farm"]]
    other, _ = fetch(bucket, tmp_path / "other")
    assert problems(other.root) == []
    winner = next(machine for machine, one in zip(machines, sent, strict=True) if not one.conflicts)
    assert (other.runs()[0] / "receipt.json").read_bytes() == (winner.runs()[0] / "receipt.json").read_bytes()


def test_a_pull_during_a_push_gets_whole_stores(archive: Archive, bucket: str, tmp_path: Path, broken: Broken) -> None:
    """At each manifest that is sent another machine pulls; a run comes with its stores alone."""
    seen: list[int] = []

    def pull_now(method: str, path: str) -> str | None:
        if method == "PUT" and path.endswith("manifest.json") and Objects(bucket).listing() > {".conditional-put"}:
            with suppress(ArchiveError):  # no archive yet
                seen.append(len(fetch(bucket, tmp_path / "there")[1].copied))
                assert problems(tmp_path / "there") == []
        return None

    broken(pull_now)
    send(archive, bucket)
    assert seen == [1, 1, 1]


@pytest.mark.parametrize("is_link", [False, True])
def test_a_file_that_differs_only_while_it_is_sent_is_not_published(
    archive: Archive, bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_link: bool
) -> None:
    """Another process replaces it after it was checked, and puts it back."""
    write, aside, other = Objects.write, tmp_path / "aside", tmp_path / "other"
    other.write_text("private")

    def changed(self: Objects, name: str, source: Path, sha256: str) -> None:
        source.rename(aside)
        source.symlink_to(other) if is_link else source.write_bytes(aside.read_bytes()[::-1])
        try:
            write(self, name, source, sha256)
        finally:
            aside.replace(source)

    monkeypatch.setattr(Objects, "write", changed)
    with pytest.raises((ArchiveError, IncompleteStoreError), match=r"data\.bin (has changed|is a link)"):
        send(archive, bucket)
    assert problems(archive.root) == []
    assert not [name for name in Objects(bucket).listing() if name.endswith("manifest.json")]


def test_a_store_cleared_meanwhile_is_sent_as_cleared(archive: Archive, bucket: str, broken: Broken) -> None:
    """Another survey deletes its raw lines while they are sent."""
    raw = archive.refs("capture")[0]

    def clear(method: str, path: str) -> str | None:
        if method == "PUT" and "capture" in path and archive.is_there(raw.uri):
            archive.clear(raw)
        return None

    broken(clear)
    assert raw.uri in send(archive, bucket).copied
    assert f"{raw.uri}/cleared.json" in Objects(bucket).listing()
    assert f"{raw.uri}/manifest.json" not in Objects(bucket).listing()


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


@pytest.mark.parametrize("name", ["data.bin", "mosaic.zarr/scores/c/0"])
def test_a_flipped_bit_here_is_not_sent(bucket: str, tmp_path: Path, name: str) -> None:
    """The file is named, be it a chunk of an array, and the bucket has no manifest of its store."""

    def build(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"\1")

    archive = Archive.open(tmp_path)
    ref, _ = archive.produce("rectify", build, version=1, params={})
    (ref.path / name).write_bytes(b"\0")
    with pytest.raises(IncompleteStoreError, match=rf"rectify/.*{name} has changed"):
        send(archive, bucket)
    assert not [one for one in Objects(bucket).listing() if one.endswith("manifest.json")]


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

    def stopped(self: Objects, name: str, content: bytes) -> bytes:
        return pytest.fail("stopped") if "segment" in name else create(self, name, content)

    with monkeypatch.context() as patched:
        patched.setattr(Objects, "create", stopped)
        with pytest.raises(pytest.fail.Exception, match="stopped"):
            send(archive, bucket)
    assert {uri.split("/")[1] for uri in fetch(bucket, tmp_path / "there")[1].copied} == {"capture", "rectify"}
    assert len(send(archive, bucket).copied) == 2
    assert contents(fetch(bucket, tmp_path / "there")[0].root) == contents(archive.root)


@pytest.mark.parametrize("is_cleared_there", [False, True])
def test_other_content_of_a_store_is_named_without_a_run(bucket: str, tmp_path: Path, is_cleared_there: bool) -> None:
    """A push tells of a store that the bucket has otherwise; the run that rests on it there can be pulled."""
    first, other = (Archive.open(tmp_path / name) for name in ("first", "other"))
    raw = small_survey(first, seed=4).raw
    if is_cleared_there:
        first.clear(raw)
    send(first, bucket)
    publish(other.root / raw.uri, lambda folder: (folder / "data.bin").write_text("another light") and {})
    if is_cleared_there:
        with pytest.raises(
            IncompleteStoreError, match=f"^{raw.uri} cannot be .* digest is .{{12}} here and .{{12}} there"
        ):
            send(other, bucket)
    else:
        assert send(other, bucket).conflicts == [raw.uri]
    assert len(fetch(bucket, tmp_path / "third")[0].runs()) == 1
    assert problems(tmp_path / "third") == []


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
    """Its manifest and its mark are copied; when it was made again, its files are."""
    raw = archive.refs("capture")[0]
    archive.clear(raw)
    send(archive, bucket)
    other, _ = fetch(bucket, tmp_path / "there")
    assert other.find(raw.stage, raw.key) is None
    assert is_cleared(other.ref(raw.stage, raw.key).path)
    assert problems(other.root) == []
    small_survey(archive, named=False)
    assert send(archive, bucket).copied == [raw.uri]
    assert fetch(bucket, tmp_path / "later")[0].find(raw.stage, raw.key) is not None
    archive.clear(raw)
    assert send(archive, bucket).copied == []


def test_stores_in_neither_place_are_named(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """A run names a store that gc has removed as damaged."""
    mosaic = archive.refs("rectify")[0].uri
    archive.discard(mosaic)
    assert send(archive, bucket).missing == [mosaic]
    assert fetch(bucket, tmp_path / "there", "latest")[1].missing == [mosaic]


def test_gc_works_on_a_copy(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """Stores that no run names are removed from the copy alone; a pull brings them back."""
    small_survey(archive, seed=1, named=False)
    send(archive, bucket)
    other, _ = fetch(bucket, tmp_path / "there")
    assert len(clear_up(other, keep_days=0).removals) == 3
    assert len(fetch(bucket, other.root)[1].copied) == 3


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"../../../x": [1, ""]}, "no file of this folder"),
        ({"/etc/x": [1, ""]}, "no file of this folder"),
        ({"a": [-1, ""]}, "has changed"),
        ({"a": [1, ""], "a/b": [1, ""]}, "has changed|can be no file"),
        ({"n" * 300: [1, ""]}, "can be no file: File name too long"),
    ],
)
def test_a_hostile_manifest_is_refused(bucket: str, tmp_path: Path, files: dict[str, Any], words: str) -> None:
    """Nothing is written outside of its store, nor more than it declares."""
    text = manifest_text({"files": files}).encode()
    place, objects = "stages/x/y", Objects(bucket)
    overwrite(objects, f"{place}/manifest.json", text)
    for name in ("a", "a/b", "n" * 300):
        overwrite(objects, f"{place}/{hashlib.sha256(text).hexdigest()[:16]}/{name}", bytes(9))
    with pytest.raises((ArchiveError, IncompleteStoreError), match=words):
        fetch(bucket, tmp_path / "there")
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    assert contents(tmp_path / "there") == {}


def test_addresses_that_lead_out_of_the_archive_are_ignored(archive: Archive, bucket: str, tmp_path: Path) -> None:
    """Objects of other programs lie in the bucket, some with hostile names."""
    send(archive, bucket)
    for name in ("manifest.json", "runs/a b/manifest.json", "stages/x/.hidden/manifest.json", "notes/manifest.json"):
        overwrite(Objects(bucket), name, b"{}")
    other, _ = fetch(bucket, tmp_path / "there")
    assert contents(other.root) == contents(archive.root)


def test_a_store_without_conditional_puts_is_refused(archive: Archive, bucket: str, broken: Broken) -> None:
    """There two machines could destroy each other's stores: nothing is sent."""
    broken(lambda method, path: "unconditional")
    with pytest.raises(ArchiveError, match="ignores conditional puts"):
        send(archive, bucket)
    assert Objects(bucket).listing() == {".conditional-put"}


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
        Objects(text)


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
        Objects("s3://bucket/x")


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

    assert words in str(Objects(bucket).explain(GenericError(answer)))


# --- two machines with other bytes ------------------------------------------------------------------------------------


def other_mosaics(folder: Path) -> tuple[Archive, Archive]:
    """Return two archives with a run each, over stores of the same keys, of which the mosaics differ."""
    archives = Archive.open(folder / "one"), Archive.open(folder / "two")
    for number, archive in enumerate(archives):

        def build(part: Path, number: int = number) -> None:
            (part / "data.bin").write_bytes(bytes([number]))

        raw = make_store(archive, "sweeps", {}, [])
        mosaic, _ = archive.produce("mosaic", build, version=1, params={}, inputs=[raw])
        drawn = make_store(archive, "draw", {}, [mosaic])  # before its inputs, by name
        run = publish_receipt(archive, {}, drawn)
        run.rename(run.with_name(f"2026010{number + 1}T000000-farm"))
        make_store(archive, "alone", {"machine": number}, [])
    return archives


def test_a_push_onto_other_bytes_is_an_error_with_both_sides(bucket: str, tmp_path: Path) -> None:
    """Neither the run nor the map of the second machine is sent, but all that does not rest on the mosaic is."""
    one, two = other_mosaics(tmp_path)
    send(one, bucket)
    drawn = one.refs("draw")[0].uri
    digests = [str(digest_of(archive.root / drawn))[:12] for archive in (two, one)]
    run = "runs/20260102T000000-farm"
    both = f"made of {drawn} with digest {digests[0]}, but {bucket} has another {drawn}, with digest {digests[1]}"
    for _ in range(2):
        with pytest.raises(IncompleteStoreError, match=f"cannot be copied to {bucket}: it was {both}; two machines"):
            send(two, bucket)
        there = {name.rpartition("/")[0] for name in Objects(bucket).listing() if name.endswith("manifest.json")}
        assert two.refs("alone")[0].uri in there
        assert run not in there
    copy, _ = fetch(bucket, tmp_path / "copy")
    assert problems(copy.root) == []
    assert [one.name for one in copy.runs()] == ["20260101T000000-farm"]


def test_a_pull_onto_other_bytes_is_an_error_with_both_sides(bucket: str, tmp_path: Path) -> None:
    """The run of the bucket does not appear beside this archive's own mosaic."""
    one, two = other_mosaics(tmp_path)
    send(one, bucket)
    for run in (None, "20260101T000000-farm"):
        with pytest.raises(IncompleteStoreError, match=f"cannot be copied to {two.root}: .* {two.root} has another"):
            fetch(bucket, two.root, run)
        assert [one.name for one in two.runs()] == ["20260102T000000-farm"]
    assert two.is_there(one.refs("alone")[0].uri)
    assert problems(two.root) == []


def test_two_machines_with_other_bytes_push_at_the_same_time(bucket: str, tmp_path: Path, broken: Broken) -> None:
    """Two processes find an empty bucket: one run arrives with its own stores, the other machine gets an error."""
    together, listed = Barrier(2), count()

    def meet(method: str, path: str) -> str | None:
        if method == "GET" and "list-type" in path and next(listed) < 2:
            together.wait(60)
        return None

    broken(meet)
    roots = [archive.root for archive in other_mosaics(tmp_path)]
    script = "import sys; from spectralzoom.flows.cli.main import main; main(sys.argv[1:])"
    commands = [[sys.executable, "-c", script, "push", str(root), bucket] for root in roots]
    processes = [
        subprocess.Popen(words, cwd=Path(__file__).parents[3], stderr=subprocess.PIPE, text=True) for words in commands
    ]
    ended = [(process.communicate()[1], process.returncode) for process in processes]
    assert sorted(code for _, code in ended) in ([0, 1], [1, 1])
    assert all("two machines made it" in text for text, code in ended if code)
    copy, _ = fetch(bucket, tmp_path / "copy")
    assert problems(copy.root) == []
    assert len(copy.runs()) <= 1


def test_equal_stores_of_two_machines_are_no_conflict(bucket: str, tmp_path: Path) -> None:
    """They were made at other times, and one of them again."""
    machines = [Archive.open(tmp_path / name) for name in ("one", "two")]
    for number, machine in enumerate(machines):
        small = small_survey(machine)
        machine.clear(small.mosaic)
        small_survey(machine, named=False)
        small.run.rename(small.run.with_name(f"2026010{number + 1}T000000-farm"))
        send(machine, bucket)
    copy, _ = fetch(bucket, tmp_path / "copy")
    assert len(copy.runs()) == 2
    assert problems(copy.root) == []


# --- order, names and time of requests --------------------------------------------------------------------------------


def test_a_pull_killed_anywhere_leaves_no_store_before_its_inputs(bucket: str, tmp_path: Path, broken: Broken) -> None:
    """It ends at every other object in turn: verify finds no store or run that lacks an input."""
    one, _ = other_mosaics(tmp_path)
    send(one, bucket)
    asked, last = count(), [0]

    def end(method: str, path: str) -> str | None:
        return "reset" if "list-type" not in path and next(asked) >= last[0] else None

    broken(end)
    for last[0] in range(0, 12, 2):
        asked = count()
        try:
            there, _ = fetch(bucket, tmp_path / f"there{last[0]}")
        except ArchiveError:
            there = Archive.open(tmp_path / f"there{last[0]}")
        assert problems(there.root) == []
    asked = count(-100)
    assert len(fetch(bucket, tmp_path / "there0")[0].runs()) == 1


BAD_NAMES = [
    "stages//x/manifest.json",
    "runs/../y",
    "stages/a\x01/k/manifest.json",
    "runs/2026\x7f/receipt.json",
    "./x",
]


@pytest.mark.parametrize("name", BAD_NAMES)
def test_an_object_of_a_bad_name_is_named_and_the_rest_is_pulled(
    archive: Archive, bucket: str, tmp_path: Path, s3_server: str, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The names of a bucket need not be paths; push works on, too."""
    import boto3

    send(archive, bucket)
    client = boto3.client("s3", endpoint_url=s3_server)
    prefix = bucket.removeprefix("s3://surveys/")
    client.put_object(Bucket="surveys", Key=f"{prefix}/{name}", Body=b"")
    there, fetched = fetch(bucket, tmp_path / "there")
    assert contents(there.root) == contents(archive.root)
    assert fetched.bad_names == [name]
    assert send(archive, bucket).bad_names == [name]
    with pytest.raises(SystemExit) as ended:
        main(["pull", bucket, str(tmp_path / "again")])
    assert ended.value.code == 3
    assert "a name that no client can ask for: remove it" in capsys.readouterr().out
    client.delete_object(Bucket="surveys", Key=f"{prefix}/{name}")
    client.close()


def test_requests_are_signed_as_botocore_signs_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """With and without a session token, at AWS and at another server."""
    from botocore.auth import S3SigV4Auth
    from botocore.awsrequest import AWSRequest
    from botocore.credentials import Credentials

    now = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
    for endpoint, token in (("", None), ("http://127.0.0.1:9000", "a token/+=")):
        for name, value in {
            "AWS_ACCESS_KEY_ID": "key",
            "AWS_SECRET_ACCESS_KEY": "sec/ret",
            "AWS_REGION": "eu-x-1",
        }.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv("AWS_SESSION_TOKEN", token or "")
        query = {"prefix": "a b/ü/", "list-type": "2", "continuation-token": "x+/=="}
        made = signed("bucket", query, endpoint, now)
        theirs = AWSRequest("GET", made.full_url, headers={"X-Amz-Content-SHA256": hashlib.sha256(b"").hexdigest()})
        theirs.context["timestamp"] = "20260304T050607Z"
        auth = S3SigV4Auth(Credentials("key", "sec/ret", token), "s3", "eu-x-1")
        monkeypatch.setattr("botocore.auth.get_current_datetime", lambda: now.replace(tzinfo=None))
        auth.add_auth(theirs)
        assert made.get_header("Authorization") == theirs.headers["Authorization"]


def test_the_rest_of_a_bucket_with_a_damaged_store_is_pulled(bucket: str, tmp_path: Path) -> None:
    """The error names the store; the run that rests on it is left out, another one comes."""
    one = Archive.open(tmp_path / "one")
    bad, good = small_survey(one, seed=1), small_survey(one, seed=2)
    send(one, bucket)
    name = next(name for name in Objects(bucket).listing() if bad.mosaic.uri in name and name.endswith("data.bin"))
    overwrite(Objects(bucket), name, b"x")
    with pytest.raises(IncompleteStoreError, match=rf"{name} has changed .*\. All that does not rest on it was copied"):
        fetch(bucket, tmp_path / "there")
    there = Archive.open(tmp_path / "there")
    assert [run.name for run in there.runs()] == [good.run.name]
    assert problems(there.root) == []


@pytest.mark.parametrize(("method", "part"), [("GET", "list-type"), ("PUT", "data.bin"), ("PUT", "manifest.json")])
def test_a_stalled_request_is_given_up_in_time(
    archive: Archive, bucket: str, broken: Broken, monkeypatch: pytest.MonkeyPatch, method: str, part: str
) -> None:
    """The limit holds for a request with all its repetitions; here it is a tenth of the real one."""
    monkeypatch.setattr(requests, "REQUEST_S", 1)
    broken(lambda by, path: "stall" if by == method and part in path else None)
    began = monotonic()
    with pytest.raises(UnreachableError, match="it does not answer: check the network"):
        send(archive, bucket)
    assert 1 < monotonic() - began < 6


def test_a_larger_request_may_take_longer() -> None:
    """At least 26 kB/s; an absurd size has a limit too."""
    limits = [requests._seconds(size) for size in (0, 10_000, 1 << 20, requests.PART_BYTES, 1 << 60, -5)]
    assert limits == [10, 10, 50, 330, 900, 10]

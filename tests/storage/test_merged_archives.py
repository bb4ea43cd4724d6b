"""Archives that were merged, or that another program wrote into: files and inputs that no manifest states are named."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import spectralzoom
from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.storage.runs import Catalogue, clear_up, read_run, verify_everything
from spectralzoom.storage.store import Archive, Ref, check_store, digest_of
from tests.source_paths import PYTHON_PATH
from tests.storage.small_archive import Small, make_store, problems, publish_receipt, small_survey


def _chunk(folder: Path) -> str:
    (folder / "map.zarr/classes/c/9").mkdir(parents=True, exist_ok=True)
    (folder / "map.zarr/classes/c/9/0").write_bytes(b"\0")
    return "map.zarr/classes/c/9/0"


def _file(name: str) -> Callable[[Path], str]:
    def write(folder: Path) -> str:
        (folder / name).write_bytes(b"")
        return name

    return write


def _link(folder: Path) -> str:
    (folder / "other").symlink_to(folder.parent)
    return "other"


EXTRA = [_chunk, _file(".zattrs"), _file("data.bin~"), _file(".DS_Store"), _link]


@pytest.mark.parametrize("add", EXTRA)
def test_every_opening_names_a_file_that_no_manifest_lists(tmp_path: Path, add: Callable[[Path], str]) -> None:
    """Stores and runs, by key, by address, and by verify; without the file they are whole again."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    for uri, folder in ((small.map.uri, small.map.path), (f"runs/{small.run.name}", small.run)):
        name = add(folder)
        for opening in (lambda uri=uri: archive.locate(uri), lambda folder=folder: check_store(folder)):
            with pytest.raises(
                IncompleteStoreError, match=rf"{uri} is damaged: {name} is not in the manifest: take it"
            ):
                opening()
        assert problems(archive) == [f"{uri} {name} is not in the manifest: take it out of the archive"]
        path = folder / name
        path.unlink()
    add(small.map.path)
    with pytest.raises(IncompleteStoreError, match="not in the manifest"):
        archive.find(small.map.stage, small.map.key)


def test_an_empty_folder_is_no_damage(tmp_path: Path) -> None:
    """Copies of some programs leave one; nothing is read from it."""
    archive = Archive.open(tmp_path)
    ref = make_store(archive, "score", {}, [])
    (ref.path / "empty").mkdir()
    assert archive.find(ref.stage, ref.key) == ref
    assert problems(archive) == []


def twice(tmp_path: Path) -> tuple[Archive, Archive, list[Small]]:
    """Return two archives with the same keys; the mosaic of the second has other bytes, and so has its map."""
    archives = [Archive.open(tmp_path / name) for name in ("one", "two")]
    made: list[Small] = []
    for number, archive in enumerate(archives):

        def build(folder: Path, number: int = number) -> None:
            (folder / "data.bin").write_bytes(bytes([number]))

        raw = make_store(archive, "capture", {}, [])
        mosaic, _ = archive.produce("rectify", build, version=1, params={}, inputs=[raw])
        drawn, _ = archive.produce("draw", build, version=1, params={}, inputs=[mosaic])
        receipt = {"products": {"mosaic": f"{mosaic.uri}/mosaic.zarr"}, "settings": {}}
        made.append(Small(raw, mosaic, drawn, publish_receipt(archive, receipt, drawn)))
    return archives[0], archives[1], made


def join(here: Archive, there: Archive) -> None:
    """Copy the stores and runs of an archive that another lacks, as rsync --ignore-existing does."""
    for path in (*here.root.glob("stages/*/*"), *here.root.glob("runs/*")):
        to = there.root / path.relative_to(here.root)
        if not to.exists():
            to.parent.mkdir(parents=True, exist_ok=True)
            shutil.copytree(path, to)


def test_a_run_beside_another_store_of_its_key_is_refused(tmp_path: Path) -> None:
    """Its digest and that of the store are named; verify finds it, and gc --damaged removes the run alone."""
    one, two, made = twice(tmp_path)
    renamed = made[0].run.with_name("20260101T000000-farm")
    made[0].run.rename(renamed)
    join(one, two)
    uri, stated, found = made[0].map.uri, digest_of(made[0].map.path), digest_of(made[1].map.path)
    assert stated is not None
    assert found is not None
    words = (
        f"it was made of {uri} with digest {stated[:12]}, but {two.root} has another {uri}, with digest {found[:12]}"
    )
    run = two.root / "runs" / renamed.name
    assert read_run(run).problem is not None
    with pytest.raises(IncompleteStoreError, match=words):
        two.locate(f"runs/{renamed.name}/receipt.json")
    with pytest.raises(spectralzoom.Error, match=rf"{renamed.name} is damaged: it was made of"):
        spectralzoom.open(two.root)[renamed.name].receipt  # noqa: B018
    assert f"runs/{renamed.name} {words}" in problems(two)
    assert [one.problem is None for one in Catalogue.read(two).runs].count(False) == 1
    clear_up(two, damaged=verify_everything(two))
    assert problems(two) == []
    assert [one.name for one in two.runs()] == [made[1].run.name]


def test_a_store_beside_another_input_is_refused(tmp_path: Path) -> None:
    """A map without its run was made of the other mosaic: a later survey does not find it."""
    one, two, made = twice(tmp_path)
    shutil.rmtree(made[1].map.path)
    shutil.rmtree(made[1].run)
    shutil.copytree(made[0].map.path, made[1].map.path)
    with pytest.raises(
        IncompleteStoreError, match=f"{made[1].map.uri} is damaged: it was made of {made[1].mosaic.uri}"
    ):
        two.find(made[1].map.stage, made[1].map.key)
    assert problems(one) == []


def test_a_store_made_again_is_no_conflict(tmp_path: Path) -> None:
    """It has the same files and another time; a cleared one states its digest too."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    for ref in (small.raw, small.mosaic):
        archive.clear(ref)
        assert problems(archive) == []
    again = small_survey(archive, named=False)
    assert again.mosaic == small.mosaic
    assert problems(archive) == []
    assert read_run(small.run).problem is None


CLEARS = """
import sys
from spectralzoom.storage.store import Archive
from tests.storage.small_archive import small_survey
archive = Archive.open(sys.argv[1])
print("begun", flush=True)
for _ in range(12):
    small = small_survey(archive, named=False)
    for ref in (small.raw, small.mosaic):
        archive.clear(ref)
"""


def test_a_store_made_again_by_another_process_is_never_refused(tmp_path: Path) -> None:
    """One clears and makes the inputs of a run, the other opens the run, its map and the stores."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    environment = {**os.environ, "PYTHONPATH": PYTHON_PATH}
    command = [sys.executable, "-c", CLEARS, str(tmp_path)]
    looks = 0
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        while other.poll() is None:
            check_store(small.run)
            assert read_run(small.run).problem is None
            for ref in (small.raw, small.mosaic, small.map):
                archive.find(ref.stage, ref.key)
            looks += 1
    assert other.returncode == 0
    assert looks > 1
    assert problems(archive) == []


def test_two_surveys_that_share_inputs_state_the_same_digests(tmp_path: Path) -> None:
    """Digests leave out the time alone: another file or another input gives another one."""
    one, two, made = twice(tmp_path)
    assert digest_of(made[0].raw.path) == digest_of(made[1].raw.path)
    assert digest_of(made[0].mosaic.path) != digest_of(made[1].mosaic.path)

    def same(folder: Path) -> None:
        (folder / "data.bin").write_bytes(b"same")

    def over(archive: Archive, ref: Ref) -> str | None:
        return digest_of(archive.produce("over", same, version=1, params={}, inputs=[ref])[0].path)

    assert over(one, made[0].mosaic) != over(two, made[1].mosaic)
    assert over(one, made[0].raw) == over(two, made[1].raw)

"""A survey into a bucket: the map equals that of a folder, and no stage runs twice, on any machine."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dask.distributed import LocalCluster
from numpy.typing import NDArray

from storage.remote.opening import open_archive

pytest.importorskip("obstore", reason="obstore is not installed (extra s3)")

import spectralzoom
from flows.publish.run_folder import Published
from flows.tasks.open_survey import STAGES
from storage.archive.archive import Archive
from storage.arrays.class_maps import load_class_map
from storage.parallel.pool import THREADS_OF
from storage.remote.object_archive import ObjectArchive
from storage.remote.object_stores import Objects
from tests.conftest import Survey
from tests.flows.conftest import FEW_BANDS, CommandLine
from tests.prior_work import with_effects
from tests.storage.small_bucket import rot

pytestmark = pytest.mark.usefixtures("no_effects")

SMALL = ("--size", "96x64", "--bands", FEW_BANDS, "--engine", "plain")
CACHED = {"cached"}
SCANNED: dict[str, Any] = {"budget": None, "scan_step": "2", "scan_exposure_ms": "25", "keep": "raw"}
OF_THIS = set(STAGES) - {"register_coarse", "register_fine", "ground", "condense_raster"}


def states(receipt: dict[str, Any]) -> set[str]:
    """Return the states of the stages."""
    return {row["state"] for row in receipt["stages"]}


def map_of(archive: Archive, published: Published) -> NDArray[np.uint8]:
    """Return the class map of a survey."""
    return load_class_map(archive.locate(published.receipt["products"]["class_map"])).classes


def raw(bucket: str) -> set[str]:
    """Return the names of the files in the stores of raw lines."""
    return {name.rpartition("/")[2] for name in open_archive(bucket).objects.listing("stages/capture")}


def test_a_rerun_finds_every_stage_in_the_bucket(
    bucket: str, survey_png: Survey, surveyed_png: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map equals that of a folder; a rerun here fetches nothing, and one on an empty machine computes nothing."""
    fetched: list[str] = []
    save = Objects.save
    monkeypatch.setattr(Objects, "save", lambda self, name, path: (fetched.append(name), save(self, name, path))[1])
    with with_effects():  # the survey for comparison has them
        first = survey_png(bucket)
    assert {row["name"] for row in first.receipt["stages"]} == OF_THIS
    beside = map_of(open_archive(tmp_path / "folder"), surveyed_png(tmp_path / "folder"))
    np.testing.assert_array_equal(map_of(open_archive(bucket), first), beside)
    again = survey_png(bucket)
    assert states(again.receipt) == CACHED
    assert fetched == []
    monkeypatch.setenv("SPECTRALZOOM_WORK", str(tmp_path / "elsewhere"))
    elsewhere = survey_png(bucket)
    assert states(elsewhere.receipt) == CACHED
    assert elsewhere.folder != again.folder
    assert raw(bucket) == {"manifest.json", "cleared"}  # neither machine captured or sent them again
    np.testing.assert_array_equal(map_of(open_archive(bucket), elsewhere), beside)
    monkeypatch.setenv("SPECTRALZOOM_WORK", str(tmp_path / "a desk"))
    run = spectralzoom.open(bucket).latest
    np.testing.assert_array_equal(run.class_map, beside)
    assert run.report.is_file()


@contextmanager
def worker(environment: dict[str, str]) -> Iterator[str]:
    """Start a scheduler and a worker with this environment; yield its address."""
    with LocalCluster(1, threads_per_worker=1, dashboard_address="127.0.0.1:0", env=environment) as cluster:
        yield cluster.scheduler_address


def test_a_worker_reads_the_bucket_itself(
    bucket: str, survey_png: Survey, surveyed_png: Survey, tmp_path: Path
) -> None:
    """A worker with a working copy of its own fetches its input, and the map equals that of a folder."""
    there = {"SPECTRALZOOM_WORK": str(tmp_path / "there"), THREADS_OF: "1"}
    with worker(there) as address, with_effects():
        published = survey_png(bucket, scheduler=address)
    beside = map_of(open_archive(tmp_path / "folder"), surveyed_png(tmp_path / "folder"))
    np.testing.assert_array_equal(map_of(open_archive(bucket), published), beside)
    fetched = {path.parent.parent.name for path in (tmp_path / "there").glob("*/*/stages/*/*/manifest.json")}
    assert fetched == {"condense", "locate", "rectify", "condense_fine", "rectify_fine", "score"}


def test_a_worker_without_access_to_the_bucket_is_reported(bucket: str, command_line: CommandLine) -> None:
    """One message names the worker and the cause."""
    with worker({"AWS_ENDPOINT_URL": "http://127.0.0.1:9", THREADS_OF: "1"}) as address:
        ended = command_line("survey", "--out", bucket, *SMALL, "--scheduler", address)
    assert ended.code == 2
    assert re.fullmatch(r".*--scheduler tcp:\S+: a worker cannot read the archive.* not answer: .*", ended.errors[-1])


def test_commands_read_an_archive_in_a_bucket(
    bucket: str, command_line: CommandLine, scene_files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every command on archives accepts s3://bucket/prefix as a folder."""
    monkeypatch.chdir(tmp_path)
    assert command_line("plan", "--out", bucket, *SMALL[:5]).code == 0
    ended = command_line("survey", "--out", bucket, *SMALL, "--json")
    assert (ended.code, ended.errors) == (0, [])
    receipt = json.loads(ended.out)
    monkeypatch.setenv("SPECTRALZOOM_WORK", str(tmp_path / "elsewhere"))
    plan = json.loads(command_line("plan", "--out", bucket, *SMALL[:5], "--json").out)
    assert plan["to_make"] == 0
    listed = json.loads(command_line("ls", bucket, "--json").out)
    assert listed["archive"] == bucket
    (run,) = listed["runs"]
    assert run["state"] == "there"
    tree = json.loads(command_line("explain", bucket, "class_map", "--json").out)
    assert tree["product"].startswith("stages/segment/")
    assert json.loads(command_line("verify", bucket, "--json").out)["problems"] == []
    assert command_line("survey", "--out", bucket, *SMALL).code == 0
    assert command_line("plan", "--sweeps", bucket, "--out", bucket).code == 0
    again = json.loads(command_line("reprocess", bucket, "--json").out)
    assert [row["state"] for row in again["fields"]] == ["skipped"]
    cleared = json.loads(command_line("gc", bucket, "--keep-days", "0", "--json").out)
    assert (cleared["removals"], cleared["obstacle"]) == ([], None)
    monkeypatch.setenv("SPECTRALZOOM_WORK", str(tmp_path / "a desk"))
    ended = command_line("export", bucket, "-o", tmp_path / "export", "--json")
    assert (ended.code, ended.errors) == (0, [])
    assert json.loads((tmp_path / "export" / "collection.json").read_text())["id"] == bucket.rpartition("/")[2]
    item = Path(json.loads(ended.out)["item"])
    archive = open_archive(bucket)
    assets = json.loads(item.read_text())["assets"]
    assert {"report", "quicklook", "receipt", "mosaic_zarr"} <= set(assets)
    assert isinstance(archive, ObjectArchive)
    there = " ".join(f"{bucket}/{name}" for name in archive.objects.listing())  # not the working copy: it is temporary
    assert all(one["href"] in there or (item.parent / one["href"]).is_file() for one in assets.values())
    assert receipt["settings"]["out"] == bucket


def rot_mosaic(address: str) -> None:
    """Flip a bit of the mosaic's values in the bucket."""
    archive = open_archive(address)
    assert isinstance(archive, ObjectArchive)
    name = next(name for name in archive.objects.listing("stages/rectify") if "/scores/c/" in name)
    rot(archive, name, 100)


def test_a_flipped_bit_is_reported_and_removed(bucket: str, survey_png: Survey, command_line: CommandLine) -> None:
    """verify names store and array; gc --damaged removes it with the map, and the next survey makes both again."""
    flags: dict[str, Any] = {"source": "raster", "budget": None, "accuracy": False}
    published = survey_png(bucket, **flags)
    before = map_of(open_archive(bucket), published)
    rot_mosaic(bucket)
    ended = command_line("verify", bucket, "--json")
    (problem,) = json.loads(ended.out)["problems"]
    assert ended.code == 1
    assert "mosaic.zarr/scores/c/0/0/0 has changed since it was published" in problem["problem"]
    gone = command_line("gc", bucket, "--damaged", "--raw-too", "--json")
    assert gone.code == 0
    assert [row["uri"].split("/")[1] for row in json.loads(gone.out)["removals"]] == ["segment", "score", "rectify"]
    again = survey_png(bucket, **flags)
    assert command_line("verify", bucket).code == 0
    np.testing.assert_array_equal(map_of(open_archive(bucket), again), before)


def test_missing_buckets_are_reported(bucket: str, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message has cause and remedy; the exit code is 1, and 2 for an invalid address."""
    missing = command_line("survey", "--out", "s3://no-such-bucket/x", *SMALL)
    missing.refused(1, "there is no such bucket: create it")
    monkeypatch.setattr("storage.remote.object_stores.RETRIES", 0)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    command_line("ls", bucket).refused(1, "it does not answer: check the network and AWS_ENDPOINT_URL")
    assert command_line("ls", "s3://").code == 2

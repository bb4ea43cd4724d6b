"""Raw lines that an earlier version packed with pcodec: read where it is installed, told of where it is not."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
import zarr
from rich.console import Console
from zarr.codecs import Crc32cCodec
from zarr.codecs.numcodecs import PCodec

from flows.archive.commands import run_verify
from pipeline.errors import IncompleteStoreError, SceneError
from pipeline.geometry.scan import Sweep
from pipeline.source import Line, References
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.manifests import listed_bytes, manifest_sha256, read_manifest, write_manifest
from storage.arrays.cubes import RawCubeWriter, SweepHeader, open_raw_cube
from storage.readers.open_cubes import open_cube
from storage.remote.opening import verify_archive
from tests.storage.small_archive import flip

LINES = np.random.default_rng(1).poisson(400, (37, 40, 6)).astype(np.uint16)
WORDS = (
    r"is packed with pcodec, as earlier versions of SpectralZoom packed raw lines, which is not installed; "
    r"pip install pcodec \(nothing is damaged\)"
)
pytestmark = pytest.mark.filterwarnings("ignore:Numcodecs codecs are not in the Zarr version 3 specification")


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """An archive with one capture and a run that knows it, packed since as `pack` did."""
    opened = Archive.open(tmp_path / "a")
    ref = opened.produce("capture", _capture, version=2, params={"source": "rig"}, work=37.0)[0]
    with opened.new_run("farm") as draft:
        draft.write_file("receipt.json", json.dumps({"settings": {"source": "rig"}, "products": {"raw": ref.uri}}))
        draft.publish(rests_on=opened.manifest_hashes([ref]))
    _pack(ref)
    return opened


def _capture(path: Path) -> None:
    frame = np.full(LINES.shape[1:], 64, np.float32)
    header = SweepHeader(
        Sweep("fine-0", "fine", "y", 0.0, 0.0, len(LINES)),
        References(frame, frame * 20, np.ones(LINES.shape[2], np.float32)),
        np.linspace(400, 900, LINES.shape[2]),
    )
    with RawCubeWriter(path / "fine-0.zarr", header) as cube:
        cube.write([Line(n, data, 0.0, 0.0, n / 9, 9.0) for n, data in enumerate(LINES)])


def _pack(ref: StageRef) -> None:
    """Give the raw numbers pcodec instead of blosc, and the store a manifest that knows the one before."""
    before, sha256 = read_manifest(ref.path), manifest_sha256(ref.path)
    group = zarr.open_group(ref.path / "fine-0.zarr", mode="r+", use_consolidated=False)
    old = group["dn"]
    assert isinstance(old, zarr.Array)
    dims, attributes, values = old.metadata.dimension_names, old.attrs.asdict(), old[...]  # type: ignore[union-attr]
    packed = group.create_array(
        "dn",
        shape=old.shape,
        dtype=old.dtype,
        chunks=old.chunks,
        shards=old.shards,
        dimension_names=dims,
        attributes=attributes,
        serializer=PCodec(level=8),
        compressors=(Crc32cCodec(),),
        overwrite=True,
    )
    packed[...] = values
    facts = {name: value for name, value in before.items() if name not in ("files", "format", "seal")}
    entry = {
        "manifests": [sha256],
        "values": {"fine-0.zarr": "not looked at"},
        "bytes_before": listed_bytes(before),
        "codec": "numcodecs.pcodec level 8",
        "at": "2026-11-20T00:00:00.000+00:00",
    }
    write_manifest(ref.path, facts | {"packed": entry})


@pytest.fixture
def without_pcodec(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where it was never installed."""
    monkeypatch.delitem(importlib.import_module("numcodecs.registry").codec_registry, "pcodec")


def _cube(archive: Archive) -> Path:
    (ref,) = archive.refs()
    return ref.path / "fine-0.zarr"


def test_packed_lines_are_read_where_pcodec_is_installed(archive: Archive) -> None:
    """The numbers are those of before; neither verify nor the run that knew the old manifest finds anything wrong."""
    np.testing.assert_array_equal(open_raw_cube(_cube(archive)).read(), LINES)
    np.testing.assert_array_equal(open_cube(str(_cube(archive))).read(0, 37), LINES)
    assert [one.problem for one in verify_archive(archive)] == [None, None]
    (ref,) = archive.refs()
    manifest = archive.manifest(ref)
    assert archive.stored_bytes(ref) == manifest["packed"]["bytes_before"] != listed_bytes(manifest)


@pytest.mark.usefixtures("without_pcodec")
def test_without_pcodec_reading_says_what_is_missing(archive: Archive) -> None:
    """Of an array in an archive and of a scene file alike."""
    with pytest.raises(IncompleteStoreError, match=f"dn {WORDS}"):
        open_raw_cube(_cube(archive)).read(0, 1)
    with pytest.raises(SceneError, match=f"fine-0.zarr {WORDS}"):
        open_cube(str(_cube(archive))).read(0, 1)


@pytest.mark.usefixtures("without_pcodec")
def test_verify_tells_of_what_cannot_be_read(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    """Such a store is whole, but named; the rest of the archive is read, and a repair leaves it as it is."""
    found = {one.uri.split("/")[0]: one for one in verify_archive(archive)}
    assert (found["runs"].kind, found["stages"].kind) == ("whole", "unreadable")
    before = read_manifest(_cube(archive).parent)
    assert run_verify(archive.root, Console(quiet=True)) == 1
    assert "pip install pcodec (nothing is damaged)" in capsys.readouterr().out
    assert run_verify(archive.root, Console(quiet=True), remake=True) == 1
    assert read_manifest(_cube(archive).parent) == before


def test_damage_is_named_with_and_without_pcodec(archive: Archive, request: pytest.FixtureRequest) -> None:
    """A flipped bit is found by the file's hash; where no codec is, nothing is said of the chunks."""
    flip(_cube(archive) / "dn/c/0/0/0", 500)
    (problem,) = [one.problem for one in verify_archive(archive) if one.problem is not None]
    assert "unreadable: lines 0 to 31, samples 0 to 31" in problem
    request.getfixturevalue("without_pcodec")
    (problem,) = [one.problem for one in verify_archive(archive) if one.problem is not None]
    assert problem.endswith("dn/c/0/0/0 has changed since it was published (its SHA-256 differs)")

"""Ingest: the content of a file becomes one immutable store, once; a refused ingest leaves nothing."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

import flows.archive.ingest_command
from flows.archive.ingest_command import run_ingest
from pipeline.errors import ArchiveError, SceneError
from storage.archive.archive import Archive
from storage.readers.scene_files import load_scene_file
from storage.remote.opening import verify_archive
from tests.conftest import QUIET
from tests.storage.readers.test_envi_cubes import write_envi

NM = {"wavelength_units": "um", "wavelength": "{0.45, 0.55, 0.65}", "fwhm": "{0.01, 0.01, 0.02}"}


def write_cube(path: Path, values: NDArray[Any], **fields: object) -> Path:
    """Write (line, sample, band) values as BIL with their header; return the header."""
    return write_envi(path, values, **NM, **fields).with_suffix(".hdr")


def ingest(source: Path | str, archive: Path, **flags: Any) -> dict[str, Any]:
    """Ingest without output and return the record."""
    return run_ingest(str(source), archive, QUIET, **flags)


def opened(record: dict[str, Any]) -> xr.Dataset:
    """Return the stored cube, read with plain xarray."""
    with xr.open_zarr(Path(record["path"]) / "cube.zarr", consolidated=False) as found:
        return found.load()


@pytest.fixture
def raw() -> NDArray[np.uint16]:
    """Return values of 150 lines, more than two blocks: (150, 40, 3) uint16."""
    return np.random.default_rng(0).integers(0, 4096, (150, 40, 3), dtype=np.uint16)


def test_ingest_stores_values_and_metadata(tmp_path: Path, raw: NDArray[np.uint16]) -> None:
    """Plain xarray reads values, wavelengths, times, references, files and headers."""
    folder = tmp_path / "flight 7"
    folder.mkdir()
    write_cube(folder / "raw_0", raw[:100])
    write_cube(folder / "raw_100", raw[100:])
    write_cube(folder / "darkReference", raw[:1] // 8)
    (folder / "frameIndex_0.txt").write_text("f\tt\n" + "".join(f"{i}\t{5000 + 40 * i}\n" for i in range(100)))
    record = ingest(folder, tmp_path / "archive", name="field-7")
    data = opened(record)
    assert data["values"].dims == ("line", "sample", "band")
    assert data["values"].dtype == np.uint16
    np.testing.assert_array_equal(data["values"], raw)
    np.testing.assert_allclose(data["wavelength"], [450, 550, 650])
    np.testing.assert_allclose(data["fwhm"], [10, 10, 20])
    np.testing.assert_allclose(data["time"][:100], np.arange(100) * 40e-6)
    assert np.isnan(data["time"][100:]).all()
    assert data["valid_line"].all()
    np.testing.assert_array_equal(data["dark"], raw[0] // 8)
    about = data.attrs
    assert about["name"] == "field-7"
    digest = hashlib.sha256((folder / "raw_0").read_bytes()).hexdigest()
    assert {"name": "raw_0", "size": raw[:100].nbytes, "sha256": digest} in about["files"]
    assert about["headers"]["raw_0.hdr"] == (folder / "raw_0.hdr").read_text()
    assert str(tmp_path) not in json.dumps(about)
    assert verify_archive(Archive.open(tmp_path / "archive"))[0].problem is None


@pytest.mark.parametrize(
    ("kind", "high", "stored"),
    [
        ("u1", 255, "u1"),
        ("u2", 65535, "u2"),
        ("i2", -1, "i2"),
        ("i4", 65536, "f4"),
        ("f4", 100, "f4"),
        ("f8", 100, "f4"),
    ],
)
def test_ingest_keeps_every_value(tmp_path: Path, kind: str, high: int, stored: str) -> None:
    """Integers of 8 and 16 bits keep their type; all other types become float32."""
    values = np.random.default_rng(1).integers(0, max(high, 0) + 1, (70, 5, 3)).astype(kind)
    values[69, 0, 0] = high
    data = opened(ingest(write_cube(tmp_path / "a.img", values), tmp_path / "archive"))
    assert data["values"].dtype == np.dtype(stored)
    np.testing.assert_array_equal(data["values"], values)


def test_the_same_content_is_stored_once(tmp_path: Path, raw: NDArray[np.uint16]) -> None:
    """Name and folder of the files do not count; a given name, other bytes, wavelengths or dark frames do."""
    archive = tmp_path / "archive"
    first = ingest(write_cube(tmp_path / "a.img", raw), archive)
    (tmp_path / "elsewhere").mkdir()
    again = ingest(write_cube(tmp_path / "elsewhere" / "b.raw", raw), archive)
    assert (first["cached"], again["cached"], again["key"]) == (False, True, first["key"])
    others = [
        ingest(tmp_path / "a.hdr", archive, name="n"),
        ingest(tmp_path / "a.hdr", archive, wavelengths=[400, 500, 600]),
        ingest(write_cube(tmp_path / "c.img", raw + 1), archive),
        ingest(tmp_path / "a.hdr", archive, dark=str(tmp_path / "c.hdr")),
    ]
    assert len({record["key"] for record in [first, *others]}) == 5


def test_an_ingested_store_is_a_scene(tmp_path: Path, raw: NDArray[np.uint16]) -> None:
    """Its folder is a scene, and can be ingested again with all metadata."""
    record = ingest(write_cube(tmp_path / "a.img", raw[:20], lines=22), tmp_path / "archive")
    scene = load_scene_file(record["path"])
    np.testing.assert_array_equal(scene.values[:20], raw[:20])
    assert np.isnan(scene.values[20:]).all()
    np.testing.assert_allclose(scene.wavelength_nm, [450, 550, 650])
    again = ingest(record["path"], tmp_path / "second")
    xr.testing.assert_equal(opened(again), opened(record))
    assert again["lost_lines"] == 2


def test_the_scale_of_scene_toml_is_stored(tmp_path: Path, raw: NDArray[np.uint16]) -> None:
    """The store reads as the file with its scene.toml does: scaled, and with nodata as NaN."""
    numbers = raw.astype(np.int16)
    numbers[3, 4] = -1
    numbers[5] = -9999
    path = write_cube(tmp_path / "a.img", numbers)
    (tmp_path / "scene.toml").write_text("nodata = -1\n")
    unscaled = ingest(path, tmp_path / "archive")
    assert opened(unscaled).attrs["nodata"] == -1
    (tmp_path / "scene.toml").write_text("scale = 0.0001\noffset = -0.1\n")
    record = ingest(path, tmp_path / "archive")
    assert record["key"] != unscaled["key"]
    stored, scene = load_scene_file(Path(record["path"]) / "cube.zarr"), load_scene_file(path)
    np.testing.assert_array_equal(stored.values, scene.values)
    assert np.isnan(stored.values[5]).all()
    np.testing.assert_allclose(stored.values[3, 4], -0.1001, rtol=1e-6)
    assert "values are the file's times 0.0001 plus -0.1, as scene.toml says" in record["notes"]


def test_a_scale_with_a_dark_frame_is_refused(tmp_path: Path, raw: NDArray[np.uint16]) -> None:
    """Dark and white frames need values as the camera gave them."""
    path, dark = write_cube(tmp_path / "a.img", raw), write_cube(tmp_path / "dark.img", raw[:1] // 8)
    (tmp_path / "scene.toml").write_text("scale = 0.0001\n")
    with pytest.raises(SceneError, match=r"scene.toml has a scale .*remove scale and offset"):
        ingest(path, tmp_path / "archive", dark=dark)


@pytest.mark.parametrize("name", ["../out", "/tmp/x", "", "a.part"])
def test_names_with_a_path_are_refused(tmp_path: Path, raw: NDArray[np.uint16], name: str) -> None:
    """The error comes before an archive is made."""
    header = write_cube(tmp_path / "a.img", raw)
    with pytest.raises(ArchiveError, match="cannot be a name in an archive"):
        ingest(header, tmp_path / "archive", name=name)
    assert not (tmp_path / "archive").exists()


def test_a_changing_source_is_refused(tmp_path: Path, raw: NDArray[np.uint16], monkeypatch: pytest.MonkeyPatch) -> None:
    """Files that change while they are read leave no store."""
    header = write_cube(tmp_path / "a.img", raw)
    real = flows.archive.ingest_command.write_ingested_cube

    def grows(*arguments: Any, **named: Any) -> None:
        real(*arguments, **named)
        with (tmp_path / "a.img").open("ab") as file:
            file.write(b"more")

    monkeypatch.setattr(flows.archive.ingest_command, "write_ingested_cube", grows)
    with pytest.raises(SceneError, match="changed while it was read; ingest it again once it is whole"):
        ingest(header, tmp_path / "archive")
    assert Archive.open(tmp_path / "archive").refs() == []

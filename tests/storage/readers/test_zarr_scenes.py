"""Zarr stores as scenes: known dims are read; raw cubes, pickles, and huge claims are refused."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.source import Line, References
from spectralzoom.storage.arrays.cubes import RawCubeWriter, SweepHeader
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.scene_files import load_scene_file
from tests.storage.readers.test_huge_claims import Trap

NM = np.array([450.0, 550.0, 650.0, 800.0, 900.0])


def _dataset(cube: NDArray[Any], dims: tuple[str, ...], **about: Any) -> xr.Dataset:
    array = xr.DataArray(cube.transpose([("y", "x", "band").index(dim) for dim in dims]), dims=dims, name="reflectance")
    return array.to_dataset().assign_coords(wavelength=("band", about.pop("nm", NM), about))


@pytest.mark.parametrize("dims", [("y", "x", "band"), ("band", "y", "x")])
@pytest.mark.parametrize("version", [2, 3])
def test_xarray_dataset_is_read(tmp_path: Path, cube: NDArray[np.uint16], dims: tuple[str, ...], version: int) -> None:
    """Either order of dims and either version of the format give the same scene, with the coordinate's wavelengths."""
    path = tmp_path / "a.zarr"
    _dataset(cube, dims, units="nm").to_zarr(path, zarr_format=version, consolidated=False)
    scene = load_scene_file(path)
    np.testing.assert_array_equal(scene.values, cube)
    np.testing.assert_array_equal(scene.wavelength_nm, NM)
    assert any("wavelengths from the list wavelength" in one for one in scene.provenance)


def test_zarr_arrays_without_dims_are_read(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """A single array is y, x, band in both format versions; two axes are one band. Missing chunks are noted."""
    for version in (2, 3):
        path = tmp_path / f"{version}.zarr"
        zarr.create_array(path, data=cube, zarr_format=version)
        scene = load_scene_file(path, wavelengths=NM.tolist())
        np.testing.assert_array_equal(scene.values, cube)
        assert "dims have no names, read as y, x, band" in scene.provenance
    zarr.create_array(tmp_path / "shards.zarr", data=cube, chunks=(2, 2, 5), shards=(4, 4, 5))  # 2 x 3 of 7 x 9 px
    assert load_scene_file(tmp_path / "shards.zarr", wavelengths=NM.tolist()).provenance == scene.provenance
    (tmp_path / "shards.zarr/c/1/2/0").unlink()
    torn = load_scene_file(tmp_path / "shards.zarr", wavelengths=NM.tolist())
    assert torn.provenance[0] == "shards.zarr: 1 of 6 chunks have no file, and are read as 0"
    zarr.create_array(tmp_path / "flat.zarr", data=cube[..., 0])
    assert load_scene_file(tmp_path / "flat.zarr", wavelengths=[550]).values.shape == (7, 9, 1)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("packing", [{"dtype": "f4"}, {"dtype": "i2", "scale_factor": 0.5, "add_offset": 1.0}])
def test_packing_is_decoded(tmp_path: Path, cube: NDArray[np.uint16], version: int, packing: dict[str, Any]) -> None:
    """Scale, offset and fill value are applied in both format versions."""
    data = _dataset(np.where(cube > 4000, np.nan, cube * 0.5 + 1), ("y", "x", "band"), units="nm")
    encoding: Any = {"reflectance": {**packing, "_FillValue": -9999}}
    data.to_zarr(tmp_path / "a.zarr", encoding=encoding, zarr_format=version, consolidated=False)
    scene = load_scene_file(tmp_path / "a.zarr")
    np.testing.assert_allclose(scene.values, np.where(cube > 4000, np.nan, cube * 0.5 + 1), rtol=1e-6)


def test_a_raw_cube_is_refused_as_a_scene(tmp_path: Path) -> None:
    """A raw cube of this project is a recording; the error says to survey it with `--sweeps`."""
    sweep = Sweep("fine-0", "fine", "y", 0.0, 0.0, 6)
    frame = np.ones((40, 5), np.float32)
    with RawCubeWriter(tmp_path / "s0.zarr", SweepHeader(sweep, References(frame, frame, frame[0]), NM)) as cube:
        cube.write([Line(i, np.ones((40, 5), np.uint16), 0.0, 0.0, 0.1 * i, 10.0, True) for i in range(6)])
    with pytest.raises(SceneError, match=r"holds raw lines of a survey.*; survey them as --sweeps .*s0\.zarr"):
        load_scene_file(tmp_path / "s0.zarr")


def _edit(path: Path, change: Any) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("filters", [True, False])
def test_pickle_is_never_loaded(tmp_path: Path, cube: NDArray[np.uint16], filters: bool) -> None:
    """A store that asks for pickle, as filter or compressor, is refused before a chunk is read."""
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=cube, zarr_format=2, chunks=cube.shape, compressors=None)
    (path / "0.0.0").write_bytes(pickle.dumps(Trap(tmp_path / "trapped")))
    key, value = ("filters", [{"id": "pickle"}]) if filters else ("compressor", {"id": "pickle"})
    _edit(path / ".zarray", lambda content: content.update({key: value}))
    with pytest.raises(SceneError, match="asks for the codec 'pickle', which is not read"):
        load_scene_file(path, wavelengths=NM.tolist())
    assert not (tmp_path / "trapped").exists()


def test_codecs_within_shards_are_checked(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """A codec in a shard's own list is refused like any other."""
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=cube, chunks=(7, 9, 5), shards=(7, 9, 5))

    def change(content: dict[str, Any]) -> None:
        content["codecs"][0]["configuration"]["codecs"].append({"name": "numcodecs.pickle", "configuration": {}})

    _edit(path / "zarr.json", change)
    with pytest.raises(SceneError, match=r"codec 'numcodecs\.pickle'"):
        load_scene_file(path, wavelengths=NM.tolist())


def test_damaged_zarr_stores_are_refused(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """A truncated chunk and broken metadata raise the same error."""
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=cube)
    chunk = next(file for file in path.rglob("*") if file.is_file() and file.name != "zarr.json")
    chunk.write_bytes(chunk.read_bytes()[:5])
    with pytest.raises(SceneError, match="cannot be read as Zarr"):
        load_scene_file(path, wavelengths=NM.tolist())
    (path / "zarr.json").write_text("{")
    with pytest.raises(SceneError, match="cannot be read as Zarr"):
        load_scene_file(path, wavelengths=NM.tolist())


def test_names_in_consolidated_metadata_are_not_followed(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """Only arrays inside of the store are read, whatever its consolidated metadata list; names are no paths."""
    path, other = tmp_path / "a.zarr", tmp_path / "other.zarr"
    for version in (2, 3):
        zarr.open_group(other, mode="w", zarr_format=version).create_array("cube", data=cube + 1)
        zarr.open_group(path, mode="w", zarr_format=version).create_array("cube", data=cube)
        about = json.loads((other / "cube" / {2: ".zarray", 3: "zarr.json"}[version]).read_text())
        if version == 2:
            listed = {".zgroup": {"zarr_format": 2}, "../other.zarr/cube/.zarray": about}
            (path / ".zmetadata").write_text(json.dumps({"zarr_consolidated_format": 1, "metadata": listed}))
        else:
            said = {"kind": "inline", "must_understand": False, "metadata": {"../other.zarr/cube": about}}
            _edit(path / "zarr.json", lambda content, said=said: content.update(consolidated_metadata=said))
        np.testing.assert_array_equal(open_cube_source(path).read(0, 7), cube)
    for name in ("../other.zarr/cube", "..", "/etc"):
        with pytest.raises(SceneError, match=r"there is no file|has no array"):
            open_cube_source(f"{path}:{name}")


def test_coordinates_with_huge_claims_are_refused(tmp_path: Path, cube: NDArray[np.uint16]) -> None:
    """Small arrays beside the cube are checked like the cube."""
    _dataset(cube, ("y", "x", "band"), units="nm").to_zarr(tmp_path / "a.zarr", consolidated=False)

    def change(content: dict[str, Any]) -> None:
        content["chunk_grid"]["configuration"]["chunk_shape"] = [10**12]

    _edit(tmp_path / "a.zarr" / "wavelength" / "zarr.json", change)
    with pytest.raises(SceneError, match="wavelength claims"):
        open_cube_source(tmp_path / "a.zarr")


def test_chunks_must_fit_into_memory(tmp_path: Path, cube: NDArray[np.uint16], monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks are read whole, so the memory for a few lines is compared with the machine's."""
    zarr.create_array(tmp_path / "a.zarr", data=cube, chunks=cube.shape)
    monkeypatch.setattr("spectralzoom.storage.readers.cube_sources.machine_bytes", lambda: cube.nbytes - 1)
    with pytest.raises(SceneError, match="reading it takes about"):
        open_cube_source(tmp_path / "a.zarr")


def _with_fill(path: Path, version: int, kind: str, key: str, fill: Any) -> Path:
    """Write a store whose no-data value ``fill`` stands as ``key`` in the metadata or the attributes."""
    group = zarr.open_group(path, mode="w", zarr_format=version)  # type: ignore[arg-type]
    about = {} if key == "fill_value" else {key: fill}
    group.create_array("cube", data=np.arange(60).reshape(4, 5, 3).astype(kind), attributes=about)
    if key == "fill_value":
        metadata = path / "cube" / ("zarr.json" if version == 3 else ".zarray")
        metadata.write_text(json.dumps(json.loads(metadata.read_text()) | {key: fill}))
    return path


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("kind", ["f4", "f8", "i2"])
@pytest.mark.parametrize("key", ["_FillValue", "missing_value", "fill_value"])
def test_a_fill_value_that_is_no_number_is_named(tmp_path: Path, version: int, kind: str, key: str) -> None:
    """The message has its key and value."""
    path = _with_fill(tmp_path / "a.zarr", version, kind, key, "minus one")
    with pytest.raises(SceneError, match=rf"cube.* has {key} = 'minus one', expected a number; correct it"):
        open_cube_source(path)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(("kind", "fill"), [("f4", "7"), ("f8", "7.0"), ("i2", "7"), ("f8", "AAAAAAAAHEA=")])
def test_a_fill_value_may_be_the_text_of_a_number(tmp_path: Path, version: int, kind: str, fill: str) -> None:
    """In decimals, or as xarray encodes a double."""
    path = _with_fill(tmp_path / "a.zarr", version, kind, "_FillValue", fill)
    scene = load_scene_file(path, wavelengths=[450, 550, 650])
    assert np.flatnonzero(np.isnan(scene.values)).tolist() == [7]


@pytest.mark.parametrize("fill", ["", "none", "NaN"])
def test_a_fill_value_of_none_is_none(tmp_path: Path, fill: str) -> None:
    """Such a text states no number, so that every value counts."""
    path = _with_fill(tmp_path / "a.zarr", 3, "f4", "_FillValue", fill)
    assert np.isfinite(load_scene_file(path, wavelengths=[450, 550, 650]).values).all()


def test_fill_values_by_other_names_are_noted(tmp_path: Path) -> None:
    """They are not applied, and neither is a range in words."""
    path = _with_fill(tmp_path / "a.zarr", 3, "f4", "Data_Ignore_Value", -1)
    zarr.open_group(path, mode="r+")["cube"].attrs["valid_range"] = "0 to 9"
    notes = open_cube_source(path).notes
    assert "its Data_Ignore_Value = -1 is not applied: only numbers in _FillValue are" in notes
    assert "its valid_range = 0 to 9 is not applied: only numbers are" in notes

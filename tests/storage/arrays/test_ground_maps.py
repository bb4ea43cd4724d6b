"""The stored map: what was written comes back, areas in hectares too, and wrong blocks are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from odc.geo.geobox import GeoBox

from pipeline.errors import ChunkError, IncompleteStoreError, ShapeError
from pipeline.geometry.grid import UNLABELLED
from storage.arrays.ground_maps import BLOCK, ClassNames, GroundMapWriter, load_ground_map
from storage.arrays.layout import SHARD_COLUMNS, SHARD_ROWS, create_group

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # odc-geo on affine 3
LEGEND = ClassNames(("sugar beet", "bare soil"), np.array([[10, 200, 30], [120, 90, 60]], np.uint8))


def begin(path: Path, shape: tuple[int, int] = (100, 90)) -> GroundMapWriter:
    """A writer of a map of the shape."""
    geobox = GeoBox.from_bbox((0, 0, shape[1] * 0.5, shape[0] * 0.5), crs="EPSG:32632", shape=shape, tight=True)
    return GroundMapWriter(path, geobox, LEGEND, about={"rig_pose": {"tilt_deg": 40}})


def block(shape: tuple[int, int], seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Classes with unseen pixels, confidence and picture."""
    rng = np.random.default_rng(seed)
    classes = rng.choice(np.array([0, 1, UNLABELLED], np.uint8), shape)
    confidence = np.where(classes == UNLABELLED, np.nan, rng.random(shape)).astype(np.float32)
    return classes, confidence, rng.integers(0, 256, (*shape, 3), dtype=np.uint8)


def test_a_map_written_in_blocks_comes_back(tmp_path: Path) -> None:
    """All arrays, the legend and the grid are as written, through this project's reader."""
    writer = begin(tmp_path / "a.zarr", (150, 700))
    whole = block((150, 700))
    for rows in (slice(0, 64), slice(64, 150)):
        for columns in (slice(0, SHARD_COLUMNS), slice(SHARD_COLUMNS, 700)):
            writer.write_block(rows, columns, *(part[rows, columns] for part in whole))
    writer.finish(np.zeros(2))
    found = load_ground_map(tmp_path / "a.zarr")
    for stored, written in zip((found.classes, found.confidence, found.picture), whole, strict=True):
        np.testing.assert_array_equal(stored, written)
    assert found.legend.names == LEGEND.names
    np.testing.assert_array_equal(found.legend.colours, LEGEND.colours)
    assert tuple(found.geobox.shape) == (150, 700)


@pytest.mark.parametrize(("areas_m2", "shares"), [((7500.0, 2500.0), (0.75, 0.25)), ((0.0, 0.0), (0.0, 0.0))])
def test_areas_are_kept_in_hectares(tmp_path: Path, areas_m2: tuple[float, ...], shares: tuple[float, ...]) -> None:
    """Each class has its square metres, hectares and share; a map of no class has shares of nothing."""
    begin(tmp_path / "a.zarr").finish(np.array(areas_m2))
    found = load_ground_map(tmp_path / "a.zarr").areas
    for name, m2, share in zip(LEGEND.names, areas_m2, shares, strict=True):
        assert found[name] == {"m2": m2, "ha": m2 / 10_000, "share": share}


def test_plain_xarray_opens_it_with_flags_and_areas(tmp_path: Path) -> None:
    """Class flags, hectares, pose and grid mapping are there without this project's code; unseen pixels are NaN."""
    writer = begin(tmp_path / "a.zarr")
    writer.write_block(slice(0, 64), slice(0, 90), *block((64, 90)))
    writer.finish(np.ones(2))
    with xr.open_zarr(tmp_path / "a.zarr", consolidated=False) as content:
        assert content.classes.dims == ("y", "x")
        assert content.classes.attrs["flag_meanings"] == "sugar_beet bare_soil"
        assert content.classes.odc.crs.epsg in (None, 32632)
        assert content.attrs["rig_pose"] == {"tilt_deg": 40}
        assert set(content.attrs["areas"]) == set(LEGEND.names)
        assert np.isnan(content.classes[64:].values).all()
        assert np.isnan(content.confidence[64:].values).all()


def test_a_class_without_a_name_and_a_block_that_does_not_fit_are_refused(tmp_path: Path) -> None:
    """The first wrong class is named; so are shapes that differ."""
    writer = begin(tmp_path / "a.zarr")
    classes, confidence, picture = block((64, 90))
    with pytest.raises(ShapeError, match=r"block \(64, 90\).* confidence \(63, 90\)"):
        writer.write_block(slice(0, 64), slice(0, 90), classes, confidence[1:], picture)
    with pytest.raises(ShapeError, match="class 2 is in the map, but only 2 classes have names"):
        writer.write_block(slice(0, 64), slice(0, 90), np.full_like(classes, 2), confidence, picture)


@pytest.mark.parametrize(
    ("rows", "words"), [((10, 74), "rows 10:74"), ((0, 40), "rows 0:40"), ((64, 128), "64:128"), ((32, 64), "32:64")]
)
def test_blocks_that_split_shards_are_refused(tmp_path: Path, rows: tuple[int, int], words: str) -> None:
    """A shard written twice by halves would lose one; the message says where to start and end."""
    writer = begin(tmp_path / "a.zarr")
    size = (rows[1] - rows[0], 90)
    with pytest.raises(ChunkError, match=f"{words}.* multiples of {SHARD_ROWS}"):
        writer.write_block(slice(*rows), slice(0, 90), *block(size))


def test_the_usual_block_is_whole_shards() -> None:
    """The size in which the stage writes splits none."""
    assert BLOCK[0] % SHARD_ROWS == BLOCK[1] % SHARD_COLUMNS == 0


def test_an_angular_map_is_no_ground_map(tmp_path: Path) -> None:
    """A store without a grid mapping is refused by name."""
    create_group(tmp_path / "a.zarr", "class map", {})
    with pytest.raises(IncompleteStoreError, match="no grid mapping; it is no map of the ground"):
        load_ground_map(tmp_path / "a.zarr")

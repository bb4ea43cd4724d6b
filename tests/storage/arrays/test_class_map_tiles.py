"""A class map written tile by tile: the same bytes, and nothing that splits what others write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import ChunkError, IncompleteStoreError, ShapeError
from storage.arrays.class_maps import (
    ClassMap,
    ClassNames,
    clear_classes,
    create_class_map,
    load_class_map,
    write_class_map,
    write_class_tile,
)
from storage.arrays.layout import AngularGrid

LEGEND = ClassNames(("crop", "weed"), np.array([[0, 255, 0], [255, 0, 0]], np.uint8))
SHAPE = (150, 700)


def _contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _drawn() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    classes = rng.integers(0, 2, SHAPE).astype(np.uint8)
    classes[:70, :40] = 255
    return classes, np.where(classes == 255, np.nan, rng.random(SHAPE)).astype(np.float32)


def test_tiles_in_any_order_are_the_map_at_once(tmp_path: Path) -> None:
    """Not a byte tells whether a map was written at once or in whole shards."""
    (classes, confidence), grid = _drawn(), AngularGrid(1e-4, SHAPE)
    write_class_map(tmp_path / "one.zarr", ClassMap(classes, confidence, LEGEND.names, LEGEND.colours, grid))
    create_class_map(tmp_path / "tiles.zarr", SHAPE, LEGEND, grid=grid)
    for rows, columns in [((64, 150), (640, 700)), ((0, 64), (0, 700)), ((64, 150), (0, 640))]:
        part = np.s_[slice(*rows), slice(*columns)]
        write_class_tile(tmp_path / "tiles.zarr", (rows[0], columns[0]), classes[part], confidence[part])
    assert _contents(tmp_path / "one.zarr") == _contents(tmp_path / "tiles.zarr")


def test_what_is_not_written_yet_has_no_class(tmp_path: Path) -> None:
    """A map that was only begun holds 255 and NaN."""
    create_class_map(tmp_path / "c.zarr", SHAPE, LEGEND)
    found = load_class_map(tmp_path / "c.zarr")
    assert (found.classes == 255).all()
    assert np.isnan(found.confidence).all()


@pytest.mark.parametrize(
    ("origin", "shape", "error", "words"),
    [
        ((32, 0), (64, 700), ChunkError, "rows 32:96 split the class map's shards of 64 rows"),
        ((0, 0), (64, 320), ChunkError, "columns 0:320 split the class map's shards of 640 columns"),
        ((128, 0), (64, 640), ShapeError, r"rows 128:192 are not all in the class map of \(150, 700\)"),
    ],
)
def test_tiles_that_do_not_fit_are_refused(
    tmp_path: Path, origin: tuple[int, int], shape: tuple[int, int], error: type[Exception], words: str
) -> None:
    """The message names the rows or columns."""
    create_class_map(tmp_path / "c.zarr", SHAPE, LEGEND)
    with pytest.raises(error, match=words):
        write_class_tile(tmp_path / "c.zarr", origin, np.zeros(shape, np.uint8), np.zeros(shape, np.float32))


def test_what_a_tile_lacks_is_told(tmp_path: Path) -> None:
    """A class without a name, a confidence of another size, colours that are missing, and a map that is not there."""
    create_class_map(tmp_path / "c.zarr", (20, 30), LEGEND)
    ones = np.ones((20, 30), np.uint8)
    with pytest.raises(ShapeError, match="class 2 is in the map, but only 2 classes have names"):
        write_class_tile(tmp_path / "c.zarr", (0, 0), 2 * ones, ones.astype(np.float32))
    with pytest.raises(ShapeError, match=r"confidence \(19, 30\) do not fit"):
        write_class_tile(tmp_path / "c.zarr", (0, 0), ones, ones[1:].astype(np.float32))
    with pytest.raises(ShapeError, match="2 names and 1 colours do not fit"):
        create_class_map(tmp_path / "d.zarr", (20, 30), ClassNames(LEGEND.names, LEGEND.colours[:1]))
    with pytest.raises(IncompleteStoreError, match=r"none\.zarr cannot be read"):
        write_class_tile(tmp_path / "none.zarr", (0, 0), ones, ones.astype(np.float32))


def test_classes_are_taken_from_pixels_and_from_no_other(tmp_path: Path) -> None:
    """In whichever shards they lie; a map of which none is taken keeps its bytes."""
    classes, confidence = _drawn()
    write_class_map(tmp_path / "m.zarr", ClassMap(classes, confidence, LEGEND.names, LEGEND.colours))
    before, where = _contents(tmp_path / "m.zarr"), np.zeros(SHAPE, np.bool_)
    clear_classes(tmp_path / "m.zarr", where)
    assert _contents(tmp_path / "m.zarr") == before
    where[60:70, 630:650], where[149, 699] = True, True
    clear_classes(tmp_path / "m.zarr", where)
    found = load_class_map(tmp_path / "m.zarr")
    np.testing.assert_array_equal(found.classes, np.where(where, 255, classes))
    np.testing.assert_array_equal(found.confidence, np.where(where, np.nan, confidence))

"""Quicklooks: gathered while lines pass, the same however they come, and read without the cube."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import IncompleteStoreError
from pipeline.geometry.scan import Sweep
from pipeline.source import Line, References
from storage.arrays.cubes import RawCubeWriter, SweepHeader, open_raw_cube
from storage.arrays.layout import open_group
from storage.arrays.quicklooks import (
    LineThumbnail,
    Quicklook,
    picture_bands,
    picture_step,
    quicklook_of,
    stretched,
    write_quicklook,
)
from tests.storage.plain_mosaic import plain_writer

WAVES = np.linspace(400, 900, 12)
LINES = np.random.default_rng(5).integers(100, 4000, (150, 600, 12), dtype=np.uint16)


def _header(lines: int = 150) -> SweepHeader:
    dark, white = np.full((600, 12), 90, np.float32), np.full((600, 12), 4090, np.float32)
    white[:, 3] = 2090
    references = References(dark, white, np.linspace(0.8, 0.95, 12).astype(np.float32))
    return SweepHeader(Sweep("fine-0", "fine", "y", 0.0, 0.0, lines), references, WAVES)


def _stored(path: Path, lost: tuple[int, ...] = (), step: int = 33) -> Path:
    lines = [Line(n, data, 0.0, 0.0, 0.1 * n, 100.0, n not in lost) for n, data in enumerate(LINES)]
    with RawCubeWriter(path, _header()) as cube:
        for first in range(0, len(lines), step):
            cube.write(lines[first : first + step])
    return path


@pytest.mark.parametrize(
    ("waves", "bands", "kind"),
    [
        (np.arange(400.0, 1000.0, 10), (24, 15, 6), "true colour"),
        (np.arange(1000.0, 2000.0, 100), (9, 4, 0), "false colour"),
        (np.array([660.0, 800.0]), (1, 0, 0), "false colour"),
        (np.array([800.0]), (0, 0, 0), "grey"),
        (None, (6, 4, 2), "by number"),
        (np.array([400, np.nan, 600]), (1, 1, 0), "by number"),
    ],
)
def test_bands_are_the_nearest_where_they_are_near(waves: NDArray[np.float64] | None, bands: object, kind: str) -> None:
    """640, 550 and 460 nm where there is such light, else the ends and the middle of what there is, or by number."""
    assert picture_bands(waves, 9 if waves is None else len(waves)) == (bands, kind)


@pytest.mark.parametrize(
    ("size", "step"), [(1, 1), (145, 1), (255, 1), (256, 2), (640, 4), (4096, 4), (4097, 5), (10240, 10)]
)
def test_pictures_are_every_fourth_line_and_never_large(size: int, step: int) -> None:
    """Small cubes are thinned less, long ones more, so that the longer side stays below 1024 px."""
    assert picture_step((size, 3, 270)) == step
    assert -(-size // step) <= 1024


def test_a_raw_cube_has_the_picture_of_its_lines(tmp_path: Path) -> None:
    """Every 4th line and sample of three bands over the white reference, stretched; the raw numbers stay."""
    cube = open_raw_cube(_stored(tmp_path / "a.zarr"))
    seen = cube.quicklook()
    assert seen is not None
    thin = LINES[::4, ::4][..., list(seen.bands)]
    white_reference, white = (
        values[..., list(seen.bands)] for values in (cube.references.white_reference, cube.references.white[0])
    )
    truth = (thin - np.float32(90)) / (white - 90) * white_reference
    np.testing.assert_array_equal(seen.image, stretched(truth, together=True).image)
    np.testing.assert_array_equal(cube.read(), LINES)
    low, high = (np.array(ends) for ends in (seen.low, seen.high))
    assert np.abs(seen.values() - np.clip(truth, low, high)).max() <= (high - low).max() / 255 * 1.001


def test_lines_make_one_picture_however_they_come(tmp_path: Path) -> None:
    """One by one, or by blocks that do not fit its step."""
    pictures = [open_raw_cube(_stored(tmp_path / f"{step}.zarr", step=step)).quicklook() for step in (1, 7, 150)]
    for other in pictures[1:]:
        assert pictures[0] is not None
        assert other is not None
        np.testing.assert_array_equal(other.image, pictures[0].image)


def test_a_long_cube_is_thinned_evenly_across_blocks() -> None:
    """Every fifth line of all lines, not of each block of 64 anew."""
    lines = np.arange(4200, dtype=np.uint16)[:, None, None] * np.ones((1, 2, 3), np.uint16)
    seen = LineThumbnail(lines.shape, None)
    for start in range(0, len(lines), 64):
        block = lines[start : start + 64]
        seen.add(start, block, np.ones(len(block), np.bool_))
    found = seen.finish()
    assert found.step == 5
    np.testing.assert_array_equal(found.image, stretched(lines[::5, ::5].astype(np.float32)).image)


def test_one_scale_keeps_colours_true() -> None:
    """Grey stays grey, whatever the bands hold elsewhere; a scale for each band colours it."""
    image = np.random.default_rng(2).uniform(0, 1, (40, 40, 3)) * (0.2, 0.5, 0.1)
    image[0] = 0.08
    image[1, :9] = 0.9
    together, apart = stretched(image, together=True), stretched(image)
    assert np.ptp(together.image[0], axis=-1).max() == np.ptp(together.image[1, :9], axis=-1).max() == 0
    assert np.ptp(apart.image[0], axis=-1).min() > 50
    assert len(set(together.low)) == len(set(together.high)) == 1


def test_lines_that_are_not_valid_are_black(tmp_path: Path) -> None:
    """And have no say in the stretch."""
    seen, whole = (open_raw_cube(_stored(tmp_path / f"{lost}.zarr", lost)).quicklook() for lost in ((4, 5), ()))
    assert seen is not None
    assert whole is not None
    assert not seen.image[1].any()
    assert seen.image[2:].any()
    assert np.abs(seen.image[2:].astype(int) - whole.image[2:]).max() <= 5


def test_a_flat_or_missing_band_is_black() -> None:
    """What has no range is drawn as zero, what is not finite too."""
    image = np.random.default_rng(0).normal(size=(9, 9, 3)).astype(np.float32)
    image[..., 0], image[..., 1], image[3, 3, 2] = 7, np.nan, np.inf
    seen = stretched(image)
    assert (seen.image[..., :2].max(), seen.image[3, 3, 2]) == (0, 0)
    assert (seen.low[0], seen.high[0], seen.low[1], seen.high[1]) == (7, 7, 0, 0)
    assert set(np.unique(seen.image[..., 2])) >= {0, 255}


def test_pictures_are_read_without_the_cube(tmp_path: Path) -> None:
    """The cube's chunks may be gone: what shows a picture does not ask for them."""
    path = _stored(tmp_path / "store" / "fine-0.zarr")
    before = quicklook_of(open_group(path))
    for shard in (path / "dn" / "c").rglob("*"):
        if shard.is_file():
            shard.write_bytes(b"not read")
    seen = quicklook_of(open_group(path))
    assert before is not None
    assert seen is not None
    np.testing.assert_array_equal(seen.image, before.image)
    with pytest.raises(IncompleteStoreError):
        open_raw_cube(path).read(0, 1)


def test_a_mosaic_has_its_picture_as_it_was_given(tmp_path: Path) -> None:
    """Of a picture that was made elsewhere nothing but its colours is known."""
    image = np.random.default_rng(1).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    write_quicklook(plain_writer(tmp_path / "m.zarr", (80, 120), WAVES).group, Quicklook(image))
    seen = quicklook_of(open_group(tmp_path / "m.zarr"))
    assert seen is not None
    np.testing.assert_array_equal(seen.image, image)
    assert (seen.low, seen.bands) == ((), ())


def test_white_as_dark_as_dark_is_missing(tmp_path: Path) -> None:
    """An element without light between its references shows nothing, and no warning is given."""
    header = _header(64)
    white = header.references.white.copy()
    white[8] = header.references.dark[8]
    header = replace(header, references=replace(header.references, white=white))
    with RawCubeWriter(tmp_path / "a.zarr", header) as cube:
        cube.write([Line(n, LINES[n], 0.0, 0.0, 0.1 * n, 100.0) for n in range(64)])
    seen = quicklook_of(open_group(tmp_path / "a.zarr"))
    assert seen is not None
    assert not seen.image[:, 2].any()

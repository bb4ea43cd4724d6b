"""The RGB and near infrared picture of the data folder: parts of it put together, and its two given neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from measure import data_folder
from numpy.typing import NDArray
from scipy.ndimage import shift as spline_shift

from pipeline.rectify.kernels import Kernel
from pipeline.rectify.mosaic import MosaicPart, edge_distance, mosaic
from pipeline.rectify.registration.shifts import pair_shift
from pipeline.rectify.resample import resample

Floats = NDArray[np.float64]

RGBN = data_folder("rgbn")
NEIGHBOURS = ("rgbn_suba.tif", "rgbn_subb.tif")
CUT_LEFT, CUT_RIGHT = 220, 320  # columns that both parts have
WRONG_BY = np.array([3.0, -4.0])
BETWEEN = np.array([0.37, 0.61])  # of a pixel, where the second cut's pixels lie
PRIOR_PX = 8.0  # by which a place may be wrong
BLOCK_ROWS = 64
BORDER = 12  # pixels whose spline saw the picture's edge


@dataclass(frozen=True)
class Picture:
    """An image and where its first pixel's centre lies on the grid. Its lookup is a shift and nothing else."""

    values: NDArray[np.float32]  # (row, column, band)
    origin_px: Floats  # (2,) row and column of the grid, whole or not
    valid: NDArray[np.bool_] | None = None  # (row, column); None where every pixel counts

    def on_grid(self, rows: range, columns: range, kernel: Kernel) -> MosaicPart:
        """Resample the picture at a part of the grid's pixels."""
        row, column = np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop)
        at = np.stack(np.meshgrid(row - self.origin_px[0], column - self.origin_px[1], indexing="ij"), axis=-1)
        height, width = self.values.shape[:2]
        edge = edge_distance(at, height, width)
        at[~(edge >= 0)] = np.nan
        mask = np.ones((height, width), bool) if self.valid is None else self.valid
        values, weight = resample(self.values, mask, at.reshape(-1, 2), kernel)
        return MosaicPart(values, weight, edge.ravel())


@dataclass(frozen=True)
class Joined:
    """Two parts put together, and what differs from the whole."""

    values: NDArray[np.float32]
    error: NDArray[np.float32]  # (row, column, band) [DN]
    differing: int
    relative: float  # rms error over the picture's deviation, inside the border
    bilinear: float = np.nan


def read_picture(name: str) -> tuple[Picture, Floats]:
    """Read one picture with its mask and the map coordinates (y, x) of its first corner."""
    import rasterio

    with rasterio.open(RGBN / name) as file:
        values = file.read().transpose(1, 2, 0).astype(np.float32)
        corner, pixel = np.array([file.transform.f, file.transform.c]), np.array([file.transform.e, file.transform.a])
        void = None if file.nodata is None else (values == file.nodata).all(axis=2)
    return Picture(values, np.zeros(2), None if void is None else ~void), corner / pixel


def join_pictures(
    pictures: Sequence[Picture], shape: tuple[int, int], kernel: Kernel = "catmull-rom"
) -> NDArray[np.float32]:
    """Resample and blend pictures on a grid of ``shape`` pixels, (row, column, band); NaN where no picture reached."""
    blocks = (range(first, min(first + BLOCK_ROWS, shape[0])) for first in range(0, shape[0], BLOCK_ROWS))
    values = [mosaic([picture.on_grid(rows, range(shape[1]), kernel) for picture in pictures])[0] for rows in blocks]
    return np.concatenate(values).reshape(*shape, -1)


def picture_shift(reference: Picture, moving: Picture) -> Floats:
    """Register two pictures where they overlap, by the mean of their bands: the shift to add to the second's place."""
    pictures = (reference, moving)
    first = np.ceil(np.max([picture.origin_px for picture in pictures], axis=0)).astype(int)
    last = np.floor(np.min([picture.origin_px + picture.values.shape[:2] for picture in pictures], axis=0)).astype(int)
    rows, columns = (range(int(low), int(high)) for low, high in zip(first, last, strict=True))
    parts = [picture.on_grid(rows, columns, "catmull-rom") for picture in pictures]
    views = (part.values.mean(axis=1).reshape(len(rows), len(columns)) for part in parts)
    return pair_shift(*views, prior_px=PRIOR_PX).shift


def cut_and_join() -> tuple[Joined, Joined]:
    """Cut two overlapping parts, say a wrong place for one, register, and put them together: whole pixels, between."""
    whole = read_picture("rgbn.tif")[0].values
    left = Picture(whole[:, :CUT_RIGHT], np.zeros(2))
    right = Picture(whole[:, CUT_LEFT:], np.array([0.0, CUT_LEFT]))
    bands = [spline_shift(band, -BETWEEN, order=5, mode="mirror") for band in np.moveaxis(right.values, 2, 0)]
    between = Picture(np.stack(bands, axis=2), right.origin_px + BETWEEN)
    exact = _joined(left, _registered(left, right, whole=True), whole, "nearest")
    placed = _registered(left, between, whole=False)
    smooth = _joined(left, placed, whole, "catmull-rom")
    return exact, replace(smooth, bilinear=_joined(left, placed, whole, "bilinear").relative)


def given_neighbours() -> list[tuple[str, Floats, float]]:
    """The two pictures that come with it: shift found beside the georeference, and what then differs [DN rms]."""
    whole, corner = read_picture("rgbn.tif")
    rows = []
    for name in NEIGHBOURS:
        picture, own = read_picture(name)
        picture = replace(picture, origin_px=own - corner)
        shift = picture_shift(whole, picture)
        moved = replace(picture, origin_px=picture.origin_px + shift)
        error = join_pictures([moved], whole.values.shape[:2]) - whole.values
        rows.append((name, shift, float(np.sqrt(np.nanmean(error**2)))))
    return rows


@dataclass(frozen=True)
class Neighbours:
    """The two given neighbours put together, without the picture that they were cut from."""

    values: NDArray[np.float32]
    shift: Floats  # (2,) of the second beside its georeference, rows and columns [px]
    difference: NDArray[np.float32]  # (row, column, band) second less first; NaN where one is not [DN]
    outlines: tuple[tuple[Floats, tuple[int, int]], ...]  # first pixel and size of each
    shared: tuple[slice, slice]  # rows and columns that both have
    close: tuple[slice, slice]  # around a corner of the second


def join_neighbours() -> Neighbours:
    """Register the second neighbour on the first, and put both together on the first one's pixels."""
    (one, first), (other, second) = (read_picture(name) for name in NEIGHBOURS)
    other = replace(other, origin_px=second - first)
    shift = picture_shift(one, other)
    other = replace(other, origin_px=other.origin_px + shift)
    ends = np.max([part.origin_px + part.values.shape[:2] for part in (one, other)], axis=0)
    shape = int(np.ceil(ends[0])), int(np.ceil(ends[1]))
    alone = [join_pictures([part], shape) for part in (one, other)]
    start, stop = np.ceil(other.origin_px).astype(int), one.values.shape[:2]
    return Neighbours(
        values=join_pictures([one, other], shape),
        shift=shift,
        difference=alone[1] - alone[0],
        outlines=tuple((part.origin_px, part.values.shape[:2]) for part in (one, other)),
        shared=(slice(int(start[0]), stop[0]), slice(int(start[1]), stop[1])),
        close=(slice(int(start[0]) - 30, int(start[0]) + 50), slice(stop[1] - 70, stop[1] + 50)),
    )


def _registered(reference: Picture, moving: Picture, *, whole: bool) -> Picture:
    """Say that a picture lies a few pixels off, find where it does, and put it there."""
    wrong = replace(moving, origin_px=moving.origin_px + WRONG_BY)
    place = wrong.origin_px + picture_shift(reference, wrong)
    return replace(wrong, origin_px=np.rint(place) if whole else place)


def _joined(left: Picture, right: Picture, whole: NDArray[np.float32], kernel: Kernel) -> Joined:
    values = join_pictures([left, right], whole.shape[:2], kernel)
    known = np.isfinite(values)
    differing = int((np.rint(values[known]) != whole[known]).sum() + (~known).sum())
    inner = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))
    error = (values - whole)[inner]
    return Joined(values, values - whole, differing, float(np.sqrt(np.nanmean(error**2)) / whole[inner].std()))

"""What seams are tried on: a survey whose mirror looks beside the plan, parts of a picture put together, known shifts.

The survey is registered, and what is left at its seams measured against the truth. The picture is the RGB and near
infrared one of the data folder, with its two given neighbours. Views of one overlap are random waves, and crop rows
with bare places, with a known shift between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from measure import data_folder
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.ndimage import shift as spline_shift

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from pipeline.geometry.scan import Sweep, shifted_position
from pipeline.planning.coverage import full_sweeps
from pipeline.rectify.geolocation import path_geolocation
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.mosaic import MosaicPart, edge_distance, mosaic
from pipeline.rectify.registration.alignment import SweepShift, no_shifts
from pipeline.rectify.registration.overlaps import LEAST_OVERLAP_PX, BroadSweep, PlacedImage
from pipeline.rectify.registration.seams import Registration, measure_windows, place_images, register_sweeps
from pipeline.rectify.registration.shifts import pair_shift
from pipeline.rectify.resample import resample
from pipeline.simulator.effects.pointing import ACCURACY_PX, REPEATABILITY_PX, PointingErrors
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import raster_from_values, to_bands
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import References

Floats = NDArray[np.float64]

LINES, SAMPLES = 3000, 2000
MARGIN_PX = 100
WAVELENGTHS = (450.0, 550.0, 650.0, 800.0)
RGBN = data_folder("rgbn")
NEIGHBOURS = ("rgbn_suba.tif", "rgbn_subb.tif")
CUT_LEFT, CUT_RIGHT = 220, 320  # columns that both parts have
WRONG_BY = np.array([3.0, -4.0])
BETWEEN = np.array([0.37, 0.61])  # of a pixel, where the second cut's pixels lie
PRIOR_PX = 8.0  # by which a place may be wrong
BLOCK_ROWS = 64
BORDER = 12  # pixels whose spline saw the picture's edge
ROW_PX = 12.0


@dataclass(frozen=True)
class CapturedSweep:
    """The lines of one sweep, kept in memory."""

    sweep: Sweep
    references: References
    position: Floats
    time_s: Floats
    valid_line: NDArray[np.bool_]
    raw: NDArray[np.uint16]

    def read(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Lines ``start`` to ``stop``, (line, sample, band)."""
        return self.raw[start:stop]


@dataclass(frozen=True)
class Survey:
    """A full pass over a farm, captured with pointing errors and registered."""

    camera: LineCamera
    grid: SceneGrid
    pointing: PointingErrors
    sweeps: tuple[CapturedSweep, ...]
    broad: tuple[BroadSweep, ...]
    found: Registration

    @property
    def unregistered(self) -> tuple[SweepShift, ...]:
        """Corrections of nothing."""
        return no_shifts([one.sweep.name for one in self.sweeps])

    def images(self, shifts: Sequence[SweepShift]) -> tuple[PlacedImage, ...]:
        """Broad-band images where ``shifts`` put them."""
        return place_images(self.broad, shifts, self.camera)


def make_survey(lines: int = LINES, samples: int = SAMPLES, *, seed: int = 3) -> Survey:
    """Capture and register: 50 px of systematic error and 0.8 px of jitter in either axis, 64 px beyond the prior."""
    camera = LineCamera()
    farm = farm_scene(5, (lines + 2 * MARGIN_PX, samples + 2 * MARGIN_PX), bands=13, camera=camera)
    chosen = [int(np.argmin(np.abs(farm.wavelength_nm - wanted))) for wanted in WAVELENGTHS]
    values = to_bands(farm.planes, farm.spectra()[:, chosen])
    scene = raster_from_values(values, camera, name="farm", wavelength_nm=farm.wavelength_nm[chosen])
    grid = SceneGrid(lines, samples, 32, 4)
    pointing = PointingErrors(ACCURACY_PX, REPEATABILITY_PX, seed=seed)
    source = SimulatedSource(scene, Rig(camera), seed=0, pointing=pointing)
    planned = full_sweeps(grid, camera, "x", overlap_px=LEAST_OVERLAP_PX + 2 * ACCURACY_PX)
    sweeps = tuple(_captured(source, sweep) for sweep in planned)
    broad = tuple(BroadSweep.read(one, camera) for one in sweeps)
    return Survey(camera, grid, pointing, sweeps, broad, register_sweeps(broad, camera, prior_px=ACCURACY_PX))


def seam_offsets(survey: Survey, shifts: Sequence[SweepShift]) -> list[Floats]:
    """How far apart the places are that neighbours show as one, along every seam: (line, 2) along and scan [px]."""
    images = survey.images(shifts)
    seams = []
    for one, other in zip(range(len(images) - 1), range(1, len(images)), strict=True):
        middle = (survey.sweeps[one].sweep.swath_px + survey.sweeps[other].sweep.swath_px) / 2
        scan = np.arange(-survey.grid.height / 2 + MARGIN_PX, survey.grid.height / 2 - MARGIN_PX)
        points = np.stack([scan, np.full_like(scan, middle)], axis=-1)
        seams.append(_shown(survey, images[other], points) - _shown(survey, images[one], points))
    return seams


def left_again(survey: Survey, shifts: Sequence[SweepShift]) -> list[Floats]:
    """Shift of every seam measured again with the corrections in, mean of its windows, (2,) along and scan [px]."""
    seen = measure_windows(survey.images(shifts), reach_px=3.0)
    found = [each.measured for each in seen if each.measured is not None]
    return [
        np.mean([one.shift for one in found if (one.reference, one.moving) == (k, k + 1)], axis=0)
        for k in range(len(survey.sweeps) - 1)
    ]


def line_errors(survey: Survey) -> list[Floats]:
    """What is left of every line's pointing error about the sweep's straight drift, (line, 2) of each sweep [px]."""
    left = []
    for one in survey.sweeps:
        error = survey.pointing.of_lines(one.sweep.name, range(one.sweep.lines))
        error -= survey.found.of(one.sweep.name).of_lines(one.sweep.lines)
        place = np.arange(len(error)) - (len(error) - 1) / 2
        trend = np.polynomial.polynomial.polyfit(place, error, 1)
        left.append(error - np.polynomial.polynomial.polyval(place, trend).T)
    return left


def _captured(source: SimulatedSource, sweep: Sweep) -> CapturedSweep:
    lines = list(source.lines(sweep))
    return CapturedSweep(
        sweep=sweep,
        references=source.references(sweep),
        position=np.array([(line.mirror_x, line.mirror_y) for line in lines]),
        time_s=np.array([line.time_s for line in lines]),
        valid_line=np.ones(len(lines), bool),
        raw=np.stack([line.data for line in lines]),
    )


def _shown(survey: Survey, image: PlacedImage, points: Floats) -> Floats:
    """Place that a sweep really saw where it is shown at ``points`` (y, x), (n, 2) along and scan [px]."""
    ((scan_path, _),) = image.scan_paths
    at = path_geolocation(scan_path, survey.camera, points, along="x")
    sweep = image.broad.sweep
    error = survey.pointing.of_lines(sweep.name, range(sweep.lines))
    aimed = shifted_position(image.broad.position, error, survey.camera)
    slope = (at[:, 1] - (survey.camera.samples - 1) / 2) * survey.camera.ifov_rad
    rays = np.stack([np.zeros_like(slope), slope, np.ones_like(slope)], axis=-1)
    before = np.clip(np.floor(at[:, 0]).astype(int), 0, sweep.lines - 2)
    fraction = (at[:, 0] - before)[:, None]
    ends = [
        direction_to_scene(reflect(rays, position_to_normal(aimed[scan_path.lines[scan_path.starts[before + k]]])))
        for k in (0, 1)
    ]
    place: Floats = ((1 - fraction) * ends[0] + fraction * ends[1]) / survey.camera.ifov_rad
    return place


@dataclass(frozen=True)
class Picture:
    """An image and where its first pixel's centre lies on the grid. Its geolocation grid is a shift and nothing else."""

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


def wave_views(
    seed: int, shape: tuple[int, int], shift: Floats, snr: float, periods: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Sixty random waves with periods spread evenly in log; ``snr`` is the deviation over that of the noise."""
    rng = np.random.default_rng(seed)
    period = np.exp(rng.uniform(*np.log(periods), 60))
    turn, phase = rng.uniform(0, 2 * np.pi, (2, 60))
    y, x = np.arange(shape[0])[:, None], np.arange(shape[1])[None, :]

    def view(dy: float, dx: float) -> Floats:
        seen = np.zeros(shape)
        for down, right, start in zip(np.sin(turn) / period, np.cos(turn) / period, phase, strict=True):
            seen += np.cos(2 * np.pi * (down * (y + dy) + right * (x + dx)) + start)
        return seen / np.sqrt(30) + rng.normal(size=shape) / snr

    return view(0.0, 0.0), view(*shift)


def row_views(seed: int, shape: tuple[int, int], shift: Floats, snr: float, gaps: float) -> tuple[Floats, Floats]:
    """Crop rows 12 px apart along the first axis, a fraction ``gaps`` of their length bare; shifts of up to 50 px."""
    rng = np.random.default_rng(seed)
    stand = np.ones((int(shape[1] / ROW_PX) + 12, shape[0] + 120))
    for row in stand:
        start = 0
        while start < len(row):
            stop = start + int(rng.integers(5, 40))
            row[start:stop] = rng.random() >= gaps
            start = stop
    stand = gaussian_filter1d(stand, 1.2, axis=1)
    first = rng.uniform(0, ROW_PX)

    def view(dy: float, dx: float) -> Floats:
        along, across = np.arange(shape[0]) + dy + 60, np.arange(shape[1]) + dx + 60 - first
        plants = np.exp(-0.5 * ((across[None, :] - ROW_PX * np.arange(len(stand))[:, None]) / 2.5) ** 2)
        lengths = np.stack([np.interp(along, np.arange(stand.shape[1]), row) for row in stand])
        seen = lengths.T @ plants
        return seen / seen.std() + rng.normal(size=shape) / snr

    return view(0.0, 0.0), view(*shift)

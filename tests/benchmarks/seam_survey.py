"""A survey whose mirror looks beside the plan, its registration, and what is left at the seams against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from pipeline.geometry.scan import Sweep, shifted_position
from pipeline.planning.coverage import full_sweeps
from pipeline.rectify.lookup import track_lookup
from pipeline.rectify.registration.alignment import SweepShift, no_shifts
from pipeline.rectify.registration.overlaps import LEAST_OVERLAP_PX, BroadSweep, PlacedImage
from pipeline.rectify.registration.seams import Registration, measure_windows, place_images, register_sweeps
from pipeline.simulator.effects.pointing import ACCURACY_PX, REPEATABILITY_PX, PointingErrors
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.scenes.scene import to_bands
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import References

Floats = NDArray[np.float64]

LINES, SAMPLES = 3000, 2000
MARGIN_PX = 100
WAVELENGTHS = (450.0, 550.0, 650.0, 800.0)


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
        middle = (survey.sweeps[one].sweep.strip_px + survey.sweeps[other].sweep.strip_px) / 2
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
    ((track, _),) = image.tracks
    at = track_lookup(track, survey.camera, points, along="x")
    sweep = image.broad.sweep
    error = survey.pointing.of_lines(sweep.name, range(sweep.lines))
    aimed = shifted_position(image.broad.position, error, survey.camera)
    slope = (at[:, 1] - (survey.camera.samples - 1) / 2) * survey.camera.ifov_rad
    rays = np.stack([np.zeros_like(slope), slope, np.ones_like(slope)], axis=-1)
    before = np.clip(np.floor(at[:, 0]).astype(int), 0, sweep.lines - 2)
    share = (at[:, 0] - before)[:, None]
    ends = [
        direction_to_scene(reflect(rays, position_to_normal(aimed[track.lines[track.starts[before + k]]])))
        for k in (0, 1)
    ]
    place: Floats = ((1 - share) * ends[0] + share * ends[1]) / survey.camera.ifov_rad
    return place

"""The coarse mosaic begun while its lines arrive from a rig: the plan of the fine pass waits for the rest alone."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from flows.run import SurveyRun
from flows.tones import choose_bands
from pipeline.errors import PipelineError
from pipeline.rectify.placed import PixelGrid
from pipeline.source import Source
from storage.addresses import ahead_of
from storage.archive import StageRef
from storage.lookups import path_digest
from storage.mosaic_ahead import AheadOf, MosaicAhead, PlannedLines, place_as_planned, take_over
from storage.mosaic_work import MosaicWork
from storage.mosaics import MosaicWriter
from storage.sightings import Sighted
from storage.tile_work import Thumbnail

LOG = logging.getLogger(__name__)
QUICKLOOK_PX = 512

Arrived = Callable[[str, int], None]  # a sweep's name, and how many of its lines are in the spool


def begin_mosaic(run: SurveyRun, path: Path, simulation: Mapping[str, Any] | None = None) -> MosaicWriter:
    """Begin the file of the coarse mosaic."""
    return MosaicWriter(
        path, PixelGrid.of_scene(run.grid, run.grid.factor).shape, run.scene.wavelength_nm, fwhm_nm=run.scene.fwhm_nm,
        grid=run.angular_grid(run.grid.factor), simulation=simulation,
    )  # fmt: skip


def mosaic_picture(run: SurveyRun) -> Thumbnail:
    """Give what the mosaic's quicklook is gathered in."""
    colours, _ = choose_bands(run.scene.wavelength_nm)
    return Thumbnail(PixelGrid.of_scene(run.grid, run.grid.factor).shape, colours, QUICKLOOK_PX)


@contextmanager
def rectifying_ahead(run: SurveyRun, version: int, source: Source, key: str) -> Iterator[Arrived]:
    """Make tiles of the mosaic while the block captures the coarse sweeps under ``key``; gives what is to be told.

    Nothing is made ahead of a simulated capture, which uses the processor itself, nor where lines lie elsewhere than
    planned for all one knows: seams to be registered, or a mirror that no pulse steps or whose log says where it was.
    Trouble with it is no trouble of the capture: then the mosaic is made in its turn, by ``version`` of that stage.
    """
    from pipeline.rig.capture.capture_paths import (  # loads scipy, which a plan does without
        can_trigger,
        planned_positions,
    )

    rig = run.settings.rig
    steady = not rig.log_pulses and all(can_trigger(rig.pulses, sweep) for sweep in run.plan.coarse)
    if run.rig is None or run.settings.pointing_px or not steady:
        yield lambda name, count: None
        return
    planned = [
        (sweep, source.references(sweep), planned_positions(sweep, run.camera).astype(np.float64))
        for sweep in sorted(run.plan.coarse, key=lambda sweep: sweep.name)
    ]
    try:
        ahead = _begin_ahead(run, version, key, [PlannedLines(run.archive.spool_folder(key), *one) for one in planned])
    except (PipelineError, OSError) as error:
        LOG.info("the mosaic is made after its lines: %s", error)
        yield lambda name, count: None
        return
    with ahead:
        yield ahead.arrived


def _begin_ahead(run: SurveyRun, version: int, key: str, lines: Sequence[PlannedLines]) -> MosaicAhead:
    grid = PixelGrid.of_scene(run.grid, run.grid.factor)
    placed = [place_as_planned(one, run.camera, grid) for one in lines]
    return MosaicAhead(
        run.archive.spool_folder(ahead_of(key)), MosaicWork(placed, run.camera, grid, run.settings.kernel),
        lambda path: begin_mosaic(run, path), mosaic_picture(run), memory=run.settings.memory, version=version,
    )  # fmt: skip


def take_mosaic(
    run: SurveyRun, version: int, raw: StageRef, out: Path, sweeps: Sequence[Sighted], seen: Thumbnail
) -> Sequence[tuple[int, int]]:
    """Move what was made of the mosaic while its lines arrived to ``out``; first row and column of its tiles."""
    if run.rig is None:
        return []
    wanted = AheadOf(run.camera, PixelGrid.of_scene(run.grid, run.grid.factor), run.settings.kernel, version)
    paths = {one.cube.sweep.name: path_digest(one.cube.position, one.usable, one.shift_px) for one in sweeps}
    return take_over(run.archive.spool_folder(ahead_of(raw.key)), out, wanted, paths, seen)


def drop_ahead(run: SurveyRun, raw: StageRef) -> None:
    """Remove what was made ahead and is not needed any more."""
    run.archive.drop_spool(ahead_of(raw.key))

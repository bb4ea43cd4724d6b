"""The stage of a raster, whose pixels are taken as they are: they are condensed, and nothing is captured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import RASTER, SignalChoice
from flows.tasks.stage import FieldFrame, Report, Wanted, stage
from flows.tasks.stages.placement import MOSAIC, finish_mosaic
from pipeline.readings import MOST_VALUE, readings_alone
from pipeline.signal.condense import UNUSABLE, score_lines
from pipeline.signal.subspace import FEW_BANDS, SignalStatistics, bands_alone, components_of_field
from storage.arrays.layout import SHARD_ROWS
from storage.arrays.mosaics import MosaicWriter
from storage.readers.raster_fields import RasterPixels

Rows = tuple[int, NDArray[np.float32], NDArray[np.bool_]]


@stage("condense_raster", "signal of the raster", MOSAIC, inputs=0)
def condense_raster(
    *, raster: RasterPixels, frame: FieldFrame, signal: SignalChoice, scene_key: str, memory: int, report: Report
) -> Wanted:
    """Condense the pixels of a raster into the mosaic of its field."""

    def blocks() -> Iterator[Rows]:
        """Yield the first row, values and validity of some rows at a time."""
        deep = max(raster.rows_at_once(memory) // SHARD_ROWS, 1) * SHARD_ROWS
        for first in range(0, frame.grid.height, deep):
            values = readings_alone(raster.rows(first, min(first + deep, frame.grid.height)), MOST_VALUE)
            valid = np.isfinite(values)
            yield first, values, valid.all(axis=2) if valid.all() else valid

    def build(path: Path) -> None:
        """Read the raster twice: for its components, and for its scores."""
        found, whole = SignalStatistics(raster.bands, frame.grid.height * frame.grid.width), True
        for first, values, valid in blocks():
            found.add(values, valid)
            whole = whole and not np.nanmax(np.abs(values - np.rint(values)), initial=0)
            report(0.5 * first / frame.grid.height)
        if raster.bands <= FEW_BANDS and found.count:
            components = bands_alone(found, 1.0 if whole else None)
        else:
            components = components_of_field(
                found, frame.wavelength_nm, false_alarm=signal.false_alarm, least=signal.least
            )
        origin = np.zeros(raster.bands) if found.origin is None else found.origin
        writer = MosaicWriter(
            path / "mosaic.zarr",
            (frame.grid.height, frame.grid.width),
            components,
            frame.wavelength_nm,
            step=signal.step,
            largest=components.largest(found.largest + np.abs(origin - np.nan_to_num(components.mean))),
            fwhm_nm=frame.fwhm_nm,
            grid=frame.angular_grid(),
        )
        for first, values, valid in blocks():
            seen = score_lines(values, valid, components)
            writer.write_rows(first, seen.scores, seen.quality != UNUSABLE)
            report(0.5 + 0.5 * (first + len(values)) / frame.grid.height)
        finish_mosaic(writer, frame)

    params = {"source": RASTER, "scene": scene_key, "grid": asdict(frame.grid), **asdict(signal), **frame.key}
    return Wanted(build, params | {"bands": raster.bands})

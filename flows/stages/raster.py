"""Compress a raster, whose pixels are a map already, into its mosaic."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.frame import FieldFrame
from spectralzoom.flows.stage import Output, Unkeyed, stage
from spectralzoom.pipeline.readings import MOST_VALUE, readings_alone
from spectralzoom.pipeline.signal.components import SignalChoice
from spectralzoom.pipeline.signal.condense import UNUSABLE, score_lines
from spectralzoom.pipeline.signal.subspace import SignalStatistics, components_of_raster
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.storage.arrays.layout import SHARD_ROWS
from spectralzoom.storage.arrays.mosaics import MosaicWriter
from spectralzoom.storage.arrays.raster_pixels import RasterPixels

MADE_BY = ("pipeline/signal", "storage/arrays/mosaics.py")


@stage("signal of the raster", version=9, product="rectify", made_by=MADE_BY)
def condense_raster(
    out: Output,
    *,
    scene: RasterScene,
    frame: FieldFrame,
    signal: SignalChoice,
    raster: Unkeyed[RasterPixels],
    memory: Unkeyed[int],
) -> None:
    """Compress the pixels of a raster into its mosaic. They are read twice: for components, and for scores."""

    def blocks() -> Iterator[tuple[int, NDArray[np.float32], NDArray[np.bool_]]]:
        """Yield blocks of rows: first row, values, validity."""
        deep = max(raster.rows_at_once(memory) // SHARD_ROWS, 1) * SHARD_ROWS
        for first in range(0, frame.grid.height, deep):
            values = readings_alone(raster.rows(first, min(first + deep, frame.grid.height)), MOST_VALUE)
            valid = np.isfinite(values)
            yield first, values, valid.all(axis=2) if valid.all() else valid

    found = SignalStatistics(raster.bands, frame.grid.height * frame.grid.width)
    whole = True
    for first, values, valid in blocks():
        found.add(values, valid)
        whole = whole and not np.nanmax(np.abs(values - np.rint(values)), initial=0)
        out.report(0.5 * first / frame.grid.height)
    components = components_of_raster(
        found, frame.wavelength_nm, whole=whole, false_alarm=signal.false_alarm, least=signal.least
    )
    origin = np.zeros(raster.bands) if found.origin is None else found.origin
    writer = MosaicWriter(
        out.path / "mosaic.zarr",
        (frame.grid.height, frame.grid.width),
        components,
        frame.wavelength_nm,
        step=signal.step,
        largest=components.largest(found.largest + np.abs(origin - np.nan_to_num(components.mean))),
        fwhm_nm=frame.fwhm_nm,
        grid=frame.angular_grid(),
    )
    for first, values, valid in blocks():
        scored = score_lines(values, valid, components)
        writer.write_rows(first, scored.scores, scored.quality != UNUSABLE)
        out.report(0.5 + 0.5 * (first + len(values)) / frame.grid.height)
    writer.blank(frame.missing)

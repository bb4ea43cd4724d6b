"""The stages of a raster, whose pixels are taken as they are: coarse means, and patches at the file's own pixels."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from flows.settings.survey_settings import RASTER
from flows.tasks.stage import FieldFrame, Report, Wanted, stage
from flows.tasks.stages.attention import load_plan
from flows.tasks.stages.placement import MOSAIC, PATCHES, finish_mosaic, patch_writer, thumbnail_of
from storage.archive.keys import StageRef
from storage.arrays.mosaics import MosaicWriter
from storage.readers.raster_fields import RasterPixels, write_means, write_patches


@stage("average_raster", "coarse means of the raster", MOSAIC, inputs=0)
def average_raster(*, raster: RasterPixels, frame: FieldFrame, scene_key: str, memory: int, report: Report) -> Wanted:
    """Store the means of factor x factor pixels of a raster: what attention looks at first."""

    def build(path: Path) -> None:
        """Write mosaic and quicklook some rows at a time; where most of a pixel has no value, it has none."""
        grid, place = frame.grid, frame.angular_grid(frame.grid.factor)
        wave, fwhm = frame.wavelength_nm, frame.fwhm_nm
        writer = MosaicWriter(path / "mosaic.zarr", grid.coarse_shape, wave, fwhm_nm=fwhm, grid=place)
        picture = thumbnail_of(frame)
        write_means(raster, writer, memory=memory, seen=picture, report=report)
        finish_mosaic(writer, picture, frame)

    return Wanted(build, _params(frame, scene_key))


@stage("take_patches", "patches of the raster", PATCHES, inputs=1)
def take_patches(
    attention: StageRef, *, raster: RasterPixels, frame: FieldFrame, scene_key: str, memory: int, report: Report
) -> Wanted:
    """Store the patches that attention asks for, at the raster's own pixels; NaN where it has no value."""

    def build(path: Path) -> None:
        """Write the patches in the order of their numbers, some rows of the raster at a time."""
        patch_index = load_plan(attention).patch_index
        write_patches(raster, patch_writer(path, frame, patch_index), patch_index, memory=memory, report=report)

    return Wanted(build, _params(frame, scene_key), [attention])


def _params(frame: FieldFrame, scene_key: str) -> dict[str, Any]:
    """Return what pixels of a raster depend on: the content of its files, and the grid."""
    bands = len(frame.wavelength_nm)
    return {"source": RASTER, "scene": scene_key, "bands": bands, "grid": asdict(frame.grid), **frame.key}

"""The stages of a raster, whose pixels are taken as they are: coarse means, and patches at the file's own pixels."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from flows.settings.survey_settings import RASTER
from flows.tasks.run import SurveyRun
from flows.tasks.stage import Wanted, stage
from flows.tasks.stages.attention import load_plan
from flows.tasks.stages.placement import MOSAIC, PATCHES, QUICKLOOK_PX
from storage.archive.keys import StageRef
from storage.arrays.layout import NO_VALUE, blank_coarse, blank_pixels
from storage.arrays.mosaics import MosaicWriter, PatchWriter
from storage.arrays.quicklooks import choose_bands, stretched
from storage.arrays.tile_work import Thumbnail
from storage.readers.raster_fields import RasterPixels, write_means, write_patches


@stage("average_raster", "coarse means of the raster", MOSAIC, inputs=0)
def average_raster(run: SurveyRun) -> Wanted:
    """Store the means of factor x factor pixels of a raster: what attention looks at first."""

    def build(path: Path) -> None:
        """Write mosaic and quicklook some rows at a time; where most of a pixel has no value, it has none."""
        grid, wave = run.grid, run.scene.wavelength_nm
        place = run.angular_grid(grid.factor)
        writer = MosaicWriter(path / "mosaic.zarr", grid.coarse_shape, wave, fwhm_nm=run.scene.fwhm_nm, grid=place)
        picture = Thumbnail(grid.coarse_shape, choose_bands(wave)[0], QUICKLOOK_PX)
        write_means(_pixels(run), writer, memory=run.settings.memory, seen=picture, report=run.report)
        if run.scene.missing is not None:
            gaps = blank_coarse(run.scene.missing, grid.factor)
            blank_pixels(path / "mosaic.zarr", gaps, NO_VALUE)
            picture.blank(gaps)
        writer.write_quicklook(stretched(picture.image).image)

    return Wanted(build, _params(run))


@stage("take_patches", "patches of the raster", PATCHES, inputs=1)
def take_patches(run: SurveyRun, attention: StageRef) -> Wanted:
    """Store the patches that attention asks for, at the raster's own pixels; NaN where it has no value."""

    def build(path: Path) -> None:
        """Write the patches in the order of their numbers, some rows of the raster at a time."""
        patch_index = load_plan(attention).patch_index
        writer = PatchWriter(
            path / "patches.zarr",
            patch_index,
            run.grid.patch_origin(patch_index),
            run.grid.patch,
            run.scene.wavelength_nm,
            fwhm_nm=run.scene.fwhm_nm,
            grid=run.angular_grid(),
        )
        write_patches(_pixels(run), writer, patch_index, memory=run.settings.memory, report=run.report)

    return Wanted(build, _params(run), [attention])


def _pixels(run: SurveyRun) -> RasterPixels:
    assert run.raster is not None  # the flow calls these stages for a raster alone
    return run.raster


def _params(run: SurveyRun) -> dict[str, Any]:
    """What pixels of a raster depend on: the content of its files, and the grid."""
    bands = len(run.scene.wavelength_nm)
    return {"source": RASTER, "scene": run.scene.key, "bands": bands, "grid": asdict(run.grid), **run.place_key}

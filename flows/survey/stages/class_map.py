"""The stage that draws the class map from coarse and fine patches, and what both are to the model."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.survey.field_work import FieldWork, look_at, region_params, seat_columns
from flows.survey.run import SurveyRun
from flows.survey.stage import Product, Wanted, stage
from models.reading.inference import CoarseLook, Glance, read_glance
from models.reading.regions import whole_field
from storage.archive.keys import StageRef, array_digest
from storage.archive.manifests import read_table, write_table
from storage.arrays.class_maps import ClassNames, clear_classes, create_class_map
from storage.arrays.mosaics import open_patches

CLASS_MAP = Product("segment", version=5, by_weights=True)
STRANGE = "strange.json"  # beside a map, where values were no readings


@stage("draw_map", "class map", CLASS_MAP, of=("rectify", "cut_patches"), unit="operations of the map", size="pixels")
def draw_map(run: SurveyRun, mosaic: StageRef, patches: StageRef) -> Wanted:
    """Read coarse and fine patches together and draw the class map, one region of the field after the other.

    Where the scene has no value the map has no class.
    """

    def build(path: Path) -> None:
        out, legend = path / "class_map.zarr", ClassNames(run.weights.class_names, run.weights.class_colours)
        create_class_map(out, (run.grid.height, run.grid.width), legend, grid=run.angular_grid())
        strange = FieldWork.of(run).draw(mosaic.path / "mosaic.zarr", patches.path / "patches.zarr", out, run.report)
        if any(strange):
            write_table(path / STRANGE, dict(zip(("coarse_px", "fine_px"), strange, strict=True)))
        if run.scene.missing is not None:
            clear_classes(out, run.scene.missing)

    params = {
        "weights": run.weights_key,
        "grid": asdict(run.grid),
        **region_params(run.grid),
        **({} if run.scene.missing is None else {"missing": array_digest(run.scene.missing)}),
    }
    return Wanted(build, params, [mosaic, patches])


def strange_pixels(class_map: StageRef) -> dict[str, int]:
    """Coarse and fine pixels that were left out of a map, as no sensor gives their values; empty without any."""
    path = class_map.path / STRANGE
    return dict(read_table(path)) if path.is_file() else {}


def glance_at(run: SurveyRun, mosaic: StageRef) -> Glance:
    """What the model says of a stored coarse mosaic alone, the whole field at once: for those that hold it anyway."""
    return read_glance(run.weights, look_at(run.weights, mosaic.path / "mosaic.zarr", whole_field(run.grid)))


def patch_columns(run: SurveyRun, patches: StageRef, seen: CoarseLook) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Seats of the whole field and their normalised spectral columns, (seat, p, p, column); see ``seat_columns``."""
    store = open_patches(patches.path / "patches.zarr")
    return seat_columns(run.weights, store, run.scene.wavelength_nm, seen, whole_field(run.grid))

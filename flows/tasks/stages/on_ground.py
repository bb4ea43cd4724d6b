"""Define the stage that projects the map to the ground: classes, picture, age, changes and areas."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import MapChoice
from flows.tasks.stage import Product, Report, Wanted, stage
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import PosedField, areas_by_number
from pipeline.ground.map_grid import GroundGrid, image_at, map_blocks, nearest_at
from storage.archive.keys import StageRef
from storage.arrays.class_maps import OLD_CLASS, ClassNames, ProbabilityStore, load_class_map
from storage.arrays.ground_maps import BLOCK, GroundMapWriter
from storage.arrays.mosaics import open_mosaic
from storage.arrays.quicklooks import choose_bands, develop, stretch

STORE = "ground_map.zarr"
GROUND = Product("ground", version=4, files=(STORE,))


@stage("ground", "map on the ground", GROUND)
def ground(
    class_map: StageRef, mosaic: StageRef, *, ground_grid: GroundGrid, map_choice: MapChoice, report: Report
) -> Wanted:
    """Project class map, ages, changes and picture to the ground, by the pose of the rig."""
    grid = ground_grid

    def build(path: Path) -> None:
        """Write the map in blocks, then the area of each class."""
        found = load_class_map(class_map.path / "class_map.zarr")
        probabilities = ProbabilityStore(class_map.path / "class_probabilities.zarr")
        colours = coarse_colours(mosaic, None)
        unsure, age_days = np.isnan(found.confidence), probabilities.age()
        fractions, old_class = probabilities.changed(), probabilities.old_class()  # None for a first visit

        def shown(pixels: NDArray[np.float64]) -> dict[str, NDArray[np.generic]]:
            """Return the images of a block by name, at places (row, column, 2); nodata is 255, NaN and 0.

            Confidence and picture are interpolated, other images have the nearest pixel.
            """
            confidence = image_at(found.confidence[..., None], pixels)[..., 0]
            confidence[nearest_at(unsure, pixels, False)] = np.nan  # class unknown
            picture = np.nan_to_num(np.rint(image_at(colours, pixels, factor=1))).astype(np.uint8)
            images: dict[str, NDArray[np.generic]] = {
                "classes": nearest_at(found.classes, pixels, UNLABELLED),
                "confidence": confidence,
                "picture": picture,
                "age": nearest_at(age_days, pixels, np.nan),
            }
            if fractions is not None and old_class is not None:
                images["changed"] = nearest_at(fractions, pixels, np.nan, factor=probabilities.patch_px)
                images[OLD_CLASS] = nearest_at(old_class, pixels, UNLABELLED)
            return images

        legend, goes_on = ClassNames(found.names, found.colours), fractions is not None and old_class is not None
        about = {"rig_pose": asdict(grid.frame.view.pose), "scene_pixels": grid.counts()}
        writer = GroundMapWriter(path / STORE, grid.geobox, legend, about=about, goes_on=goes_on)
        for rows, columns in map_blocks(grid.shape, BLOCK):
            writer.write_block(rows, columns, shown(grid.scene_pixels(rows, columns)))
            report(rows.stop / grid.shape[0])
        areas = areas_by_number(PosedField(grid), found.classes, len(found.names))
        assert areas is not None
        writer.finish(areas)

    params = {
        "pose": asdict(grid.frame.view.pose),
        "map": asdict(map_choice),
        "ifov_rad": grid.frame.view.ifov_rad,
        "scene_shape": grid.scene_shape,
    }
    return Wanted(build, params, [class_map, mosaic])


def coarse_colours(mosaic: StageRef, factor: int | None) -> NDArray[np.float32]:
    """Return three bands of a mosaic as a picture (y, x, 3) in 1..255; NaN where nothing was captured.

    Its pixels consist of ``factor`` x ``factor`` fine ones; None: pixels of the mosaic.
    """
    seen = open_mosaic(mosaic.path / "mosaic.zarr")
    bands, words = choose_bands(seen.wavelength_nm)
    values = np.concatenate([seen.spectra(strip, bands) for strip in seen.row_blocks(factor)])
    tones = develop(values, values) if words.startswith("true colour") else stretch(values)
    picture: NDArray[np.float32] = np.where(np.isfinite(values), 1 + 254 * tones, np.nan).astype(np.float32)
    return picture

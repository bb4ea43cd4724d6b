"""Project the class map to the ground, by the pose of the rig."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.stage import Output, stage
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.field_places import PosedField, areas_by_number
from spectralzoom.pipeline.ground.map_grid import GroundGrid, image_at, map_blocks, nearest_at
from spectralzoom.storage.arrays.class_maps import MAP, OLD_CLASS, PROBABILITIES, ProbabilityStore, load_class_map
from spectralzoom.storage.arrays.ground_maps import BLOCK, GroundMapWriter
from spectralzoom.storage.arrays.mosaics import choose_bands, develop, open_mosaic
from spectralzoom.storage.store import Ref

STORE = "ground_map.zarr"


@stage("map in a projected CRS", version=9, made_by=("pipeline/ground", "storage/arrays/ground_maps.py"))
def ground(out: Output, class_map: Ref, mosaic: Ref, *, ground_grid: GroundGrid) -> None:
    """Project class map, changes and picture to the ground, in blocks, and measure the area of each class."""
    found = load_class_map(class_map.path / MAP)
    old_class = ProbabilityStore(class_map.path / PROBABILITIES).old_class()
    colours = colours_of(mosaic)
    unsure = np.isnan(found.confidence)

    def shown(pixels: NDArray[np.float64]) -> dict[str, NDArray[np.generic]]:
        """Return the images of a block by name, at places (row, column, 2); nodata is 255, NaN and 0.

        Confidence and picture are interpolated, other images have the nearest pixel.
        """
        confidence = image_at(found.confidence[..., None], pixels)[..., 0]
        confidence[nearest_at(unsure, pixels, False)] = np.nan  # beside nodata
        images: dict[str, NDArray[np.generic]] = {
            "classes": nearest_at(found.classes, pixels, UNLABELLED),
            "confidence": confidence,
            "picture": np.nan_to_num(np.rint(image_at(colours, pixels))).astype(np.uint8),
        }
        if old_class is not None:
            images[OLD_CLASS] = nearest_at(old_class, pixels, UNLABELLED)
        return images

    writer = GroundMapWriter(
        out.path / STORE,
        ground_grid.geobox,
        found.legend,
        about={"rig_pose": asdict(ground_grid.frame.view.pose), "scene_pixels": ground_grid.counts()},
        goes_on=old_class is not None,
    )
    for rows, columns in map_blocks(ground_grid.shape, BLOCK):
        writer.write_block(rows, columns, shown(ground_grid.scene_pixels(rows, columns)))
        out.report(rows.stop / ground_grid.shape[0])
    areas = areas_by_number(PosedField(ground_grid), found.classes, len(found.names))
    assert areas is not None
    writer.finish(areas)


def colours_of(mosaic: Ref) -> NDArray[np.float32]:
    """Return three bands of a mosaic as a picture (y, x, 3) in 1..255; NaN where nothing was captured."""
    seen = open_mosaic(mosaic.path / "mosaic.zarr")
    bands, caption = choose_bands(seen.wavelength_nm)
    values = np.concatenate([seen.spectra(strip, bands) for strip in seen.row_blocks()])
    return np.where(np.isfinite(values), 1 + 254 * develop(values, caption), np.nan).astype(np.float32)

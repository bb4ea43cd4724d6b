"""The stage that draws a posed survey's map on the ground: classes, picture, how old and what changed, hectares."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.tasks.run import SurveyRun
from flows.tasks.stage import Product, Wanted, stage
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import PosedField, areas_by_number
from pipeline.ground.map_grid import GroundGrid, ground_grid, image_at, map_blocks, nearest_at
from pipeline.ground.view import GroundView
from storage.archive.keys import StageRef
from storage.arrays.class_maps import OLD_CLASS, ClassMap, ClassNames, ProbabilityStore, load_class_map
from storage.arrays.ground_maps import BLOCK, GroundMapWriter
from storage.arrays.layout import SHARD_ROWS, open_group, read_array, read_bands
from storage.arrays.quicklooks import choose_bands, develop, stretch

STORE = "ground_map.zarr"
GROUND = Product("ground", version=4, files=(STORE,))


@stage("ground", "map on the ground", GROUND)
def ground(run: SurveyRun, class_map: StageRef, mosaic: StageRef) -> Wanted:
    """Draw the class map, its memory and the coarse picture on the ground, by the settings' pose."""
    grid, choice = survey_grid(run), run.settings.map
    assert grid is not None

    def build(path: Path) -> None:
        """Write the map block by block, then the area of each class."""
        shown = ShownField.read(class_map, mosaic, run.grid.factor)
        legend = ClassNames(shown.found.names, shown.found.colours)
        about = {"rig_pose": asdict(grid.frame.view.pose), "scene_pixels": grid.counts()}
        writer = GroundMapWriter(path / STORE, grid.geobox, legend, about=about, goes_on=shown.changes is not None)
        for rows, columns in map_blocks(grid.shape, BLOCK):
            writer.write_block(rows, columns, shown.at(grid.scene_pixels(rows, columns)))
            run.report(rows.stop / grid.shape[0])
        areas = areas_by_number(PosedField(grid), shown.found.classes, len(shown.found.names))
        assert areas is not None
        writer.finish(areas)

    params = {
        "pose": asdict(grid.frame.view.pose),
        "map": asdict(choice),
        "ifov_rad": run.camera.ifov_rad,
        "scene_shape": run.scene.shape,
        "factor": run.grid.factor,
    }
    return Wanted(build, params, [class_map, mosaic])


@dataclass(frozen=True)
class Changes:
    """What of a field is another class than remembered."""

    fractions: NDArray[np.float32]  # (seat_y, seat_x)
    patch_px: int
    old_class: NDArray[np.uint8]  # (y, x), 255 where it did not change


@dataclass(frozen=True)
class ShownField:
    """What a map on the ground shows of a field, on the field's own pixels."""

    found: ClassMap
    unsure: NDArray[np.bool_]  # (y, x) without a confidence
    age_days: NDArray[np.float32]  # (y, x), NaN where nothing is known
    changes: Changes | None  # None of a first look
    colours: NDArray[np.float32]  # (y, x, 3) of the coarse picture
    factor: int  # fine px of its pixels

    @classmethod
    def read(cls, class_map: StageRef, mosaic: StageRef, factor: int) -> ShownField:
        """Read a map, what is believed beside it and the coarse picture under it."""
        probabilities = ProbabilityStore(class_map.path / "class_probabilities.zarr")
        fractions, old_class, changes = probabilities.changed(), probabilities.old_class(), None
        if fractions is not None and old_class is not None:
            changes = Changes(fractions, probabilities.patch_px, old_class)
        found = load_class_map(class_map.path / "class_map.zarr")
        return cls(found, np.isnan(found.confidence), probabilities.age(), changes, coarse_colours(mosaic), factor)

    def at(self, pixels: NDArray[np.float64]) -> dict[str, NDArray[np.generic]]:
        """All images of a block of the map, by name, at places (row, column, 2); 255, NaN and 0 where nothing is seen.

        Each place shows the nearest pixel, but confidence and picture lie between pixels.
        """
        confidence = image_at(self.found.confidence[..., None], pixels)[..., 0]
        confidence[nearest_at(self.unsure, pixels, False)] = np.nan  # of the class unknown, whatever lies beside it
        picture = np.nan_to_num(np.rint(image_at(self.colours, pixels, factor=self.factor))).astype(np.uint8)
        images: dict[str, NDArray[np.generic]] = {
            "classes": nearest_at(self.found.classes, pixels, UNLABELLED),
            "confidence": confidence,
            "picture": picture,
            "age": nearest_at(self.age_days, pixels, np.nan),
        }
        if self.changes is not None:
            fractions, patch = self.changes.fractions, self.changes.patch_px
            images["changed"] = nearest_at(fractions, pixels, np.nan, factor=patch)
            images[OLD_CLASS] = nearest_at(self.changes.old_class, pixels, UNLABELLED)
        return images


def survey_grid(run: SurveyRun) -> GroundGrid | None:
    """The map's grid that the settings ask for, None without a pose. Raises PoseError where there can be none."""
    pose, choice = run.settings.pose, run.settings.map
    if pose is None:
        return None
    view = GroundView(pose, run.camera.ifov_rad)
    return ground_grid(view, run.scene.shape, epsg=choice.epsg, resolution_m=choice.resolution_m)


def coarse_colours(mosaic: StageRef) -> NDArray[np.float32]:
    """Three bands of the coarse mosaic in a photograph's tones, (y, x, 3) in 1..255; NaN where nothing was captured."""
    group = open_group(mosaic.path / "mosaic.zarr")
    bands, words = choose_bands(read_bands(group)[0])
    height = len(read_array(group, "coverage"))
    rows = (slice(first, min(first + SHARD_ROWS, height)) for first in range(0, height, SHARD_ROWS))
    values = np.concatenate([read_array(group, "values", block)[..., list(bands)] for block in rows])
    tones = develop(values, values) if words.startswith("true colour") else stretch(values)
    picture: NDArray[np.float32] = np.where(np.isfinite(values), 1 + 254 * tones, np.nan).astype(np.float32)
    return picture

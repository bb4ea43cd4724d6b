"""Fields of which little is of interest: one block of a farm, and one crop or bare soil on all the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.simulator.scenes.farm.farm_plan import Canvas, FarmPlan, Ground, Painting, farm_plan
from pipeline.simulator.scenes.farm.farm_scene import CLASSES, farm_scene
from pipeline.simulator.scenes.farm.fields import paint_fields
from pipeline.simulator.scenes.farm.land import Parcel, stream
from pipeline.simulator.scenes.scene import RasterScene, SceneRaster

LATTICE_PX = 32  # from one place that a block may have to the next
REST = ("soil", "wheat_a", "grass")  # what grows on the rest of a land, by its seed


def sparse_land(
    seed: int, shape: tuple[int, int], block: tuple[int, int], camera: LineCamera
) -> tuple[RasterScene, tuple[slice, slice]]:
    """Give a farm of (y, x) px left as it is in one block of (y, x) px, and where that lies.

    The block is where classes are mixed most. On the rest lies one field without borders, weeds and wheel marks.
    """
    farm = farm_scene(seed, shape, camera=camera)
    assert farm.labels is not None
    rest = REST[seed % len(REST)]
    plan = farm_plan(seed, shape)
    planes, labels = _one_field(plan, rest)
    place = _busiest(farm.labels, block)
    planes[place], labels[place] = farm.planes[place], farm.labels[place]
    key = f"{farm.key}/block={place}/rest={rest}"
    return replace(farm, key=key, raster=SceneRaster.of(planes, labels)), place


def _one_field(plan: FarmPlan, use: str) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Planes and labels of a land that is one field of a use, in the materials of a plan."""
    y, x = (size / 2 + 40.0 for size in plan.shape)
    everywhere = Parcel(np.array([[-y, -x], [-y, x], [y, x], [y, -x]]))
    like = next((field for field in plan.fields if field.use == use), plan.fields[0])
    field = replace(like, parcel=everywhere, use=use, tramlines=None, weeds=0.0, lodging=0.0)
    ground = Ground.draw(stream(plan.seed, "ground"), plan.shape)
    work = Painting(replace(plan, fields=(field,), borders=()), ground, Canvas(plan.shape, plan.materials))
    paint_fields(work)
    work.canvas.dim(ground.light)
    return work.canvas.drawn()


def _busiest(labels: NDArray[np.uint8], block: tuple[int, int]) -> tuple[slice, slice]:
    """Where a block's classes have most entropy; of equal ones the first."""
    best, found = -1.0, (slice(0, block[0]), slice(0, block[1]))
    for top in range(0, labels.shape[0] - block[0] + 1, LATTICE_PX):
        for left in range(0, labels.shape[1] - block[1] + 1, LATTICE_PX):
            place = slice(top, top + block[0]), slice(left, left + block[1])
            share = np.bincount(labels[place].ravel(), minlength=len(CLASSES)) / (block[0] * block[1])
            entropy = -float((share[share > 0] * np.log(share[share > 0])).sum())
            if entropy > best:
                best, found = entropy, place
    return found

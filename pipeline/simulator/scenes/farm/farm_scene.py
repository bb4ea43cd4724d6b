"""The built-in farm through the year: one seed is one land, which looks as day and hour make it.

Law ``farm@2``. One pixel is about 12 cm of a trial farm; sizes are in px, U(a, b) is uniform, LN(s) log-normal of sigma
s about 1. Every part draws from its own stream of the seed. What is drawn, and where its laws stand:

* Land (``land``): a rectangle 80 px larger than the scene (and at least 640 x 640) is split along two directions
  (turned by U(-0.6, 0.6) rad, each cut up to 0.12 rad off) at 0.36-0.64 of its length, until a parcel has less than
  95 000 U(1.15, 1.9) px. Uses go by ``USE_SHARES`` blurred by LN(0.25), the largest parcel to the use that lacks most,
  each use at least once where there are enough parcels; lines between parcels by ``BORDER_SHARES``, likewise.
* ``farm_plan``: heading and period of each field's rows, tramlines, weeds, lodging.
* ``seasons``: calendars, cover, stages, lodging, weeds' growth, leaves of trees, water in the soil, the sun's place.
* ``spectra``: materials at their stages, the soil line.
* ``fields``, ``weeds``, ``borders``: the painting. Shadows fall away from the sun, cot(elevation) long. ``wheat_b`` is
  ``wheat_a`` but for 690-740 nm, and 0.80 of a pixel's wheat (sd 0.17 from pixel to pixel, 0.05 over 55 px) has its own
  variety's red edge, the rest the other's.
* Light: 0.95 with sd 0.03 (260 px wide), at most 1. What is missing from full light is the material shade, so that
  abundances stay non-negative and sum to 1.

A pixel's label is the class that covers most of it; harvested cereals and maize are stubble until they are tilled, a
crop that hardly covers the soil is soil. Edges are mixed by the share of the pixel that they cover.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.lazy import Once
from pipeline.simulator.scenes.farm.borders import dig_ponds, paint_borders, plant_trees
from pipeline.simulator.scenes.farm.canvas import CLASS_COLOURS, CLASSES, Canvas, Ground, Painting
from pipeline.simulator.scenes.farm.farm_plan import FarmPlan, farm_plan
from pipeline.simulator.scenes.farm.fields import paint_fields
from pipeline.simulator.scenes.farm.land import stream
from pipeline.simulator.scenes.farm.spectra import PANEL_REFLECTANCE, band_centres, spectral_library
from pipeline.simulator.scenes.farm.weeds import plant_weeds
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, SceneRaster

# A law is what a seed is drawn by; it stands first in a scene's key, and one that is out there never changes.
FARM_LAW, REMOVED_LAW = "farm@2", "farm@1"
FARM_NAMES = ("farm", FARM_LAW)
FARM_SHAPE = (1024, 1280)  # (y, x) unless another is asked for [px]
USUAL_DAY, USUAL_HOUR = 172, 11.0  # the 21st of June, an hour before noon


def refuse_removed(name: str) -> None:
    """Raise SettingsError where a name is that of the farm that is drawn no more."""
    if name == REMOVED_LAW:
        raise SettingsError(
            f"the built-in scene {REMOVED_LAW} was removed: take farm ({FARM_LAW}), which is another land; runs of "
            f"{REMOVED_LAW} can still be listed, verified, reported and exported, but not surveyed or judged again"
        )


def law_of_key(key: str) -> str | None:
    """Give the law that a farm with this key was drawn by, the removed one too; None of any other scene."""
    law = key.partition("/")[0]
    return law if law in (REMOVED_LAW, FARM_LAW) else None


def farm_scene(
    seed: int,
    shape: tuple[int, int] = FARM_SHAPE,
    bands: int = 270,
    camera: LineCamera | None = None,
    *,
    day: int | None = None,
    hour: float | None = None,
) -> RasterScene:
    """Give a farm on a day: equal arguments give the same scene, bit for bit. It is drawn when first looked at.

    Parameters
    ----------
    seed
        Not negative. Another day of the same seed and shape is the same land.
    shape
        (y, x), any size from 1 x 1. The land is drawn for the size: a larger scene is another farm. [px]
    bands
        Equally spaced from 400 to 1000 nm, at least 2.
    camera
        Its full well sets the electrons; ``LineCamera()`` unless given.
    day
        Of the year, 1 to 366; by default 172.
    hour
        True solar time, the sun in the south at 12; by default 11. [h]

    Returns
    -------
    Planes are abundances of ``farm_plan(...).materials``; scene values are reflectance; every pixel is labelled.

    Raises
    ------
    SceneError : a negative seed, an empty shape, a day that is not 1 to 366, the sun below 5 degrees.
    WavelengthError : fewer than 2 bands.
    """
    plan = farm_plan(seed, shape, day=USUAL_DAY if day is None else day, hour=USUAL_HOUR if hour is None else hour)
    seen_by, size = camera or LineCamera(), f"{shape[0]}x{shape[1]}"
    wavelength, fwhm = band_centres(bands)

    def light() -> SceneLight:
        library = spectral_library(bands, plan.materials)
        return SceneLight(library.electrons(seen_by), library.panel_electrons(seen_by))

    return RasterScene(
        name="farm",
        key=(
            f"{FARM_LAW}/seed={seed}/day={plan.day}/shape={size}/hour={plan.hour:g}/bands={bands}"
            f"/full_well={seen_by.full_well_e:g}"
        ),
        raster=SceneRaster((*shape, len(plan.materials)), labelled=True, draw=lambda: _draw(plan)),
        light=Once(light),
        panel=np.full(bands, PANEL_REFLECTANCE, np.float32),
        wavelength_nm=wavelength,
        fwhm_nm=fwhm,
        class_names=CLASSES,
        class_colours=CLASS_COLOURS.copy(),
    )


def _draw(plan: FarmPlan) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Abundances (y, x, material) and labels (y, x)."""
    ground = Ground.draw(stream(plan.seed, "ground"), plan.shape)
    work = Painting(plan, ground, Canvas(plan.shape, plan.materials))
    paint_fields(work)
    plant_weeds(work)
    paint_borders(work)
    dig_ponds(work)
    plant_trees(work)
    work.canvas.dim(ground.light)
    return work.canvas.drawn()

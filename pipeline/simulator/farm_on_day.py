"""The farm through the year: one seed is one land, which looks as the day of the year and the sun's hour make it.

Law ``farm@2``. One pixel is about 12 cm; the land is divided as in ``farm@1``, with the same classes and colours. What
is drawn and where its laws stand:

* ``farm_plan``: parcels, use, rows' heading and period of each field, tramlines, weeds, lodging, lines between parcels.
* ``farm_seasons``: calendars, cover, stages, lodging, weeds' growth, leaves of trees, water in the soil.
* ``farm_sun``: the sun's place, shadows of crowns and rows. Shadows fall away from the sun, cot(elevation) long.
* ``season_spectra``: spectra of stages, the soil line.
* ``season_rows``, ``season_fields``, ``season_weeds``, ``season_borders``: the painting.

Light over the farm varies as in ``farm@1``: 0.95 with sd 0.03, 260 px wide. A pixel's label is the class that covers
most of it; harvested cereals and maize are stubble until they are tilled, a crop that hardly covers the soil is soil.
Edges are mixed by the share of the pixel that they cover.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.lazy import Once
from pipeline.simulator.farm import CLASS_COLOURS
from pipeline.simulator.farm_fields import CLASSES, Ground
from pipeline.simulator.farm_laws import SEASON_LAW, USUAL_DAY, USUAL_HOUR
from pipeline.simulator.farm_layout import stream
from pipeline.simulator.farm_plan import FarmPlan, farm_plan
from pipeline.simulator.raster import Light, Raster
from pipeline.simulator.scene import RasterScene
from pipeline.simulator.season_borders import dig_ponds, paint_borders, plant_trees
from pipeline.simulator.season_canvas import SeasonCanvas, Work
from pipeline.simulator.season_fields import paint_fields
from pipeline.simulator.season_spectra import season_library
from pipeline.simulator.season_weeds import plant_weeds
from pipeline.simulator.spectra import PANEL_REFLECTANCE, band_centres


def farm_on_day(
    seed: int,
    shape: tuple[int, int] = (1024, 1280),
    bands: int = 270,
    camera: LineCamera | None = None,
    *,
    day: int = USUAL_DAY,
    hour: float = USUAL_HOUR,
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
        Of the year, 1 to 366.
    hour
        True solar time, the sun in the south at 12. [h]

    Returns
    -------
    Planes are abundances of ``farm_plan(...).materials``; scene values are reflectance; every pixel is labelled.

    Raises
    ------
    SceneError : a negative seed, an empty shape, a day that is not 1 to 366, the sun below 5 degrees.
    WavelengthError : fewer than 2 bands.
    """
    plan = farm_plan(seed, shape, day=day, hour=hour)
    seen_by = camera or LineCamera()
    wavelength, fwhm = band_centres(bands)
    size = f"{shape[0]}x{shape[1]}"
    return RasterScene(
        name="farm",
        key=(
            f"{SEASON_LAW}/seed={seed}/day={day}/shape={size}/hour={hour:g}/bands={bands}"
            f"/full_well={seen_by.full_well_e:g}"
        ),
        raster=Raster((*shape, len(plan.materials)), labelled=True, draw=lambda: draw_plan(plan)),
        light=Once(lambda: _light(bands, plan.materials, seen_by)),
        panel=np.full(bands, PANEL_REFLECTANCE, np.float32),
        wavelength_nm=wavelength,
        fwhm_nm=fwhm,
        class_names=CLASSES,
        class_colours=CLASS_COLOURS.copy(),
    )


def draw_plan(plan: FarmPlan) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Draw abundances (y, x, material) and labels (y, x) of a plan."""
    ground = Ground.draw(stream(plan.seed, "ground"), plan.shape)
    work = Work(plan, ground, SeasonCanvas(plan.shape, plan.materials))
    paint_fields(work)
    plant_weeds(work)
    paint_borders(work)
    dig_ponds(work)
    plant_trees(work)
    work.canvas.dim(ground.light)
    return work.canvas.drawn()


def _light(bands: int, materials: tuple[str, ...], camera: LineCamera) -> Light:
    """What the camera makes of each material and of the white panel."""
    library = season_library(bands, materials)
    return Light(library.electrons(camera), library.panel_electrons(camera))

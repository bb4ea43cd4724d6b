"""The built-in farm through the year: one seed is one land, which looks as day and hour make it.

Law ``farm@2``. One pixel is about 12 cm of a trial farm; sizes are in px. U(a, b) is uniform, LN(s) log-normal of sigma
s about 1. Every part draws from its own stream of the seed. Parts, and the modules of their laws:

* Land (``land``): a rectangle 80 px larger than the scene (and at least 640 x 640) is split along two directions. They
  are turned by U(-0.6, 0.6) rad; each cut is up to 0.12 rad off, at 0.36-0.64 of the length. It ends where a parcel has
  less than 95 000 U(1.15, 1.9) px. Uses go by ``USE_FRACTIONS`` blurred by LN(0.25): the largest parcel to the use that
  lacks most. Each use comes at least once where there are enough parcels. Lines between parcels go by
  ``BORDER_FRACTIONS``, likewise.
* ``farm_plan``: heading and period of each field's rows, tramlines, weeds, lodging.
* ``land``: calendars, cover, stages, lodging, weeds' growth, leaves of trees, water in the soil, the sun's place.
* ``spectra``: materials at their stages, the soil line.
* ``fields``: the painting. Shadows fall away from the sun, cot(elevation) long. ``wheat_b`` is
  ``wheat_a`` but for 690-740 nm. A fraction of 0.80 of a pixel's wheat has its own variety's red edge, the rest the
  other's. It varies by 0.17 (sd) from pixel to pixel, by 0.05 over 55 px.
* Light: 0.95 with sd 0.03 (260 px wide), at most 1. The material shade stands for light that is missing, so that
  abundances stay non-negative and sum to 1.

A pixel's label is the class that covers most of it. Harvested cereals and maize are stubble until they are tilled; a
crop that hardly covers the soil is soil. Edges are mixed by the fraction of the pixel that they cover.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import cuts
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.simulator.scenes.farm import land
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASS_COLOURS, CLASSES, FarmPlan, Painting, farm_plan
from spectralzoom.pipeline.simulator.scenes.farm.fields import paint_fields, plant_weeds
from spectralzoom.pipeline.simulator.scenes.farm.land import Points, Sun
from spectralzoom.pipeline.simulator.scenes.farm.spectra import (
    WHITE_REFERENCE_REFLECTANCE,
    band_centres,
    spectral_library,
)
from spectralzoom.pipeline.simulator.scenes.laws import FARM_LAW, FARM_PIXEL_M, FARM_SHAPE, USUAL_DAY, USUAL_HOUR
from spectralzoom.pipeline.simulator.scenes.scene import Drawn, RasterScene, SceneRadiance, SceneRaster, scratch

WIDTHS = {"margin": (2.0, 4.5), "hedge": (4.5, 6.5), "ditch": (1.3, 2.2), "road": (3.0, 5.0)}  # half, px
BANKS = {"margin": (0.0, 0.0), "hedge": (0.0, 0.0), "ditch": (2.5, 4.5), "road": (1.0, 2.5)}
BARE_CROWN = 0.62  # cover of a crown without leaves
SHADOW = 0.78  # of the ground under a crown's shadow that no direct sun reaches


def farm_scene(
    seed: int,
    shape: tuple[int, int] = FARM_SHAPE,
    bands: int = 270,
    camera: LineCamera | None = None,
    *,
    day: int | None = None,
    hour: float | None = None,
) -> RasterScene:
    """Return a farm on a day: equal arguments give the same scene, bit for bit. It is drawn when first looked at.

    ``seed`` is not negative; another day of the same seed and shape is the same land. ``shape`` (y, x) is any from 1 x
    1 [px], ``bands`` equally spaced from 400 to 1000 nm, at least 2. The camera's full well sets the electrons. ``day``
    is of the year, 1 to 366, ``hour`` true solar time, the sun in the south at 12 [h]. Planes are abundances of
    ``farm_plan(...).materials``; scene values are reflectance; every pixel is labelled.
    Raises SceneError: a negative seed, an empty shape, no such day, the sun below 5 degrees; WavelengthError: one band.
    """
    plan = farm_plan(seed, shape, day=USUAL_DAY if day is None else day, hour=USUAL_HOUR if hour is None else hour)
    return planned_scene("farm", FARM_LAW, plan, bands, camera or LineCamera(), lambda: _draw(plan))


def planned_scene(
    name: str, law: str, plan: FarmPlan, bands: int, camera: LineCamera, draw: Callable[[], Drawn], more: str = ""
) -> RasterScene:
    """Return the scene of a plan, in the farm's materials and classes; ``more`` stands in its key behind the hour.

    Raises WavelengthError: one band.
    """
    shape = plan.shape
    wavelength, fwhm = band_centres(bands)

    def light() -> SceneRadiance:
        library = spectral_library(bands, plan.materials)
        return SceneRadiance(library.electrons(camera), library.white_reference_electrons(camera))

    return RasterScene(
        name=name,
        key=(
            f"{law}/seed={plan.seed}/day={plan.day}/shape={shape[0]}x{shape[1]}/hour={plan.hour:g}{more}/bands={bands}"
            f"/full_well={camera.full_scale_e:g}"
        ),
        raster=SceneRaster((*shape, len(plan.materials)), labelled=True, draw=draw),
        light=Once(light),
        white_reference=np.full(bands, WHITE_REFERENCE_REFLECTANCE, np.float32),
        wavelength_nm=wavelength,
        fwhm_nm=fwhm,
        class_names=CLASSES,
        class_colours=CLASS_COLOURS.copy(),
        pixel_m=FARM_PIXEL_M,
    )


def _draw(plan: FarmPlan) -> Drawn:
    work = Painting.of(plan)
    paint_fields(work)
    plant_weeds(work)
    paint_borders(work)
    dig_ponds(work)
    plant_trees(work)
    return work.drawn()


def paint_borders(work: Painting) -> None:
    """Draw the lines between parcels, roads last."""
    order = ("margin", "hedge", "ditch", "road")
    for number, (border, kind) in sorted(enumerate(work.plan.borders), key=lambda one: order.index(one[1][1])):
        rng = land.stream(work.plan.seed, f"border {number}")
        band = land.band_pixels(border, 12.0, work.canvas.shape)
        phases = rng.uniform(0, 2 * np.pi, 2)
        bend = np.sin(band.along / 37 + phases[0]) + np.sin(band.along / 61 + phases[1])
        way = np.float32((0.8 if kind == "road" else 1.6) / 2)
        band = replace(band, across=band.across + way * bend.astype(np.float32))
        here = work.ground.at(band.index)
        half, bank = rng.uniform(*WIDTHS[kind]), rng.uniform(*BANKS[kind])
        dryness = rng.uniform(0.25, 0.55)
        swath, inner = rng.uniform() < 0.5, rng.uniform(0.8, 1.2)
        work.canvas.stripe(band, half + bank, here.grass(dryness), "grass")
        if kind == "ditch":
            full = half * (0.75 + 1.4 * work.plan.moisture)
            work.canvas.stripe(band, full, {"water": np.ones_like(band.across)}, "water")
        if kind == "road":
            stone = np.clip(0.75 + 0.08 * here.tuft + 0.05 * here.grain, 0, 1)  # trodden into dry soil
            ground = {"gravel": stone, "soil_dry": 0.85 * (1 - stone), "soil_wet": 0.15 * (1 - stone)}
            work.canvas.stripe(band, half, ground, "track")
            if swath:
                work.canvas.stripe(band, inner, here.grass(0.5), "grass")


def dig_ponds(work: Painting) -> None:
    """Paint ponds with grass round them, in meadows where there are any: one, and one more for every 650 000 px."""
    plan = work.plan
    shape = plan.shape
    rng = land.stream(plan.seed, "ponds")
    shore = land.smooth_noise(rng, shape, 14).ravel()
    meadows = [one.parcel for one in plan.fields if one.use == "grass"] or [one.parcel for one in plan.fields]
    ponds = []
    for _ in range(1 + shape[0] * shape[1] // 650_000):
        corners = meadows[rng.integers(len(meadows))].corners
        centre = corners.mean(axis=0) + 0.5 * (corners[rng.integers(len(corners))] - corners.mean(axis=0))
        radius = rng.uniform(14, 24)
        for index, _, _ in land.disc_pixels(centre[None], np.array([34.0]), shape):
            inside = radius + 1.8 * shore[index] - np.hypot(*(land.scene_points(index, shape) - centre).T)
            work.canvas.over(index, land.edge(inside + 4), work.ground.at(index).grass(0.15), "grass")
            ponds.append((index, land.edge(inside)))
    for index, cover in ponds:  # after every bank: two ponds may meet
        work.canvas.over(index, cover, {"water": np.ones_like(cover)}, "water")


def crowns_of(work: Painting) -> Points:
    """Return the crowns of hedges and of trees beside the lines: y, x and radius, (n, 3)."""
    plan = work.plan
    rng = land.stream(plan.seed, "trees")
    trees, hedges = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for number, (border, kind) in enumerate(plan.borders):
        count = rng.poisson(border.length / 320)
        aside = rng.choice([-1.0, 1.0], (count, 1)) * rng.uniform(7, 14, (count, 1)) * border.step[::-1] * [-1, 1]
        places = border.start + rng.uniform(0, border.length, (count, 1)) * border.step + aside
        trees.append(np.column_stack([places, rng.uniform(5, 12, count)]))
        if kind == "hedge":
            own = land.stream(plan.seed, f"hedge {number}")
            along = np.arange(0.0, border.length, 5.0)
            along = along[own.uniform(size=along.size) > 0.05]
            centres = border.start + along[:, None] * border.step + own.normal(0, 1.0, (along.size, 2))
            hedges.append(np.column_stack([centres, own.uniform(4, 7, along.size)]))
    return np.concatenate(trees + hedges)


def plant_trees(work: Painting) -> None:
    """Paint shadows away from the sun, then crowns that are darker on that side, in the leaves of the day."""
    plan = work.plan
    crowns = crowns_of(work)
    centres, radius = crowns[:, :2], crowns[:, 2]
    leaves = {name: fraction for name, fraction in land.foliage(plan.day).items() if fraction > 0}
    opaque = 1 - (1 - BARE_CROWN) * leaves.get("twigs", 0.0)
    shadow = crown_shadows(centres, radius, plan.sun, plan.shape)
    for rows in cuts(plan.shape[0], land.ROWS_AT_ONCE):
        dark = np.flatnonzero(shadow[rows]) + rows.start * plan.shape[1]
        depth = np.asarray(SHADOW * opaque * shadow.ravel()[dark], np.float32)
        work.canvas.over(dark, depth, {"shade": np.ones_like(depth)}, None)
    for index, cover, disc in land.disc_pixels(centres, radius, plan.shape):
        away = ((land.scene_points(index, plan.shape) - centres[disc]) / radius[disc, None]) @ plan.sun.cast
        away /= np.hypot(*plan.sun.cast)
        here = work.ground.at(index)
        shade = np.asarray(np.clip(0.18 + 0.18 * away + 0.08 * here.tuft + 0.05 * here.grain, 0, 0.6), np.float32)
        mixture = {name: fraction * (1 - shade) for name, fraction in leaves.items()}
        work.canvas.over(index, np.asarray(opaque * cover, np.float32), mixture | {"shade": shade}, "tree")


def crown_shadows(
    centres: Points, radius: NDArray[np.float64], sun: Sun, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Cover of the ground by shadows of ellipsoid crowns, (y, x) from 0 to 1.

    A crown is ``radius`` wide and 0.9 ``radius`` high each way about a point 1.2 ``radius`` above the ground. Its
    shadow is an ellipse; the darker one counts where shadows meet.
    """
    covered = scratch(shape)
    length = float(np.hypot(*sun.cast))
    along = sun.cast / length
    middles = centres + 1.2 * radius[:, None] * sun.cast + (np.array(shape) - 1) / 2
    for (y0, x0), width in zip(middles, radius, strict=True):
        reach = float(np.hypot(width, 0.9 * width * length))
        top, bottom = (int(np.clip(y0 + side * (reach + 1), 0, shape[0])) for side in (-1, 1))
        left, right = (int(np.clip(x0 + side * (reach + 1), 0, shape[1])) for side in (-1, 1))
        dy = (np.arange(top, bottom + 1) - y0)[: shape[0] - top, None]
        dx = (np.arange(left, right + 1) - x0)[None, : shape[1] - left]
        far = np.hypot((dy * along[0] + dx * along[1]) / reach, (dx * along[0] - dy * along[1]) / width)
        window = covered[top : top + dy.size, left : left + dx.size]
        np.maximum(window, np.clip((1 - far) * width + 0.5, 0, 1).astype(np.float32), out=window)
    return covered

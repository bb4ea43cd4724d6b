"""The trial: plots of crops with weeds and damage on a sixteenth of a meadow or of stubble.

Law ``trial@1``. Spectra, calendars, rows, weeds, classes and colours are the farm's; each part draws from its own
stream of the seed. U(a, b) is uniform, sizes are in px of 12 cm.

* Land: a meadow or old stubble, by the seed, with few weeds.
* Trial: a rectangle of a quarter of the scene's height and width, at U(0.1, 0.9) of the room that it leaves. Blocks of
  plots about 80 px long lie one above the other, plots about 24 px wide side by side. Alleys of mown grass, 5 px wide,
  lie between the blocks, and of bare soil, 2 px wide, between the plots.
* Plots: each block has the crops in an order of its own. Weeds are 1 to 60 in 1000 px, their logarithm uniform, gaps
  0.005 to 0.3 of the rows, likewise, and wheat lodges as on the farm. A plot is up to 6 days late.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.simulator.scenes.farm import farm_scene as farm
from spectralzoom.pipeline.simulator.scenes.farm import land
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import FarmPlan, FieldPlan, Painting, land_of, plan_field
from spectralzoom.pipeline.simulator.scenes.farm.fields import paint_fields, plant_weeds
from spectralzoom.pipeline.simulator.scenes.farm.land import Parcel
from spectralzoom.pipeline.simulator.scenes.laws import FARM_SHAPE, TRIAL_LAW, USUAL_DAY, USUAL_HOUR
from spectralzoom.pipeline.simulator.scenes.scene import Drawn, RasterScene

ROUND_ABOUT = ("grass", "stubble")
CROPS = ("maize", "sugar_beet", "wheat_a", "wheat_b")
TRIAL_SIDE = 1 / 4  # of the scene's height and width
PLOT_PX = (80.0, 24.0)  # length and width
ALLEY_PX = (5.0, 2.0)  # between blocks and between plots
WEEDS = (1.0, 60.0)  # plants per 1000 px of a plot
GAPS = (0.005, 0.3)  # fraction of the rows of a plot
WEEDS_AROUND = 0.05


def trial_scene(
    seed: int,
    shape: tuple[int, int] = FARM_SHAPE,
    bands: int = 270,
    camera: LineCamera | None = None,
    *,
    day: int | None = None,
    hour: float | None = None,
) -> RasterScene:
    """Return a field trial on a day; arguments, errors and what equal arguments give are those of `farm_scene`."""
    day, hour = USUAL_DAY if day is None else day, USUAL_HOUR if hour is None else hour
    plan = trial_plan(seed, shape, day=day, hour=hour)
    return farm.planned_scene("trial", TRIAL_LAW, plan, bands, camera or LineCamera(), lambda: _draw(plan))


def trial_plan(seed: int, shape: tuple[int, int] = FARM_SHAPE, *, day: int, hour: float) -> FarmPlan:
    """Plan the trial and the land about it; raises what `farm_plan` does."""
    whole = land_of(seed, shape)
    rng = land.stream(seed, "trial")
    about = plan_field(rng, whole, str(rng.choice(ROUND_ABOUT)))
    about = replace(about, headland_px=0.0, weeds=WEEDS_AROUND, tramlines=None)
    size = TRIAL_SIDE * np.array(shape)
    first = rng.uniform(0.1, 0.9, 2) * (shape - size) - np.array(shape) / 2
    above, middle, below = _strips(whole, 0, [first[0], first[0] + size[0]])
    left, trial, right = _strips(middle, 1, [first[1], first[1] + size[1]])
    fields = [replace(about, parcel=one) for one in (above, left, right, below)]
    blocks = list(_with_alleys(trial, 0, (first[0], first[0] + size[0])))
    for number, block in enumerate(blocks):
        if number % 2:
            fields.append(replace(plan_field(rng, block, "grass"), weeds=WEEDS_AROUND))
        else:
            fields += _plots(rng, list(_with_alleys(block, 1, (first[1], first[1] + size[1]))))
    return FarmPlan(seed, shape, day, hour, land.sun_over_farm(day, hour), tuple(fields), ())


def _strips(parcel: Parcel, axis: int, places: Sequence[float]) -> list[Parcel]:
    """Cut a parcel across an axis (0 is y) at ascending places."""
    strips = []
    for place in places:
        normal = (1.0, 0.0) if axis == 0 else (0.0, 1.0)
        low, parcel = (
            Parcel(land.clip_polygon(parcel.corners, cut), (*parcel.cuts, cut))
            for cut in ((-normal[0], -normal[1], -float(place)), (*normal, float(place)))
        )
        strips.append(low)
    return [*strips, parcel]


def _with_alleys(parcel: Parcel, axis: int, ends: tuple[float, float]) -> Iterator[Parcel]:
    """Divide a parcel across an axis into strips of about the size of plots, with alleys between them."""
    length, alley = ends[1] - ends[0], ALLEY_PX[axis]
    count = max(round((length + alley) / (PLOT_PX[axis] + alley)), 1)
    starts = ends[0] + np.arange(1, count) * (length + alley) / count
    yield from _strips(parcel, axis, np.column_stack([starts - alley, starts]).ravel().tolist())


def _plots(rng: np.random.Generator, strips: Sequence[Parcel]) -> list[FieldPlan]:
    """Plan the plots of a block, and the bare alleys between them."""
    plots = len(strips[::2])
    crops = rng.permutation(np.resize(CROPS, plots)).tolist()
    planned = []
    for number, parcel in enumerate(strips):
        field = plan_field(rng, parcel, "soil" if number % 2 else crops[number // 2])
        field = replace(field, tramlines=None, headland_px=0.0)
        if number % 2 == 0:
            weeds, gaps = (float(np.exp(rng.uniform(*np.log(ends)))) for ends in (WEEDS, GAPS))
            field = replace(field, weeds=weeds, gap_rate=gaps)
        planned.append(field)
    return planned


def _draw(plan: FarmPlan) -> Drawn:
    """Return abundances (y, x, material) and labels (y, x)."""
    work = Painting.of(plan)
    paint_fields(work)
    plant_weeds(work)
    return work.drawn()

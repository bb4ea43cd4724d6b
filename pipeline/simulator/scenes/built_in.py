"""The built-in scenes by name, and the scouted field: one crop with patches of weeds, bare soil, poor growth, lodging.

Law ``scouting@1``. Spectra, calendars, rows, weeds, classes and colours are the farm's; each part draws from its own
stream of the seed. U(a, b) is uniform, sizes are in px of 12 cm.

* Field: maize, sugar beet or winter wheat by the farm's calendar, row crops 8 to 14 days before it. Rows run in any
  direction, wheel marks in pairs along them. Outside of the patches weeds and gaps are few, and growth is even.
* Patches: the highest part of ``-d + 0.08 n``. Here d is the distance from a centre over the side of a square as large
  as the scene. The noise n has bumps 45 px wide. So patches lie together in one part of the field, as those of weeds
  do. They cover the share of the scene that is asked for, U(0.02, 0.10) by default, to a pixel.
* Kinds: in each place the one whose own noise (60 px) is highest. Bare ground and poor growth are labelled by what
  covers most of a pixel, lodged wheat is wheat. Weeds come up and wheat lodges on the farm's days, not before.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.simulator.scenes.farm import farm_scene as farm
from spectralzoom.pipeline.simulator.scenes.farm import land
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import FarmPlan, Painting, Tramlines, land_of, plan_field
from spectralzoom.pipeline.simulator.scenes.farm.fields import draw_weeds, field_weeds, paint_fields, plant_weeds
from spectralzoom.pipeline.simulator.scenes.farm.land import Field, Points
from spectralzoom.pipeline.simulator.scenes.laws import (
    FARM_LAW,
    FARM_SHAPE,
    LAWS,
    SCOUTING_LAW,
    TRIAL_LAW,
    USUAL_DAY,
    USUAL_HOUR,
)
from spectralzoom.pipeline.simulator.scenes.scene import Drawn, RasterScene
from spectralzoom.pipeline.simulator.scenes.trial import trial_scene

SCOUTED = ("maize", "sugar_beet", "wheat_a")
USUAL_INTEREST = (0.02, 0.10)  # share of the scene in patches, least and greatest
RAGGED = 0.08  # noise that patches follow, over the side of the scene
RAGGED_PX = 45.0  # how wide the bumps of that noise are
KIND_PX = 60.0
EDGE = 120.0  # by which a patch ends within about 3 px
KINDS = {"weeds": 0.5, "bare": 0.0, "poor": 0.0, "lodged": 0.3}  # what a kind has ahead of the others
EARLY = -11.0  # days by which row crops are behind the farm's: they close by the middle of June
DENSE = 350.0  # weeds of a patch per 1000 px
EVEN = 0.4  # vigour's sd over the farm's
POOR = 4.2  # by how much vigour is less in poor growth
LODGED = 0.5  # of a field in the end, at the middle of a patch's edge


def built_in_scene(name: str, seed: int, *args: Any, **moment: Any) -> RasterScene:
    """Draw the built-in scene of a name; arguments and errors are those of the function of its law."""
    make = {FARM_LAW: farm.farm_scene, SCOUTING_LAW: scouting_scene, TRIAL_LAW: trial_scene}[LAWS[name]]
    return make(seed, *args, **moment)


def scouting_scene(
    seed: int,
    shape: tuple[int, int] = FARM_SHAPE,
    bands: int = 270,
    camera: LineCamera | None = None,
    *,
    day: int | None = None,
    hour: float | None = None,
    interest: float | None = None,
) -> RasterScene:
    """Return a scouted field on a day: equal arguments give the same scene, bit for bit. It is drawn when needed.

    Arguments are those of `farm_scene`; ``interest`` is the share of the scene in patches, 0 to 1, by the seed if None.
    Another day of the same seed, shape and interest is the same land with the same patches. Raises SceneError: an
    interest that is not 0 to 1, and what `farm_scene` raises.
    """
    if interest is not None and not 0 <= interest <= 1:
        raise SceneError(f"the share of interest is from 0 to 1, got {interest:g}")
    day, hour = USUAL_DAY if day is None else day, USUAL_HOUR if hour is None else hour
    plan = scouting_plan(seed, shape, day=day, hour=hour)
    more = "" if interest is None else f"/interest={interest:g}"
    return farm.planned_scene(
        "scouting", SCOUTING_LAW, plan, bands, camera or LineCamera(), lambda: _draw(plan, interest), more
    )


def scouting_plan(seed: int, shape: tuple[int, int] = FARM_SHAPE, *, day: int, hour: float) -> FarmPlan:
    """Plan the field; raises what `farm_plan` does."""
    whole = land_of(seed, shape)
    rng = land.stream(seed, "scouted field")
    use = SCOUTED[rng.integers(len(SCOUTED))]
    field = replace(
        plan_field(rng, whole, use),
        row_angle_deg=float(rng.uniform(0, 180)),
        tramlines=Tramlines.draw(rng),
        late_days=float(rng.uniform(-3, 3)) + (0.0 if land.CROPS[use].lodging else EARLY),
        gap_rate=float(rng.uniform(0.001, 0.005)),
        weeds=float(rng.uniform(0.05, 0.2)),
        lodging=LODGED if land.CROPS[use].lodging else 0.0,
    )
    return FarmPlan(seed, shape, day, hour, land.sun_over_farm(day, hour), (field,), ())


def patches_of(plan: FarmPlan, interest: float | None = None) -> dict[str, Field]:
    """Cover of the scene by each kind of patch, (y, x) each, 0 to 1; the same on all days."""
    shape = plan.shape
    rng = land.stream(plan.seed, "patches")
    drawn = rng.uniform(*USUAL_INTEREST)
    side = float(np.sqrt(shape[0] * shape[1]))
    y, x = np.ogrid[: shape[0], : shape[1]]
    centre = rng.uniform(0.2, 0.8, 2) * shape
    score = RAGGED * land.smooth_noise(rng, shape, RAGGED_PX) - np.hypot(y - centre[0], x - centre[1]) / side
    least = np.quantile(score, 1 - (drawn if interest is None else interest))
    cover = np.asarray(np.clip(EDGE * (score - least) + 0.5, 0, 1), np.float32)
    cover *= np.float32(interest != 0)
    kinds = {name: ahead for name, ahead in KINDS.items() if name != "lodged" or plan.fields[0].lodging}
    streams = [land.stream(plan.seed, f"patches {name}") for name in kinds]
    noise = [ahead + land.smooth_noise(one, shape, KIND_PX) for one, ahead in zip(streams, kinds.values(), strict=True)]
    kind = np.argmax(noise, axis=0)
    return {name: np.where(kind == number, cover, np.float32(0)) for number, name in enumerate(kinds)}


def _draw(plan: FarmPlan, interest: float | None) -> Drawn:
    """Return abundances (y, x, material) and labels (y, x)."""
    patches = patches_of(plan, interest)
    work = Painting.of(plan)
    work = replace(work, ground=replace(work.ground, vigour=EVEN * work.ground.vigour - POOR * patches["poor"]))
    paint_fields(work, 6 * patches["lodged"] - 3 if "lodged" in patches else None)
    plant_weeds(work)
    bare = np.flatnonzero(patches["bare"])
    soil = plan.soil(work.ground.at(bare), plan.fields[0].wetter)
    work.canvas.over(bare, patches["bare"].ravel()[bare], soil, "soil")
    draw_weeds(work, _weeds_within(plan, patches["weeds"]))
    return work.drawn()


def _weeds_within(plan: FarmPlan, cover: Field) -> dict[str, Points]:
    """Return weeds that grow densely under a cover: y, x and radius (n, 3) by spectrum."""
    if not cover.any():
        return {}
    middle = (np.array(cover.shape) - 1) / 2
    there = np.argwhere(cover)
    (top, left), (bottom, right) = there.min(axis=0) - middle - 1, there.max(axis=0) - middle + 1
    box = land.Parcel(np.array([[top, left], [top, right], [bottom, right], [bottom, left]]))
    rng = land.stream(plan.seed, "weeds of patches")
    kept: dict[str, Points] = {}
    for name, plants in field_weeds(rng, replace(plan.fields[0], parcel=box, weeds=DENSE), plan.day).items():
        y, x = np.clip(np.rint(plants[:, :2] + middle), 0, np.array(cover.shape) - 1).astype(int).T
        kept[name] = plants[rng.uniform(size=len(plants)) < cover[y, x]]
    return kept

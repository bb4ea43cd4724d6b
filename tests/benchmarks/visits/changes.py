"""Changes planted into a farm that a later look should tell of, and light that changed where nothing else did."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from measure import Row
from numpy.typing import NDArray
from visits.farm_visits import (
    ANEW,
    CAMERA,
    FIRST_DAY,
    HOUR,
    QUICK,
    SEEDS,
    SHAPE,
    Mask,
    later,
    seen_by,
    shipped,
    view_farm,
)

from models.reading.prior_map import PriorMap, changed_fractions, changed_from, first_probabilities
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene, SceneRaster

CHANGED_FRACTION = 0.25  # of a patch's pixels, from which the patch counts as changed
PLANTED, PLANTED_SEEDS = 3, range(1, 10)  # changes of each kind on each land, and the lands
LOW_SUN, HIGH_SUN = 6.2, 12.0  # hours of June 21 at which the sun stands at 20 and 61 degrees


def planted_changes() -> Iterator[Row]:
    """Weed nests, tracks, stubble strips and flooded corners that are there three days later, and false alarms."""
    names, patch = shipped().class_names, shipped().config.patch
    hits: dict[str, list[bool]] = {}
    false, unchanged = 0, 0
    for seed in PLANTED_SEEDS:
        before = view_farm(seed, FIRST_DAY, HOUR, ANEW)
        scene = farm_scene(seed, SHAPE, camera=CAMERA, day=FIRST_DAY + 3, hour=14.0)
        changed, places = plant(scene, np.random.default_rng(seed), names)
        now = seen_by(changed, seed, QUICK)
        first = first_probabilities(before.observation)
        after = later(before, first, now, 3.0)
        told = changed_fractions(changed_from(PriorMap(first, None, 3.0), after), patch) >= CHANGED_FRACTION
        for kind, place in places:
            covered = _fractions(place, patch) >= 0.5
            hits.setdefault(kind, []).append(bool((told & covered).any()))
        same = _fractions(before.labels != now.labels, patch) == 0
        false, unchanged = false + int((told & same).sum()), unchanged + int(same.sum())
    for kind, found in hits.items():
        fraction = float(np.mean(found))
        yield Row(f"planted: {kind}", f"{sum(found)} of {len(found)} found", ">= 95 %", fraction >= 0.95)
    fraction = false / unchanged
    yield Row("places said to have changed that did not", f"{fraction:.2%} of {unchanged}", "<= 2 %", fraction <= 0.02)


def plant(
    scene: RasterScene, rng: np.random.Generator, names: Sequence[str]
) -> tuple[RasterScene, list[tuple[str, Mask]]]:
    """A scene with changes in places that do not touch, made of pixels that the scene has elsewhere, and the places."""
    assert scene.labels is not None
    planes, labels = scene.planes.copy(), scene.labels.copy()
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    shapes: dict[str, tuple[str, Callable[[float, float], Mask]]] = {
        "weed nest, 40 px across": ("weed", lambda cy, cx: (y - cy) ** 2 + (x - cx) ** 2 <= 20**2),
        "track, 16 x 120 px": ("track", lambda cy, cx: (abs(y - cy) <= 8) & (abs(x - cx) <= 60)),
        "bare strip, 24 x 120 px": ("soil", lambda cy, cx: (abs(y - cy) <= 12) & (abs(x - cx) <= 60)),
        "flooded corner, 60 px": ("water", lambda cy, cx: (y >= cy) & (x >= cx) & (y - cy + x - cx <= 60)),
    }
    taken, places = np.zeros(SHAPE, np.bool_), []
    for kind, (name, at) in shapes.items():
        donors = np.argwhere(scene.labels == names.index(name))
        count = 0
        while count < PLANTED:
            place = at(rng.uniform(30, SHAPE[0] - 70), rng.uniform(70, SHAPE[1] - 70))
            own = scene.labels[place] == names.index(name)
            if (taken & place).any() or own.mean() > 0.05:
                continue
            chosen = donors[rng.integers(len(donors), size=int(place.sum()))]
            planes[place], labels[place] = scene.planes[chosen[:, 0], chosen[:, 1]], names.index(name)
            taken |= place
            places.append((kind, place))
            count += 1
    return replace(scene, key=f"{scene.key}/planted", raster=SceneRaster.of(planes, labels)), places


def other_light() -> Iterator[Row]:
    """Places said to have changed in half a day between a low sun and a high one, when nothing did."""
    patch = shipped().config.patch
    for early, late in ((LOW_SUN, HIGH_SUN), (HIGH_SUN, LOW_SUN)):
        false, all_patches = 0, 0
        for seed in SEEDS:
            before, now = view_farm(seed, FIRST_DAY, early, ANEW), view_farm(seed, FIRST_DAY, late, QUICK, 1)
            first = first_probabilities(before.observation)
            after = later(before, first, now, abs(late - early) / 24)
            told = changed_fractions(changed_from(PriorMap(first, None, 0.3), after), patch) >= CHANGED_FRACTION
            same = _fractions(before.labels != now.labels, patch) == 0
            false, all_patches = false + int((told & same).sum()), all_patches + int(same.sum())
        fraction = false / all_patches
        what = f"places said to have changed, nothing did, sun at {early:g} h then {late:g} h"
        yield Row(what, f"{fraction:.2%} of {all_patches}", "<= 2 %", fraction <= 0.02)


def _fractions(where: Mask, patch: int) -> NDArray[np.float64]:
    y, x = where.shape
    fractions: NDArray[np.float64] = where.reshape(y // patch, patch, x // patch, patch).mean(axis=(1, 3))
    return fractions

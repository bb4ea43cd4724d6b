"""Memories that are none of the field: of another, moved, turned or old; and a look that is half under a cloud."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from measure import Row
from numpy.typing import NDArray
from scipy.ndimage import rotate
from visits.farm_visits import (
    ANEW,
    CAMERA,
    FIRST_DAY,
    HOUR,
    QUICK,
    SHAPE,
    Classes,
    Seen,
    look_at_farm,
    seen_by,
    shipped,
    shipped_memory,
)

from flows.tasks.field_memory import REACH_PX, whole_pixels
from flows.tasks.stages.maps import MOST_TURN_PX
from models.reading.remembered import Looked, Remembered, compare, first_belief, recall
from pipeline.rectify.registration.alignment import field_shift
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import SceneRaster

SEEDS = (7, 8, 9)  # lands on which nothing was settled
WORSE = 0.5  # points that a map may lose by a memory that is wrong


def wrong_memories() -> Iterator[Row]:
    """Maps that go on from a memory of another land, moved, turned, or old; and a quick look in part under a cloud."""
    found: dict[str, list[tuple[float, float]]] = {}
    for seed in SEEDS:
        before, other = (look_at_farm(one, FIRST_DAY, HOUR, ANEW) for one in (seed, seed + 10))
        old = look_at_farm(seed, FIRST_DAY - 75, HOUR, ANEW)
        now = look_at_farm(seed, FIRST_DAY + 3, HOUR, QUICK, 1)
        scene = farm_scene(seed, SHAPE, camera=CAMERA, day=FIRST_DAY + 3, hour=HOUR)
        dim = scene.planes.copy()
        dim[:, : SHAPE[1] // 2] *= 0.4
        clouded = replace(scene, key=f"{scene.key}/cloud", raster=SceneRaster.of(dim, scene.labels))
        shaded = seen_by(clouded, seed, QUICK)
        cases = {
            "of another land": (other.looked, now, 3.0),
            "moved by 20 px": (_moved(before.looked), now, 3.0),
            "turned by 5 degrees": (_turned(before.looked), now, 3.0),
            "75 days old": (old.looked, now, 78.0),
            "right, under a cloud over half of the field": (before.looked, shaded, 3.0),
        }
        for name, (looked, today, days) in cases.items():
            classes = _with_any_memory(looked, today, days)
            found.setdefault(name, []).append((today.score(classes), today.score(today.alone)))
    for name, scores in found.items():
        least = float(np.min([score - alone for score, alone in scores]))
        figure = " ".join(f"{score:.1f} for {alone:.1f}" for score, alone in scores)
        yield Row(f"memory {name}: with it for without", figure, f">= -{WORSE} each", least >= -WORSE)


def _with_any_memory(looked: Looked, today: Seen, days: float) -> Classes:
    """The map of a look after one that may be of anything: laid onto today's as surveys do it, or put aside."""
    factor = SHAPE[0] // looked.coarse.shape[0]
    lies = field_shift(_broad(today.looked), _broad(looked), reach_px=REACH_PX / factor)
    if factor * lies.edge_px(looked.coarse.shape) > MOST_TURN_PX:
        return today.alone
    shift = whole_pixels(replace(lies, shift=(factor * lies.shift[0], factor * lies.shift[1])))
    there = _moved(looked, shift)
    memory = Remembered(first_belief(there), there.coarse, days)
    after = recall(memory, today.looked, shipped_memory())
    other = compare(memory, today.looked, after, np.s_[:, :]).is_of_another_field
    return today.alone if other else after.classes()[0]


def _broad(looked: Looked) -> NDArray[np.floating]:
    """The mean of a coarse look's columns in scene values."""
    known = shipped().normalisation
    values: NDArray[np.floating] = looked.coarse @ np.linalg.inv(known.whitening) * known.spread + known.centre
    return values.mean(axis=-1)


def _moved(looked: Looked, by: tuple[int, int] = (20, 20)) -> Looked:
    """A look as it lies beside by so many px down and to the right."""
    cells = tuple(round(one * looked.coarse.shape[0] / SHAPE[0]) for one in by)
    images = ((looked.log_probability, by), (looked.coarse, cells))
    values, coarse = (np.roll(image, far, axis=(0, 1)) for image, far in images)
    return replace(looked, log_probability=values, coarse=coarse)


def _turned(looked: Looked) -> Looked:
    """A look as it lies turned."""
    values, coarse = (
        rotate(image, 5.0, reshape=False, order=0, mode="nearest") for image in (looked.log_probability, looked.coarse)
    )
    return replace(looked, log_probability=values, coarse=coarse)

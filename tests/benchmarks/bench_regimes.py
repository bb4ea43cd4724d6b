"""Where zooming pays: lines captured again where they promise most, beside the best uniform scan of the same seconds.

A land is a rectangle of a farm in a meadow; the rectangle's share of the field is what a survey is after.
Light is a fraction of a clear sky's. Seconds are those of the full scan's lines in three exposures, and set-ups.
Three ways in the same seconds: the best uniform scan; every 4th or 8th line first and then what the planner chooses;
and the same with the rectangle's patches known (ideal), in the exposure that shows all of them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
from measure import Row
from numpy.typing import NDArray
from rich.console import Console

from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from flows.tasks import scene as scenes
from pipeline.geometry.grid import patch_pixels
from pipeline.planning.fine_pass import FinePlan, SecondPass
from pipeline.simulator.scenes.farm.farm_plan import CLASSES
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.farm.land import smooth_noise, stream
from pipeline.simulator.scenes.scene import Drawn, RasterScene, SceneRaster

SEEDS, SIZE = (61, 62, 63), "640x512"
LIGHTS, SHARES = (1.0, 0.25, 0.0625), (1.0, 0.25, 0.125, 0.0625)
EXPOSURES_MS = (1.0, 2.5, 6.0)  # of every line, by which seconds are stated
LINES, SETUP_S = 515, 3.0  # of the full scan of a field of that size
WAYS = ("never", "always", "ideal")
GOALS = {1.0: -0.3, 0.25: -0.3, 0.125: 1.5, 0.0625: 3.0}  # points over the uniform scan, in the mean of a share's cells


def land(seed: int, shape: tuple[int, int], share: float, **given: Any) -> tuple[RasterScene, NDArray[np.bool_]]:
    """Return a farm whose rectangle of a share lies in a meadow, and which pixels (y, x) are the rectangle's."""
    farm, inside = farm_scene(seed, shape, **given), np.ones(shape, np.bool_)
    if share < 1:
        inside[...] = False
        side, rng = np.sqrt(share), stream(seed, "rectangle")
        size = [max(round(side * whole), 1) for whole in shape]
        top, left = (int(rng.integers(0, whole - part + 1)) for whole, part in zip(shape, size, strict=True))
        inside[top : top + size[0], left : left + size[1]] = True

    def draw() -> Drawn:
        planes, labels = farm.raster.drawn()
        meadow = CLASSES.index("grass")
        outside = planes[labels == meadow].mean(axis=0) if (labels == meadow).any() else planes.mean(axis=(0, 1))
        light = 1 - 0.03 * np.abs(smooth_noise(stream(seed, "meadow"), shape, 80.0))
        around = outside * light[..., None].astype(np.float32)
        kept = np.where(inside[..., None], planes, around).astype(np.float32)
        return kept, np.where(inside, labels, meadow).astype(np.uint8)

    raster = SceneRaster((*shape, farm.raster.shape[2]), labelled=True, draw=draw)
    return replace(farm, raster=raster, key=f"{farm.key}/rectangle={share:g}"), inside


@contextmanager
def known(inside: NDArray[np.bool_]) -> Iterator[None]:
    """Have later lines follow the pixels that a survey is after, in the longest exposure that shows all of them."""

    def best(self: SecondPass, record: Any, gain_of: Any) -> FinePlan:
        gain = patch_pixels(self.grid, inside.astype(np.float64)).mean(axis=(1, 2))
        plans = []
        for exposure_ms in np.geomspace(*record.offered_ms(self.camera), 12)[::-1].round(1).tolist():
            plans.append(self.plan(gain, exposure_ms=exposure_ms))
            if plans[-1].expected_gain >= 0.98 * gain.sum():
                return plans[-1]
        return max(plans, key=lambda plan: plan.expected_gain)

    with mock.patch.object(SecondPass, "best", best):
        yield


def score(seed: int, share: float, light: float, seconds: float, way: str) -> float:
    """Return the mIoU [%] of a survey of a land; NaN where its seconds pay for no scan of the record."""
    width, height = map(int, SIZE.split("x"))
    asked = {"scene": "farm", "seed": seed, "size": SIZE, "seconds": f"{seconds:.1f}", "engine": "plain"}
    asked |= {"zoom": "never" if way == "never" else "always", "sky.light_fraction": light}
    scene, inside = land(seed, (height, width), share)
    found, chosen = mock.patch.object(scenes, "built_in_scene", return_value=scene), nullcontext()
    with tempfile.TemporaryDirectory() as out, found, known(inside) if way == "ideal" else chosen:
        settings = load_settings(
            None, {name: str(one) for name, one in asked.items()} | {"controls": False, "out": out}
        )
        accuracy = run_survey(settings, Console(quiet=True)).receipt["accuracy"]
    return 100 * float(accuracy["miou"])


def cells(seeds: Sequence[int] = SEEDS) -> Iterator[tuple[float, float, float, dict[str, list[float]]]]:
    """Yield light, share, seconds and the scores of every way, a seed each."""
    for light in LIGHTS:
        for share in SHARES:
            for exposure_ms in EXPOSURES_MS:
                seconds = SETUP_S + LINES * exposure_ms * 1e-3 / light
                yield (
                    light,
                    share,
                    seconds,
                    {way: [score(seed, share, light, seconds, way) for seed in seeds] for way in WAYS},
                )


def rows() -> list[Row]:
    """Return a row for every cell, and the means of each share beside the goals."""
    found, gains = [], dict[float, list[float]]()
    for light, share, seconds, scores in cells():
        mean = {way: float(np.mean(one)) for way, one in scores.items()}
        gain = mean["always"] - mean["never"]
        gains.setdefault(share, []).append(gain)
        name = f"light {light:g}, share {share:g}, {seconds:.0f} s"
        peers = f"uniform {mean['never']:.1f}; ideal {mean['ideal'] - mean['never']:+.1f}"
        found.append(Row(name, f"{mean['always']:.1f} ({gain:+.1f})", "-0.3 or better", gain >= -0.3, peers))
        print(found[-1], flush=True)
    for share, each in gains.items():
        mean_gain = float(np.mean(each))
        found.append(
            Row(
                f"share {share:g}, mean of {len(each)} cells",
                f"{mean_gain:+.1f}",
                f"{GOALS[share]:+g}",
                mean_gain >= GOALS[share],
                "",
            )
        )
    return found

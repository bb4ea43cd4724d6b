"""Regimes in which zooming pays: lines captured again at the highest expected gain, against the best uniform scan.

A land is a rectangle of a farm in a meadow; the rectangle is the part of the field that the survey is interested in.
Light is a fraction of a clear sky's. Swaths are adjacent sweeps: a camera with fewer samples makes the field larger for
the mirror. Seconds are those of the full scan's lines at an exposure, with set-up times.
Three surveys use the same seconds. The first is the best uniform scan; the second (zoomed) takes every 4th or 8th line,
then the lines of highest expected gain. The third (ideal) knows the rectangle's patches, in the exposure that shows all
of them. The planner chooses the first or second before it sees the field.

`python tests/benchmarks/bench_regimes.py PICTURE` also draws the map of regimes.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from matplotlib.figure import Figure
from measure import Row
from numpy.typing import NDArray
from rich.console import Console

from spectralzoom.flows.opening import scene as scenes
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.geometry.grid import patch_pixels
from spectralzoom.pipeline.planning.fine_pass import FinePlan, SecondPass
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASSES
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import farm_scene
from spectralzoom.pipeline.simulator.scenes.farm.land import smooth_noise, stream
from spectralzoom.pipeline.simulator.scenes.scene import Drawn, RasterScene, SceneRaster

SEEDS = (61, 62, 63)
SIZE = "640x512"
LIGHTS = (1.0, 0.25)
SHARES = (1.0, 0.25, 0.125, 0.0625)
SWATHS = 8
EXPOSURES_MS = (1.25, 2.5, 5.0)  # exposure of every line in full light; seconds are stated by it
LINES = 515  # of one swath of the full scan
SETUP_S = 2.0  # of one swath
WAYS = ("never", "always", "ideal")
PLANNER = "auto"
GOALS = {1.0: -0.3, 0.25: -0.3, 0.125: 1.5, 0.0625: 3.0}  # points over the uniform scan, mean over a fraction's cells


@dataclass(frozen=True)
class Cell:
    """A regime with the mIoU [%] of each survey by seed, and the planner's decision to zoom."""

    light: float
    share: float
    seconds: float
    scores: dict[str, list[float]]
    zooms: bool

    def gain(self, way: str) -> float:
        """Return the mean gain over the uniform scan [points]."""
        way = way if way != PLANNER else "always" if self.zooms else "never"
        return float(np.mean(self.scores[way]) - np.mean(self.scores["never"]))

    @property
    def missed(self) -> float:
        """Return the points by which the planner is below the better of both scans."""
        return max(0.0, self.gain("always")) - self.gain(PLANNER)


def land(seed: int, shape: tuple[int, int], share: float, **given: Any) -> tuple[RasterScene, NDArray[np.bool_]]:
    """Return a farm whose rectangle lies in a meadow, and the mask (y, x) of the rectangle's pixels."""
    farm = farm_scene(seed, shape, **given)
    inside = np.ones(shape, np.bool_)
    if share < 1:
        inside[...] = False
        side = np.sqrt(share)
        rng = stream(seed, "rectangle")
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
    """Make fine passes follow the rectangle's pixels, in the longest exposure that shows all of them."""

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


def asked(seed: int, light: float, swaths: int, seconds: float, zoom: str, out: str) -> Settings:
    """Return the settings of a survey."""
    flags = {"scene": "farm", "seed": seed, "size": SIZE, "seconds": f"{seconds:.1f}", "engine": "plain", "zoom": zoom}
    flags |= {"sky.light_fraction": light, "camera.samples": int(SIZE.split("x")[0]) // swaths}
    return load_settings(None, {name: str(one) for name, one in flags.items()} | {"out": out})


def score(seed: int, share: float, light: float, swaths: int, seconds: float, way: str) -> float:
    """Return the mIoU [%] of a survey of a land."""
    width, height = map(int, SIZE.split("x"))
    scene, inside = land(seed, (height, width), share)
    found = mock.patch.object(scenes, "built_in_scene", return_value=scene)
    with tempfile.TemporaryDirectory() as out, found, known(inside) if way == "ideal" else nullcontext():
        settings = asked(seed, light, swaths, seconds, "never" if way == "never" else "always", out)
        return 100 * float(run_survey(settings, Console(quiet=True)).receipt["accuracy"]["miou"])


def cells(seeds: Sequence[int] = SEEDS) -> Iterator[Cell]:
    """Yield every regime with its scores."""
    for light, exposure_ms, share in itertools.product(LIGHTS, EXPOSURES_MS, SHARES):
        seconds = 1 + SWATHS * (SETUP_S + LINES * exposure_ms * 1e-3 / light)
        scores = {way: [score(seed, share, light, SWATHS, seconds, way) for seed in seeds] for way in WAYS}
        with tempfile.TemporaryDirectory() as out:  # the planner's decision does not depend on the land
            plan = plan_survey(open_field(asked(0, light, SWATHS, seconds, PLANNER, out), planning=True))
        yield Cell(light, share, seconds, scores, plan.settings.zooms)


def rows(picture: Path | None = None) -> list[Row]:
    """Return a row for every cell, and the mean of each fraction with its goal."""
    found = []
    measured: list[Cell] = []
    for cell in cells():
        measured.append(cell)
        mean = {way: float(np.mean(one)) for way, one in cell.scores.items()}
        name = f"light {cell.light:g}, share {cell.share:g}, {cell.seconds:.0f} s"
        gain = cell.gain(PLANNER)
        peers = f"uniform {mean['never']:.1f}; zoomed {cell.gain('always'):+.1f}; ideal {cell.gain('ideal'):+.1f}"
        found.append(Row(name, f"{mean['never'] + gain:.1f} ({gain:+.1f})", "-0.3 or better", gain >= -0.3, peers))
        print(found[-1], cell.scores, flush=True)
    for share in SHARES:
        each = [cell.gain(PLANNER) for cell in measured if cell.share == share]
        gain = float(np.mean(each))
        goal = GOALS[share]
        found.append(Row(f"share {share:g}, mean of {len(each)} cells", f"{gain:+.1f}", f"{goal:+g}", gain >= goal))
    missed = [cell.missed for cell in measured]
    close = np.mean(np.array(missed) <= 0.5)
    worst = max(missed)
    better = Row("planner within 0.5 of the better scan", f"{close:.0%} of the cells", ">= 90 %", close >= 0.9)
    found += [better, Row("planner below the better scan, at most", f"{worst:.1f}", "<= 1.5", worst <= 1.5)]
    if picture is not None:
        draw(measured, picture)
    return found


def draw(measured: Sequence[Cell], picture: Path) -> None:
    """Draw the gain over the best uniform scan for each survey, light, seconds, and fraction of interest."""
    ways = {PLANNER: "planner", "always": "zoomed", "ideal": "known place"}
    figure = Figure((10, 3), dpi=150, layout="constrained")
    shares = [str(Fraction(one)) for one in SHARES]
    budgets = list(dict.fromkeys(f"light {Fraction(cell.light)}, {cell.seconds:.0f} s" for cell in measured))
    panels = figure.subplots(1, len(ways), sharey=True)
    for axes, (way, name) in zip(panels, ways.items(), strict=True):
        gains = [cell.gain(way) for cell in measured]  # by light, seconds, then share
        image = axes.imshow(np.reshape(gains, (len(budgets), len(shares))), cmap="RdBu", vmin=-5, vmax=5, aspect="auto")
        axes.set_xticks(range(len(shares)), shares)
        axes.set_yticks(range(len(budgets)), budgets)
        axes.set_title(name)
        axes.set_xlabel("interesting fraction of the field")
        for place, gain in enumerate(gains):
            y, x = divmod(place, len(SHARES))
            text = f"{round(gain, 1) + 0.0:+.1f}"  # never -0.0
            axes.text(x, y, text, ha="center", va="center", color="white" if abs(gain) > 3 else "black")
    panels[0].set_ylabel("light of a clear sky, capture time")
    figure.colorbar(image, ax=panels, label="mIoU over the best\nuniform scan [points]", shrink=0.7)
    figure.savefig(picture)


if __name__ == "__main__":
    rows(Path(sys.argv[1]) if len(sys.argv) > 1 else None)

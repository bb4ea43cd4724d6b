"""Print tables II and III of the paper: a coarse image, K patches read in full, and the resulting map.

The overview reads the fine image at 1/4 and 1/2 of its side, as area means: 1024 to 256 and 512 px.
A policy chooses K patches, which are read from fine pixels. The map is scored by the labels.

`make paper` runs it for the built-in farm, and for CWFID if its data exist. PAPER="--data FOLDER" replaces them by a
folder of images, labels and scene.toml, such as RANUS or HyKo; --help lists the other flags.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from measure import Row, aligned, data_folder, not_run, print_rows
from numpy.typing import NDArray
from paper_sets import CAMERA, INPUTS, DataSet, Image, Say, coarse_image, farm_all, farm_four, folder

from spectralzoom.flows.training.train_scenes import DEEP_PATCH_PX
from spectralzoom.models.evaluation.metrics import confusion, mean_iou, overall_accuracy
from spectralzoom.models.network.machine import keep_freed_memory, one_thread
from spectralzoom.models.network.sizes import multiply_adds
from spectralzoom.models.network.spectral import LineSpec, patches_of
from spectralzoom.models.policies.placement import mixed
from spectralzoom.models.policies.policies import PIXEL_SCORES, score_multiply_adds, score_patches
from spectralzoom.models.reading.inference import CoarsePrediction, coarse_prediction_of_columns, segment
from spectralzoom.models.training.examples import normalised, observe
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid, patch_pixels
from spectralzoom.pipeline.planning.coverage import select_patches

COUNTS = (100, 200, 300, 400, 500)
NAMES = {4: "256", 2: "512", 1: "1024"}  # of inputs, by fine pixels a side of a coarse one
HELD_OUT = ("002", "007", "012", "017", "020", "025", "033", "037", "041", "045", "050", "053", "057")  # of CWFID
STEPS = 300
RANDOM_DRAWS = 5
POLICIES = {  # the paper's name, the policy, and the pooling of a patch
    "ED, maximum": ("sobel", "maximum"),
    "ED, mean": ("sobel", "mean"),
    "SA (entropy), maximum": ("entropy", "maximum"),
    "SA (entropy), mean": ("entropy", "mean"),
    "TA (here gain)": ("gain", "mean"),
    "random": ("random", "mean"),
    "ideal*": ("ideal", "mean"),
}
CAPTION = (
    "ED: Sobel edges of the coarse image. SA: the entropy of the overview's classes stands for the gradients of VGG19. "
    "TA: gain, expected errors with rare classes weighted more, is its successor. The paper pools maps by maximum. "
    "ideal*: chosen by the labels, the patches in which reading in full corrects most pixels. "
    "mIoU and right pixels [%]: all scenes together, ± the standard deviation between scenes. "
    "patches: those of the coarse image and K. MACs: multiply-adds a scene [10^9] in closed form. "
    "The overview reads the coarse image enlarged, so that it costs the same for each input."
)
Scores = NDArray[np.float64]


@dataclass(frozen=True)
class Readings:
    """A scene's maps by the overview alone and with every patch read in full; each choice of patches combines both."""

    seen: CoarsePrediction
    overview: NDArray[np.uint8]  # (y, x)
    full: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    classes: int

    def counts(self, chosen: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the confusion of the map with the chosen patches read in full."""
        grid = self.seen.grid
        drawn = mixed(self.overview, self.full, np.isin(grid.every_patch(), chosen), grid)
        return confusion(self.labels, drawn, self.classes)

    def scores(self, policy: str, pooling: str, seed: int) -> Scores:
        """Score every patch, (patch,), by a row of `POLICIES`."""
        if policy == "ideal":
            wrong = [(drawn != self.labels) & (self.labels != UNLABELLED) for drawn in (self.overview, self.full)]
            before, after = (patch_pixels(self.seen.grid, one).sum(axis=(1, 2)) for one in wrong)
            return np.asarray(before - after, np.float64)
        if pooling == "maximum":
            return patch_maxima(PIXEL_SCORES[policy].of(self.seen), self.seen.grid)
        return score_patches(policy, self.seen, seed=seed)


def patch_maxima(pixels: Scores, grid: SceneGrid) -> Scores:
    """Return the greatest score of each patch's pixels within the scene, (patch,)."""
    greatest: Scores = patch_pixels(grid, pixels[: grid.height, : grid.width]).max(axis=(1, 2))
    return greatest


def read_scene(weights: Weights, columns: Image, labels: NDArray[np.uint8], grid: SceneGrid, factor: int) -> Readings:
    """Read normalised columns of the padded grid: the overview from coarse pixels, all patches from fine ones."""
    capture = LineSpec(step=factor, binned=factor)
    every = grid.every_patch()
    seen = coarse_prediction_of_columns(weights, coarse_image(columns, factor), grid, capture)
    fine = patches_of(columns, grid.patch)[every]
    maps = [segment(weights, seen, fine[:n], every[:n], capture=LineSpec()).classes for n in (0, len(every))]
    return Readings(seen, maps[0], maps[1], labels, weights.config.classes)


@dataclass
class Tally:
    """Results of one row over scenes."""

    counts: list[list[NDArray[np.int64]]] = field(default_factory=list)  # (scene, draw)
    patches: list[int] = field(default_factory=list)
    multiply_adds: list[int] = field(default_factory=list)

    def figure(self, of: Callable[[NDArray[np.int64]], float]) -> float:
        """Return a figure of all scenes together, the mean over draws [%]."""
        return 100 * float(np.mean([of(np.sum(draw, axis=0)) for draw in zip(*self.counts, strict=True)]))

    def spread(self, of: Callable[[NDArray[np.int64]], float]) -> float:
        """Return the standard deviation between scenes [%]; 0 for a single scene."""
        each = [np.mean([of(counts) for counts in draws]) for draws in self.counts]
        return 100 * float(np.std(each, ddof=1)) if len(each) > 1 else 0.0

    def cells(self) -> tuple[str, ...]:
        """Return the row's columns."""
        right = [f"{self.figure(of):.1f} ±{self.spread(of):.1f}" for of in (mean_iou, overall_accuracy)]
        return *right, f"{np.mean(self.patches):.0f}", f"{np.mean(self.multiply_adds) / 1e9:.1f}"


Tallies = dict[tuple[int, str, str], Tally]  # by input, policy, and K


def judge(data: DataSet, counts: Sequence[int], say: Say) -> Tallies:
    """Evaluate every row on every scene."""
    found: Tallies = {}
    config = data.weights.config
    for number, (name, make) in enumerate(data.scenes.items()):
        say(f"{data.name}: scene {name}, {number + 1} of {len(data.scenes)}")
        scene = make()
        if scene.labels is None or scene.class_names != data.weights.class_names:
            raise SceneError(f"scene {name} has classes {scene.class_names}, the weights {data.weights.class_names}")
        height, width = scene.shape
        grid = SceneGrid(height, width, config.patch)
        observed = observe(scene, CAMERA, grid, data.weights.basis, np.random.default_rng([number, 0x9A9E]))
        _, reached = data.weights.basis.matrix(scene.wavelength_nm)
        columns = normalised(observed, data.weights.normalisation, reached).columns.astype(np.float32)
        every, bands = len(grid.every_patch()), len(scene.wavelength_nm)
        for factor in (*INPUTS, 1):
            read = read_scene(data.weights, columns, scene.labels, grid, factor)
            coarse = 0 if factor == 1 else int(np.prod([-(-n // (grid.patch * factor)) for n in scene.shape]))
            part = max(round(0.35 * every) - coarse, 0)
            rows = {f"{k}": k for k in counts if k <= every and factor > 1} | {"35 %": part, "0": 0, "all": every}
            for label, (policy, pooling) in POLICIES.items():
                draws = range(1000, 1000 * (RANDOM_DRAWS if policy == "random" else 1) + 1, 1000)
                scores = [read.scores(policy, pooling, seed) for seed in draws]
                cost = 0 if policy in ("random", "ideal") else score_multiply_adds(policy, config, grid)
                for text, k in rows.items():
                    own = cost if 0 < k < every else 0
                    spent = multiply_adds(config, grid, k, bands, score=own).total
                    if factor > 1:  # patches are captured apart
                        spent += k * grid.patch**2 * bands * config.columns
                    row = found.setdefault((factor, label, text), Tally())
                    row.counts.append([read.counts(select_patches(one, k)) for one in scores])
                    row.patches.append(coarse + k)
                    row.multiply_adds.append(spent)
    return found


def table(data: DataSet, found: Tallies, counts: Sequence[int]) -> str:
    """Format the rows in the paper's layout, with both inputs side by side."""
    head = ("mIoU [%]", "right [%]", "patches", "MACs")
    first = next(iter(POLICIES))
    lines = [tuple(cell for factor in INPUTS for cell in (f"1024 to {NAMES[factor]}", *head))]
    lines.append(tuple(c for f in INPUTS for c in (f"Baseline {NAMES[f]}", *found[f, first, "0"].cells())))
    lines.append(("Baseline 1024", *found[1, first, "all"].cells()) * len(INPUTS))
    for label in POLICIES:
        for k in (str(k) for k in counts if (INPUTS[0], label, str(k)) in found):
            lines.append(tuple(c for f in INPUTS for c in (f"{label} {k}", *found[f, label, k].cells())))
    patch = data.weights.config.patch
    title = f"{data.name}: {len(data.scenes)} scenes, patches of {patch} x {patch} px"
    return "\n".join([title, aligned(lines, (26, 11, 11, 7, 7) * len(INPUTS))])


def claims(data: DataSet, found: Tallies) -> list[Row]:
    """Check on each input that 35 % of the patches score at least as much as all of them."""
    goal = found[1, next(iter(POLICIES)), "all"].figure(mean_iou)
    rows = []
    for factor in (*INPUTS, 1):
        score = {label: found[factor, label, "35 %"].figure(mean_iou) for label in POLICIES}
        ideal = score.pop("ideal*")
        best = max(score, key=lambda label: score[label])
        what = f"{data.name}: mIoU with 35 % of the patches, input {NAMES[factor]}"
        told = f"gain {score['TA (here gain)']:.1f}, random {score['random']:.1f}, ideal {ideal:.1f}"
        rows.append(Row(what, f"{score[best]:.1f} by {best}", f">= {goal:.1f}, all", score[best] >= goal, told))
    return rows


def rows(arguments: Sequence[str] = ()) -> list[Row]:
    """Print both tables, and return the rows that check the claim."""
    asked = parser().parse_args(arguments)
    say = partial(print, file=sys.stderr, flush=True)
    keep_freed_memory()
    missing = []
    with one_thread():
        cwfid = asked.data or data_folder("cwfid")
        sets = [] if asked.data else [partial(farm_four, asked.steps, say), farm_all]
        if cwfid.is_dir():
            named = tuple(asked.hold_out.split(",")) if asked.hold_out else () if asked.data else HELD_OUT
            sets.append(partial(folder, cwfid, named, asked.steps, asked.patch, say, asked.weights))
        else:
            missing.append(not_run("field frames", cwfid))
        checked = []
        for make in sets:
            data = make()
            found = judge(data, asked.patches, say)
            print(f"\n{table(data, found, asked.patches)}", flush=True)
            checked += claims(data, found)
    print(f"\n{CAPTION}")
    return [*checked, *missing]


def parser() -> argparse.ArgumentParser:
    """Return the parser of the flags."""
    made = argparse.ArgumentParser(prog="make paper", description="Tables II and III of the paper.")
    made.add_argument("--data", type=Path, metavar="FOLDER", help="judge a folder of images, labels and scene.toml")
    made.add_argument("--weights", type=Path, metavar="FILE", help="weights of the folder, or of CWFID; else trained")
    made.add_argument("--hold-out", default="", metavar="NAMES", help="frames of the folder to judge; every third")
    made.add_argument("--steps", type=int, default=STEPS, help=f"of each training ({STEPS})")
    made.add_argument("--patch", type=int, default=DEEP_PATCH_PX, help=f"of a folder's network [px] ({DEEP_PATCH_PX})")
    made.add_argument("--patches", type=lambda text: tuple(map(int, text.split(","))), default=COUNTS, metavar="K,K")
    return made


if __name__ == "__main__":
    print_rows(rows(sys.argv[1:]))

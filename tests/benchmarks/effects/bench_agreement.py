"""Whether the choice of effects changes the map: the shipped model on a survey with `auto` and on everything, exact.

Surveys have one seed and the same streams, but cheap shot noise takes the read noise into its draw: beside exact noise
it is another draw. So the choice is judged beside everything on and exact in the light, read out with the same draw;
how much another draw changes by itself stands below it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from measure import Row
from numpy.typing import NDArray
from rich.console import Console

from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from models.network.machine import use_one_thread
from storage.arrays.class_maps import load_class_map

SIZE, SEEDS, TOLERANCE = "640x512", (1, 2), 0.1
NOISE_ALONE = "0.001"  # sigma: nothing but the variant of the shot noise fits
GOAL = 0.995

Classes = NDArray[np.uint8]


def rows() -> list[Row]:
    """Share of pixels with the same class, and of those that differ how many lie where two classes meet."""
    use_one_thread()
    return [row for seed in SEEDS for row in _of_seed(seed)]


def _of_seed(seed: int) -> list[Row]:
    exact, _ = mapped(seed, effects="all")
    auto, auto_miou = mapped(seed, effects="auto", tol=str(TOLERANCE))
    drawn_alike, miou = mapped(seed, effects="auto", tol=NOISE_ALONE)
    same, apart = float((auto == drawn_alike).mean()), auto != drawn_alike
    at_border = float(_borders(drawn_alike)[apart].mean()) if apart.any() else 1.0
    return [
        Row(
            f"farm {SIZE}, seed {seed}, auto at {TOLERANCE} sigma against everything on: px of the same class",
            f"{same:.2%}",
            f">= {GOAL:.1%}",
            same >= GOAL,
            f"{at_border:.0%} of the others where two classes meet; mIoU {100 * auto_miou:.2f}, {100 * miou:.2f}",
        ),
        Row(
            f"farm {SIZE}, seed {seed}, auto and exact noise, which is another draw: px of the same class",
            f"{float((auto == exact).mean()):.2%}",
            peers=f"another draw alone {float((drawn_alike == exact).mean()):.2%}",
        ),
    ]


def mapped(seed: int, **flags: str) -> tuple[Classes, float]:
    """Class map (y, x) of a survey, and its mean IoU."""
    with tempfile.TemporaryDirectory() as folder:
        given = {"scene": "farm", "size": SIZE, "seed": str(seed), "engine": "plain", "controls": False, "out": folder}
        published = run_survey(load_settings(None, {**given, **flags}), Console(quiet=True))
        (path,) = Path(folder).glob("stages/segment/*/class_map.zarr")
        miou = published.receipt["accuracy"]["miou"]
        return load_class_map(path).classes, float("nan") if miou is None else miou


def _borders(classes: Classes) -> NDArray[np.bool_]:
    found = np.zeros(classes.shape, bool)
    for axis in (0, 1):
        differs = np.diff(classes.astype(np.int16), axis=axis) != 0
        pad = [(0, 0), (0, 0)]
        pad[axis] = (0, 1)
        found |= np.pad(differs, pad)
        pad[axis] = (1, 0)
        found |= np.pad(differs, pad)
    return found

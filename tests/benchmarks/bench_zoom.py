"""Zooming of the main job: the trial in two passes against uniform scans, and the planner on farms and scouted fields.

Each field is eight swaths wide. The uniform scan is the best that the weights' table knows for the same seconds. It is
captured, read and judged like the survey. Seeds and seconds were named before the rules of the planner were chosen.
"""

from __future__ import annotations

import itertools
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from measure import ROOT, Row
from rich.console import Console

from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.survey_command import run_survey

FIRST_VISIT = ROOT / "docs" / "tutorials" / "first-visit.toml"
WEEK_LATER = ROOT / "docs" / "tutorials" / "week-later.toml"
SEEDS = (71, 72, 73)
SECONDS = {1.0: 30.0, 0.25: 60.0}  # by the fraction of a clear sky's light
LONGER = (1.5, 2.0, 3.0)  # times these seconds, of uniform scans
OTHER_SEEDS = (81, 82, 83)
OTHER_SECONDS = (15, 25, 60)
OTHERS = ("farm", "scouting")
EIGHT_SWATHS = {"size": "640x512", "camera.samples": "80"}
PAUSE = ("condense_coarse", "locate", "rectify", "read_overview", "score")  # stages between the passes
LARGE = "1280x1024"  # of the field whose pause is measured


def surveyed(out: str, file: Any = None, **flags: Any) -> dict[str, Any]:
    """Return the receipt of a survey."""
    settings = asked(out, file, **flags)
    return dict(run_survey(settings, Console(quiet=True), summary=False).receipt)


def asked(out: str, file: Any = None, **flags: Any) -> Settings:
    """Return the settings of a survey without a server."""
    named = {name.replace("__", "."): str(one) for name, one in flags.items()}
    return load_settings(file, {"engine": "plain", **named, "out": out})


@cache
def trial(seed: int, light: float, factor: float = 1.0, zoom: str = "auto") -> dict[str, Any]:
    """Return the receipt of a survey of the trial in so many times the usual seconds."""
    with tempfile.TemporaryDirectory() as out:
        flags = {"seed": seed, "seconds": factor * SECONDS[light], "zoom": zoom, "controls": "no"}
        return surveyed(out, FIRST_VISIT, **flags, sky__light_fraction=light)


def points(receipt: dict[str, Any]) -> float:
    """Return the mIoU [%]."""
    return 100 * float(receipt["accuracy"]["miou"])


def trial_rows() -> Iterator[Row]:
    """Yield the gain of each trial, and by how much longer a uniform scan of the same score takes."""
    gains, ratios = [], []
    shares: dict[float, list[float]] = {light: [] for light in SECONDS}
    for seed, light in itertools.product(SEEDS, SECONDS):
        ours, uniform = trial(seed, light), trial(seed, light, zoom="never")
        gains.append(points(ours) - points(uniform))
        longer = {factor: points(trial(seed, light, factor, "never")) for factor in LONGER}
        ratios.append(next((factor for factor, score in longer.items() if score >= points(ours)), np.inf))
        shares[light].append(ours["savings"]["multiply_adds"]["ratio"])
        beside = ", ".join(f"{factor:g} x {score:.1f}" for factor, score in longer.items())
        name = f"trial {seed}, light {light:g}, {SECONDS[light]:g} s: mIoU"
        peers = f"uniform {points(uniform):.1f}; longer: {beside}; {ours['plan']['reason']}"
        yield Row(name, f"{points(ours):.1f} ({gains[-1]:+.1f})", peers=peers)
    yield Row("mean gain over the uniform scan", f"{np.mean(gains):+.1f}", "+1.5", bool(np.mean(gains) >= 1.5))
    yield Row("least gain", f"{min(gains):+.1f}", "-0.3", min(gains) >= -0.3)
    text = ", ".join("> 3" if np.isinf(one) else f"{one:g}" for one in ratios)
    yield Row("time of a uniform scan of the same score, at most [x]", text, "1.5", min(ratios) > 1.5)
    for light, each in shares.items():
        text = ", ".join(f"{one:.0%}" for one in each)
        yield Row(f"multiply-adds over reading all, light {light:g}", text, "45 %", max(each) <= 0.45)


def planner_rows() -> Iterator[Row]:
    """Yield the planner's choice on other fields against both ways."""
    missed = []
    for scene, seed, seconds in itertools.product(OTHERS, OTHER_SEEDS, OTHER_SECONDS):
        flags: dict[str, Any] = {"scene": scene, "seed": seed, "seconds": seconds, **EIGHT_SWATHS}
        with tempfile.TemporaryDirectory() as out:
            zooms = plan_survey(open_field(asked(out, **flags), planning=True)).settings.zooms
            score = {zoom: points(surveyed(out, **flags, zoom=zoom)) for zoom in ("never", "always")}
        chosen = "always" if zooms else "never"
        missed.append(score[chosen] - max(score.values()))
        both = f"uniform {score['never']:.1f}, two passes {score['always']:.1f}"
        yield Row(f"{scene} {seed}, {seconds} s", f"{score[chosen]:.1f}", peers=f"{both}; takes {chosen}")
    yield Row("planner below the better way, at most", f"{min(missed):+.1f}", "-0.3", min(missed) >= -0.3)


def time_rows() -> Iterator[Row]:
    """Yield the pause between the passes of a large trial, and the time of both visits of the main job."""
    with tempfile.TemporaryDirectory() as out:
        found = surveyed(out, FIRST_VISIT, seed=SEEDS[0], size=LARGE, camera__samples=160, seconds=50, controls="no")
        stages = {row["name"]: row["cpu_s"] for row in found["stages"]}
        pause_s = sum(stages[name] for name in PAUSE)
        each = ", ".join(f"{name} {stages[name]:.1f}" for name in PAUSE)
        yield Row(f"pause between the passes, {LARGE} px, processor", f"{pause_s:.1f} s", "3 s", pause_s <= 3, each)
    with tempfile.TemporaryDirectory() as out:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        words = ["survey", str(FIRST_VISIT), str(WEEK_LATER), "--out", out]
        program = [str(Path(sys.executable).with_name("spectralzoom")), *words]
        subprocess.run(program, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    yield Row("both visits of the main job, processor", f"{spent_s:.0f} s", "60 s", spent_s <= 60)


def rows() -> list[Row]:
    """Return all rows, and print each when it is known."""
    found = []
    for row in itertools.chain(time_rows(), trial_rows(), planner_rows()):
        found.append(row)
        print(row.what, row.figure, row.peers, sep=" | ", flush=True)
    return found

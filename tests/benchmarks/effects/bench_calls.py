"""Whole calls of `spectralzoom simulate`, one worker: everything on, auto and nothing on: the ceiling of any choice.

What nothing on costs is in every call: no choice of effects, however good, saves more than everything on over that.
What choosing costs is what a call takes more than the same one with the choice at hand: stored, its lines discarded.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from measure import ROOT, Row, data_folder, not_run
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

ROUNDS = 3
WAYS = ("all", "auto", "none")
CHOSEN = "auto, its choice stored"
MOST_S, MOST_SHARE = 0.3, 0.05  # of rendering everything: what choosing may cost
SHAPE, BANDS = (512, 640), 60  # of the scenes that are made here
LAMPS = 12
FRAMES = ("017_image.png",)  # of CWFID
LEAST_SAVED = {"farm 1280 x 1024": 3.0, "CWFID frame": 4.0, "Indian Pines": 2.5, "bare field": 8.0, "night": 8.0}


@dataclass(frozen=True)
class Call:
    """What one command took: processor seconds of all of it, of the choice and of the capture; and what it printed.

    With ``all`` and ``none`` the choice is what the table of effects takes, and a check of nothing, or of all together.
    """

    cpu_s: float
    choice_s: float
    capture_s: float
    record: Mapping[str, Any]

    @property
    def rest_s(self) -> float:
        """Start-up, and drawing or reading the scene."""
        return self.cpu_s - self.choice_s - self.capture_s

    @property
    def lines(self) -> Path:
        """Where its raw lines lie."""
        return Path(self.record["path"])


def rows() -> list[Row]:
    """Each scene's three ways in turns, after one call that nobody times."""
    with tempfile.TemporaryDirectory() as name:
        folder, found = Path(name), []
        _call(["farm", "--size", "64x64"], folder / "first", "all")  # compiles what is not in numba's cache yet
        for what, (words, missing) in _scenes(folder).items():
            if missing is not None:
                found.append(not_run(f"{what}: everything on over auto, whole calls", missing))
                continue
            numbers = count()
            calls: dict[str, list[Call]] = {way: [] for way in (*WAYS, CHOSEN)}
            for _ in range(ROUNDS):
                for way in WAYS:
                    out = folder / f"{what} {next(numbers)}"
                    calls[way].append(_call(words, out, way))
                    shutil.rmtree(calls[way][-1].lines)
                    if way == "auto":
                        calls[CHOSEN].append(_call(words, out, way))
                    shutil.rmtree(out)
            found += _rows_of(what, calls)
    return found


def _rows_of(what: str, calls: Mapping[str, Sequence[Call]]) -> list[Row]:
    saved, ceiling = (_ratio(calls["all"], calls[way]) for way in ("auto", "none"))
    goal = LEAST_SAVED[what]
    pairs = zip(calls["all"], calls["none"], strict=True)
    free = statistics.median(one.cpu_s / (other.cpu_s - other.choice_s) for one, other in pairs)
    on = sum(row["state"] == "on" for row in calls["auto"][0].record["effects"])
    rendered = statistics.median(one.capture_s for one in calls["all"])
    chosen = statistics.median(
        one.cpu_s - stored.cpu_s for one, stored in zip(calls["auto"], calls[CHOSEN], strict=True)
    )
    seen = statistics.median(one.choice_s for one in calls["auto"])
    return [
        Row(
            f"{what}: everything on over auto, whole calls, processor time",
            f"{saved:.2f} x",
            f">= {goal:g} x",
            saved >= goal,
            f"{_parts(calls['all'])}; auto {_parts(calls['auto'])}, {on} effects on",
        ),
        Row(
            f"{what}: everything on over nothing on: the ceiling of any choice",
            f"{ceiling:.2f} x, {free:.2f} x if nobody had to choose",
            peers=f"nothing on {_parts(calls['none'])}",
        ),
        Row(
            f"{what}: what choosing costs",
            f"{chosen:.2f} s, {chosen / rendered:.0%} of rendering everything",
            f"<= {MOST_SHARE:.0%} or {MOST_S:g} s",
            chosen <= max(MOST_SHARE * rendered, MOST_S),
            f"{seen:.2f} s with what rendering needs anyway: libraries, kernels, the scene at fewer pixels",
        ),
    ]


def _ratio(of: Sequence[Call], to: Sequence[Call]) -> float:
    return statistics.median(one.cpu_s / other.cpu_s for one, other in zip(of, to, strict=True))


def _parts(calls: Sequence[Call]) -> str:
    whole, choice, capture, rest = (
        statistics.median(getattr(one, name) for one in calls) for name in ("cpu_s", "choice_s", "capture_s", "rest_s")
    )
    return f"{whole:.1f} s: start and scene {rest:.1f}, choice {choice:.1f}, lines {capture:.1f}"


def _call(words: Sequence[str], out: Path, way: str) -> Call:
    command = [sys.executable, "-m", "flows.cli.main", "simulate", *words, "--effects", way, "--workers", "1", "--json"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [*command, "--out", str(out)], check=True, cwd=ROOT, capture_output=True, env={**os.environ, "TERM": "dumb"}
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    record = json.loads(done.stdout)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Call(spent, record["choice_cpu_s"] or 0.0, record["cpu_s"], record)


def _scenes(folder: Path) -> dict[str, tuple[list[str], Path | None]]:
    """Words of the command for each scene, and the folder that it needs where that is not there."""
    frames, pines = data_folder("cwfid") / "images" / FRAMES[0], data_folder("indian_pines")
    cube = pines / "Indian_pines_corrected.npy"
    made = {"bare field": bare_field(), "night": night()}
    nm = ",".join(f"{one:.1f}" for one in np.linspace(400, 1000, BANDS))
    found: dict[str, tuple[list[str], Path | None]] = {
        "farm 1280 x 1024": (["farm"], None),
        "CWFID frame": ([str(frames)], None if frames.is_file() else frames.parent),
        "Indian Pines": ([str(cube)], None if cube.is_file() else pines),
    }
    for what, values in made.items():
        np.save(folder / f"{what}.npy", values)
        found[what] = ([str(folder / f"{what}.npy"), "--wavelengths", nm], None)
    return found


def bare_field() -> NDArray[np.float32]:
    """Soil without an edge: moister and drier over 20 px and more, by 3 % (sd)."""
    rng = np.random.default_rng(0)
    moist = gaussian_filter(rng.standard_normal(SHAPE), 20.0)
    spectrum = 0.1 + 0.25 * np.linspace(0, 1, BANDS)
    return np.asarray(spectrum * (1 + 0.03 * moist / moist.std())[..., None], np.float32)


def night() -> NDArray[np.float32]:
    """Dark land, a five hundredth of the lamps that stand on it as small glows of a few px."""
    rng = np.random.default_rng(1)
    glow = np.zeros(SHAPE)
    glow[rng.integers(0, SHAPE[0], LAMPS), rng.integers(0, SHAPE[1], LAMPS)] = 1.0
    glow = gaussian_filter(glow, 4.0)
    spectrum = np.exp(-(((np.linspace(400, 1000, BANDS) - 600) / 120) ** 2))
    return np.asarray((2e-3 + glow / glow.max())[..., None] * spectrum, np.float32)


if __name__ == "__main__":
    for one in rows():
        print(one.what, one.figure, one.goal, one.peers, sep=" | ", flush=True)

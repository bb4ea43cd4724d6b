"""Trade-off of the overlap of neighbouring sweeps: how well their shift is found, and how long that takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register
from flows.tradeoff.resample import draw_waves
from pipeline.rectify.registration.shifts import PairShift, pair_shift

LENGTH_PX = 256  # of the seam
OVERLAPS_PX = (16, 32, 64, 128, 256)
PAIRS = 5
PERIODS_PX = (16.0, 160.0)
SNR = 50.0
PRIOR_PX = 3.0

Image = NDArray[np.float64]


@dataclass(frozen=True)
class Seams:
    """Two noisy looks at each seam, the second shifted by what is known."""

    pairs: list[tuple[Image, Image]]  # (row, column), of the widest overlap
    shifts: NDArray[np.float64]  # (pair, 2) rows and columns


def _prepare(seed: int) -> Seams:
    rng = np.random.default_rng([seed, 2])
    size = (LENGTH_PX, max(OVERLAPS_PX))
    places = np.argwhere(np.ones(size, bool)).astype(np.float64)
    shifts = rng.uniform(1 - PRIOR_PX, PRIOR_PX - 1, (PAIRS, 2))
    pairs = []
    for number, shift in enumerate(shifts):
        waves = draw_waves(seed + number, bands=1, periods_px=PERIODS_PX)
        # reference(p) = moving(p - shift)
        looks = [waves.at(places + moved).reshape(size) for moved in (np.zeros(2), shift)]
        sigma = float(np.std(looks[0])) / SNR
        pairs.append((looks[0] + rng.normal(0, sigma, size), looks[1] + rng.normal(0, sigma, size)))
    return Seams(pairs, shifts)


def _run(state: Seams, overlap: Setting) -> list[PairShift]:
    part = slice(0, int(overlap))
    return [pair_shift(first[:, part], second[:, part], prior_px=PRIOR_PX) for first, second in state.pairs]


def _judge(state: Seams, _overlap: Setting, found: list[PairShift]) -> float:
    """Median distance of what was found from what is known; a pair that is not decided counts as infinitely far."""
    off = np.linalg.norm([pair.shift for pair in found] - state.shifts, axis=1)
    return float(np.median(np.where(np.isnan(off), np.inf, off)))


OVERLAP = register(
    Tradeoff(
        stage="rectify",
        knob="overlap",
        error="median error of the shift [px]",
        unit="pair",
        reference=(
            f"{PAIRS} known shifts of waves of {PERIODS_PX[0]:g} to {PERIODS_PX[1]:g} px, "
            f"{LENGTH_PX} px of seam, SNR {SNR:g}"
        ),
        settings=OVERLAPS_PX,
        prepare=_prepare,
        run=_run,
        judge=_judge,
        work=lambda _state, _overlap: float(PAIRS),
        levels=lambda _state: (Level("goal of 0.1 px", 0.1),),
    )
)

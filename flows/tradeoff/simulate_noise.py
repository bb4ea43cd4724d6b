"""Trade-off of the noise: variants of the shot noise against the law of photons, amplifier and converter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register
from flows.tradeoff.simulate import look_at_lines
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.counting import QUANTISATION, READ_NOISE, SATURATION, SHOT
from pipeline.simulator.effects.effect import OFF, SweepBlock
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.render import read_out
from pipeline.simulator.rig_model import Rig

LEVELS = 6
DIM_E, BRIGHT_SHARE = 100.0, 0.9  # of full scale: where usual light begins and ends
LINES = 800  # draws of a level: so many times the camera's samples
LEAST_EXPECTED = 10.0  # counts of a class of the chi-square test; rarer numbers are of their neighbours' class

Floats = NDArray[np.float64]
Raw = NDArray[np.uint16]


@dataclass(frozen=True)
class Counted:
    """Even light at some levels, and how probable each number of the converter is there."""

    block: SweepBlock
    electrons: Floats  # (level,)
    light: NDArray[np.float32]  # (line, sample, level) [e-]
    law: Floats  # (level, DN)
    probe: Probe

    @property
    def draws(self) -> int:
        """Of each level."""
        return len(self.block.lines) * self.block.rig.camera.samples

    def counts(self, raw: Raw) -> Floats:
        """How often each number came, (level, DN)."""
        levels = raw.reshape(-1, len(self.electrons)).T
        return np.stack([np.bincount(one, minlength=self.law.shape[1]) for one in levels]).astype(np.float64)


def _even_light(seed: int, least_e: float, most_e: float) -> Counted:
    rig = Rig(LineCamera())
    electrons = np.geomspace(least_e, most_e, LEVELS)
    sweep = Sweep("even", "fine", "x", 0.0, 0.0, LINES)
    block = SweepBlock(rig, sweep, range(LINES), np.arange(1.0, LEVELS + 1), (LINES, rig.camera.samples), seed)
    light = np.broadcast_to(electrons.astype(np.float32), (LINES, rig.camera.samples, LEVELS)).copy()
    law = np.stack([law_of_numbers(float(one), rig) for one in electrons])
    return Counted(block, electrons, light, law, replace(look_at_lines(seed).probe, brightest_e=most_e))


def law_of_numbers(electrons: float, rig: Rig) -> Floats:
    """Give how probable each number of the converter is where so many electrons are expected, (DN,): Poisson counts,
    normal read noise, rounding, both ends of the converter. The read noise must not be 0.
    """
    from scipy.special import ndtr  # a second to load, for those who trade noise alone
    from scipy.stats import poisson

    camera = rig.camera
    reach = 9 * np.sqrt(electrons) + 30
    counts = np.arange(max(0, int(electrons - reach)), int(electrons + reach) + 1)
    edges = (np.arange(camera.full_scale_dn) + 0.5 - camera.dark_dn) * camera.electrons_per_dn
    weight = poisson.pmf(counts, electrons)
    below = np.zeros(len(edges))
    for some in np.array_split(np.arange(len(counts)), -(-len(counts) // 256)):
        below += weight[some] @ ndtr((edges - counts[some, None]) / camera.read_noise_e)
    law: Floats = np.diff(below, prepend=0.0, append=float(weight.sum()))
    return np.maximum(law, 0.0)  # differences of sums that round


def _run(state: Counted, variant: Setting) -> Raw:
    chosen: dict[Any, str] = {
        READ_NOISE: READ_NOISE.variants[0],
        SATURATION: SATURATION.variants[0],
        QUANTISATION: QUANTISATION.variants[0],
    }
    shot: dict[Any, str] = {} if variant == OFF else {SHOT: str(variant)}
    return read_out(state.light, state.block, {**shot, **chosen})


def _variation(state: Counted, _variant: Setting, raw: Raw) -> float:
    """Total variation between what came and the law, at the worst level."""
    return float(np.abs(state.counts(raw) / state.draws - state.law).sum(axis=1).max()) / 2


def _by_chance(state: Counted) -> float:
    """Total variation of exact draws from their law, at the worst level: its mean and three of its deviations.

    Each number's share deviates normally, and nearly by itself.
    """
    variance = state.law * (1 - state.law) / state.draws
    mean = np.sqrt(2 / np.pi) * np.sqrt(variance).sum(axis=1)
    spread = np.sqrt((1 - 2 / np.pi) * variance.sum(axis=1))
    return float((mean + 3 * spread).max()) / 2


def _bound(state: Counted, variant: Setting, _raw: Raw) -> float:
    """What the effect says of its variants; noise counts twice its total variation."""
    return SHOT.bound(state.probe, state.block.rig, str(variant)).value / 2


def _chi_square(state: Counted, _variant: Setting, raw: Raw) -> float:
    """How probable a chi-square as large is where the law holds, at the worst level."""
    from scipy.stats import chi2  # slow to load

    found = []
    for seen, law in zip(state.counts(raw), state.law, strict=True):
        usual = np.flatnonzero(law * state.draws >= LEAST_EXPECTED)
        starts = np.concatenate([[0], usual[1:]])
        counted, wanted = np.add.reduceat(seen, starts), np.add.reduceat(law * state.draws, starts)
        found.append(float(chi2.sf(((counted - wanted) ** 2 / wanted).sum(), len(usual) - 1)))
    return min(found)


def _moments(state: Counted, raw: Raw) -> tuple[Floats, Floats, Floats]:
    """Mean seen less the law's, variance seen, variance of the law, (level,) each [DN]."""
    dn, laws = np.arange(state.law.shape[1]), np.stack([state.counts(raw) / state.draws, state.law])
    means = laws @ dn
    seen, law = (laws * (dn - means[..., None]) ** 2).sum(axis=-1)
    return means[0] - means[1], seen, law


def _variance_error(state: Counted, _variant: Setting, raw: Raw) -> float:
    _, seen, wanted = _moments(state, raw)
    return float(np.abs(seen / wanted - 1).max())


def _mean_error(state: Counted, _variant: Setting, raw: Raw) -> float:
    """Greatest error of the mean, in sigmas of one number."""
    off, _, variance = _moments(state, raw)
    return float((np.abs(off) / np.sqrt(variance)).max())


NOISE = register(
    Tradeoff(
        stage="simulate",
        knob="shot noise",
        error="total variation of a number, worst level",
        unit="px*band",
        reference=f"the law of counts, read noise and rounding, {DIM_E:g} electrons to {BRIGHT_SHARE:g} of full scale",
        settings=(*SHOT.variants, OFF),
        prepare=lambda seed: _even_light(seed, DIM_E, BRIGHT_SHARE * LineCamera().full_well_e),
        run=_run,
        judge=_variation,
        work=lambda state, _variant: float(state.light.size),
        levels=lambda state: (Level("exact draws, by chance", _by_chance(state)),),
        beside={"bound": _bound, "p of χ²": _chi_square, "mean [σ]": _mean_error, "variance": _variance_error},  # noqa: RUF001
    )
)
DIM_NOISE = register(
    replace(
        NOISE,
        knob="shot noise, dim light",
        reference=f"the law of counts, read noise and rounding, 1 to {DIM_E:g} electrons",
        prepare=lambda seed: _even_light(seed, 1.0, DIM_E),
    )
)

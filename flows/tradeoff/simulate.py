"""Trade-offs of what is simulated: tolerance by which effects are left out, variants of footprint and of shot noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register_all
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep
from pipeline.planning.coverage import full_sweeps
from pipeline.simulator.effects.counting import QUANTISATION, READ_NOISE, SATURATION, SHOT
from pipeline.simulator.effects.effect import OFF, Effect, SweepBlock
from pipeline.simulator.effects.line import SLIT
from pipeline.simulator.effects.probe import Probe, noise_electrons
from pipeline.simulator.effects.registry import EFFECTS, RAYS
from pipeline.simulator.effects.registry import FOOTPRINT as BLURS
from pipeline.simulator.readout import dark_frame, read_out
from pipeline.simulator.render import Choice, expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.selection.choice import CHEAP_SHARE, decide
from pipeline.simulator.selection.survey_probe import probe_scene
from pipeline.simulator.simulated import sweep_block

SHAPE = (512, 1280)
LINES = 8  # at each end of a sweep and in its middle
PATCH, FACTOR = 16, 4

Floats = NDArray[np.float64]
Light = NDArray[np.float32]


@dataclass(frozen=True)
class FarmLines:
    """Lines of an outer sweep over a farm, as the decision sees that farm. ``blocks`` are of the sweep's own lines."""

    scene: RasterScene
    rig: Rig
    probe: Probe
    blocks: tuple[SweepBlock, ...]
    exact: Mapping[Effect, str]  # everything that the rig has, in its exact variant

    @property
    def values(self) -> float:
        sizes = (len(block.lines) * block.rig.camera.samples * len(block.wavelength_nm) for block in self.blocks)
        return float(sum(sizes))

    @property
    def footprint(self) -> dict[Effect, str]:
        """What the light of the scene passes on its way to the samples: rays, slit, smear and every blur, exact."""
        passed = {*RAYS, *BLURS}
        return {effect: variant for effect, variant in self.exact.items() if effect in passed}

    def light(self, chosen: Mapping[Any, str] | Choice) -> Light:
        """Expected electrons of all lines, (line, sample, band), with some effects on."""
        return np.concatenate([expected_light(self.scene, block, chosen) for block in self.blocks])


def look_at_lines(seed: int) -> FarmLines:
    """Draw a farm and plan its full scan; take the first, middle and last lines of the sweep that is planned first."""
    scene, rig = farm_scene(seed, SHAPE), Rig()
    sweeps = full_sweeps(SceneGrid(*SHAPE, PATCH, FACTOR), rig.camera, "x")
    probe = probe_scene(scene, rig, sweeps)
    count = sweeps[0].lines
    starts = (0, (count - LINES) // 2, count - LINES)
    blocks = tuple(sweep_block(scene, rig, sweeps[0], range(at, at + LINES), seed=seed) for at in starts)
    return FarmLines(scene, rig, probe, blocks, decide(probe, rig, EFFECTS, 0.0).exact)


def with_variant(chosen: Mapping[Effect, str], effect: Effect, variant: str) -> dict[Effect, str]:
    """Give the same effects with another variant of one of them, or without it."""
    changed = {one: variant if one is effect else its for one, its in chosen.items()}
    return {one: its for one, its in changed.items() if its != OFF}


@dataclass(frozen=True)
class Against:
    """Exact light, its noise, and how far other light is from it."""

    exact: Light  # [e-]
    noise: Light  # one sigma at each sample [e-]
    electrons_per_dn: float

    @staticmethod
    def of(exact: Light, rig: Rig) -> Against:
        return Against(exact, noise_electrons(exact, rig), rig.camera.electrons_per_dn)

    def greatest(self, light: Light) -> float:
        """Greatest change, in sigmas of the noise at the sample."""
        return max(float(np.abs(part).max()) for part in self._sigmas(light))

    def rms(self, light: Light) -> float:
        """Root of the mean square of the change, in the same sigmas."""
        squares = (float(np.square(part, dtype=np.float64).sum()) for part in self._sigmas(light))
        return float(np.sqrt(sum(squares) / light.size))

    def greatest_dn(self, light: Light) -> float:
        return float(np.abs(light - self.exact).max()) / self.electrons_per_dn

    def _sigmas(self, light: Light) -> Iterator[Light]:
        for changed, exact, noise in zip(light, self.exact, self.noise, strict=True):
            yield (changed - exact) / noise

    def levels(self) -> tuple[Level, ...]:
        """A tenth of the noise, and half a step of the converter at the darkest sample, where it is the largest."""
        return (
            Level("0.1 σ of noise", 0.1),  # noqa: RUF001
            Level("0.5 LSB at the darkest sample", 0.5 * self.electrons_per_dn / float(self.noise.min())),
        )


ERROR = "greatest change of a sample [σ of its noise]"  # noqa: RUF001
RMS, DN = "rms [σ]", "greatest [DN]"  # noqa: RUF001


EXACT = "exact"
TOLERANCES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # sigma
USUAL_TOLERANCE = 0.1
ALL_CHEAP = "all cheap"
CHOICES = (EXACT, *TOLERANCES, ALL_CHEAP)  # all effects exact, by a tolerance, all of them cheap

Raw = NDArray[np.uint16]


@dataclass(frozen=True)
class Chosen:
    """What is computed under a setting, and the bound on what that changes, in sigmas."""

    effects: Mapping[Effect, str]
    bound: float


@dataclass(frozen=True)
class Surveyed:
    """Lines of a farm and what samples show of them on average with everything on and exact."""

    lines: FarmLines
    against: Against
    chosen: dict[Setting, Chosen]  # decided once, as in a survey


def _prepare(seed: int) -> Surveyed:
    lines = look_at_lines(seed)
    against = Against.of(_shown(lines, lines.exact, lines.light(lines.exact)), lines.rig)
    return Surveyed(lines, against, {setting: _decided(lines, setting) for setting in CHOICES})


def _decided(lines: FarmLines, setting: Setting) -> Chosen:
    if setting == ALL_CHEAP:
        decision = decide(lines.probe, lines.rig, EFFECTS, USUAL_TOLERANCE)
        within = CHEAP_SHARE * decision.tolerance
        bound = sum(one.menu.cheapest_within(within).error for one in decision.taken if one.menu.present)
        return Chosen(decision.cheap, bound)
    decision = decide(lines.probe, lines.rig, EFFECTS, 0.0 if setting == EXACT else float(setting))
    return Chosen(decision.chosen, decision.error)


def _simulate(lines: FarmLines, chosen: Mapping[Effect, str]) -> tuple[Light, Raw]:
    """Expected electrons before the readout, and raw numbers, (line, sample, band) each."""
    light = [expected_light(lines.scene, block, chosen) for block in lines.blocks]
    raw = [read_out(one, block, chosen) for one, block in zip(light, lines.blocks, strict=True)]
    return np.concatenate(light), np.concatenate(raw)


def _shown(lines: FarmLines, chosen: Mapping[Effect, str], light: Light) -> Light:
    """Electrons that samples show on average, those of the dark among them."""
    dark = dark_frame(lines.blocks[0], chosen) * np.float32(lines.rig.camera.electrons_per_dn)
    return light + dark


def _judged(state: Surveyed, setting: Setting, made: tuple[Light, Raw]) -> Light:
    return _shown(state.lines, state.chosen[setting].effects, made[0])


TOLERANCE = Tradeoff(
    stage="simulate",
    knob="tolerance",
    error=ERROR,
    unit="px*band",
    reference="everything that the rig has, exact; on average over the noise",
    settings=CHOICES,
    prepare=_prepare,
    run=lambda state, setting: _simulate(state.lines, state.chosen[setting].effects),
    judge=lambda state, setting, made: state.against.greatest(_judged(state, setting, made)),
    work=lambda state, _setting: state.lines.values,
    levels=lambda state: state.against.levels(),
    beside={
        "bound [σ]": lambda state, setting, _made: state.chosen[setting].bound,  # noqa: RUF001
        RMS: lambda state, setting, made: state.against.rms(_judged(state, setting, made)),
        DN: lambda state, setting, made: state.against.greatest_dn(_judged(state, setting, made)),
    },
)


@dataclass(frozen=True)
class Seen:
    """Lines of a farm and their light through the footprint alone, exact."""

    lines: FarmLines
    against: Against


def prepare_footprint(seed: int) -> Seen:
    """Look at lines of a farm through the exact footprint."""
    lines = look_at_lines(seed)
    return Seen(lines, Against.of(lines.light(lines.footprint), lines.rig))


FOOTPRINT = Tradeoff(
    stage="simulate",
    knob="slit",
    error=ERROR,
    unit="px*band",
    reference=f"slit and pixel as {SLIT.variants[0]} boxes, all blurs of the rig",
    settings=(*SLIT.variants, OFF),
    prepare=prepare_footprint,
    run=lambda state, variant: state.lines.light(with_variant(state.lines.footprint, SLIT, str(variant))),
    judge=lambda state, _variant, light: state.against.greatest(light),
    work=lambda state, _variant: state.lines.values,
    levels=lambda state: state.against.levels(),
    beside={
        RMS: lambda state, _variant, light: state.against.rms(light),
        DN: lambda state, _variant, light: state.against.greatest_dn(light),
    },
)


LEVELS = 6
DIM_E, BRIGHT_SHARE = 100.0, 0.9  # of full scale: where usual light begins and ends
DRAWN_LINES = 800  # draws of a level: so many times the camera's samples
LEAST_EXPECTED = 10.0  # counts of a class of the chi-square test; rarer numbers are of their neighbours' class


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
    sweep = Sweep("even", "fine", "x", 0.0, 0.0, DRAWN_LINES)
    block = SweepBlock(
        rig, sweep, range(DRAWN_LINES), np.arange(1.0, LEVELS + 1), (DRAWN_LINES, rig.camera.samples), seed
    )
    light = np.broadcast_to(electrons.astype(np.float32), (DRAWN_LINES, rig.camera.samples, LEVELS)).copy()
    law = np.stack([law_of_numbers(float(one), rig) for one in electrons])
    return Counted(block, electrons, light, law, replace(look_at_lines(seed).probe, brightest_e=most_e))


def law_of_numbers(electrons: float, rig: Rig) -> Floats:
    """Give how probable each number of the converter is where so many electrons are expected, (DN,): Poisson counts,
    normal read noise, rounding, both ends of the converter. The read noise must not be 0.
    """
    camera = rig.camera
    reach = 9 * np.sqrt(electrons) + 30
    counts = np.arange(max(0, int(electrons - reach)), int(electrons + reach) + 1)
    edges = (np.arange(camera.full_scale_dn) + 0.5 - camera.dark_dn) * camera.electrons_per_dn
    weight = scipy.stats.poisson.pmf(counts, electrons)
    below = np.zeros(len(edges))
    for some in np.array_split(np.arange(len(counts)), -(-len(counts) // 256)):
        below += weight[some] @ scipy.special.ndtr((edges - counts[some, None]) / camera.read_noise_e)
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
    return float(np.abs(state.counts(raw) / state.draws - state.law).sum(axis=1).max()) / 2


def _by_chance(state: Counted) -> float:
    """Total variation of exact draws from the law, worst level: mean and three deviations of normal, free shares."""
    variance = state.law * (1 - state.law) / state.draws
    mean = np.sqrt(2 / np.pi) * np.sqrt(variance).sum(axis=1)
    spread = np.sqrt((1 - 2 / np.pi) * variance.sum(axis=1))
    return float((mean + 3 * spread).max()) / 2


def _bound(state: Counted, variant: Setting, _raw: Raw) -> float:
    """What the effect says of its variants; noise counts twice its total variation."""
    return SHOT.bound(state.probe, state.block.rig, str(variant)).value / 2


def _chi_square(state: Counted, _variant: Setting, raw: Raw) -> float:
    """How probable a chi-square as large is where the law holds, at the worst level."""
    found = []
    for seen, law in zip(state.counts(raw), state.law, strict=True):
        usual = np.flatnonzero(law * state.draws >= LEAST_EXPECTED)
        starts = np.concatenate([[0], usual[1:]])
        counted, wanted = np.add.reduceat(seen, starts), np.add.reduceat(law * state.draws, starts)
        found.append(float(scipy.stats.chi2.sf(((counted - wanted) ** 2 / wanted).sum(), len(usual) - 1)))
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
    off, _, variance = _moments(state, raw)
    return float((np.abs(off) / np.sqrt(variance)).max())


NOISE = Tradeoff(
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
DIM_NOISE = replace(
    NOISE,
    knob="shot noise, dim light",
    reference=f"the law of counts, read noise and rounding, 1 to {DIM_E:g} electrons",
    prepare=lambda seed: _even_light(seed, 1.0, DIM_E),
)
register_all(TOLERANCE, FOOTPRINT, NOISE, DIM_NOISE)

"""Trade-offs of the simulator's choice: the tolerance by which effects are left out, and the footprint's variants."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import full_sweeps
from pipeline.simulator.effects.effect import OFF, Effect, SweepBlock
from pipeline.simulator.effects.line import SLIT
from pipeline.simulator.effects.probe import Probe, noise_electrons
from pipeline.simulator.effects.registry import EFFECTS, RAYS
from pipeline.simulator.effects.registry import FOOTPRINT as BLURS
from pipeline.simulator.render import Choice, dark_frame, expected_light, read_out
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
        """Px times bands."""
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
        """Take light as the reference."""
        return Against(exact, noise_electrons(exact, rig), rig.camera.electrons_per_dn)

    def greatest(self, light: Light) -> float:
        """Greatest change, in sigmas of the noise at the sample."""
        return max(float(np.abs(part).max()) for part in self._sigmas(light))

    def rms(self, light: Light) -> float:
        """Root of the mean square of the change, in the same sigmas."""
        squares = (float(np.square(part, dtype=np.float64).sum()) for part in self._sigmas(light))
        return float(np.sqrt(sum(squares) / light.size))

    def greatest_dn(self, light: Light) -> float:
        """Greatest change [DN]."""
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


TOLERANCE = register(
    Tradeoff(
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


FOOTPRINT = register(
    Tradeoff(
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
)

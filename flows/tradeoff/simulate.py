"""Trade-offs of the simulator's choice: the tolerance by which effects are left out, and the footprint's variants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Setting, Tradeoff, register
from flows.tradeoff.simulated_lines import (
    DN,
    ERROR,
    RMS,
    Against,
    FarmLines,
    Light,
    errors_beside,
    look_at_lines,
    with_variant,
)
from pipeline.simulator.effects.effect import OFF, Effect
from pipeline.simulator.effects.line import SLIT
from pipeline.simulator.effects.registry import EFFECTS
from pipeline.simulator.render import dark_frame, expected_light, read_out
from pipeline.simulator.selection.choice import CHEAP_SHARE, Decision, decide

EXACT = "exact"
TOLERANCES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # sigma
USUAL_TOLERANCE = 0.1
ALL_CHEAP = "all cheap"

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
    chosen: dict[Setting, Chosen] = field(default_factory=dict)  # decided once, as in a survey

    def choice(self, setting: Setting) -> Chosen:
        """Decide for a tolerance; or take all effects, each exact or each cheap."""
        if setting not in self.chosen:
            self.chosen[setting] = _decided(self.lines, setting)
        return self.chosen[setting]


@dataclass(frozen=True)
class Simulated:
    """Expected electrons before the readout, and raw numbers, (line, sample, band) each."""

    light: Light
    raw: Raw


def _prepare(seed: int) -> Surveyed:
    lines = look_at_lines(seed)
    return Surveyed(lines, Against.of(_shown(lines, lines.exact, lines.light(lines.exact)), lines.rig))


def _decided(lines: FarmLines, setting: Setting) -> Chosen:
    if setting == ALL_CHEAP:
        decision = decide(lines.probe, lines.rig, EFFECTS, USUAL_TOLERANCE)
        return Chosen(decision.cheap, _cheap_bound(decision))
    decision = decide(lines.probe, lines.rig, EFFECTS, 0.0 if setting == EXACT else float(setting))
    return Chosen(decision.chosen, decision.error)


def _cheap_bound(decision: Decision) -> float:
    within = CHEAP_SHARE * decision.tolerance
    return sum(one.menu.cheapest_within(within).error for one in decision.taken if one.menu.present)


def _simulate(lines: FarmLines, chosen: Mapping[Effect, str]) -> Simulated:
    light = [expected_light(lines.scene, block, chosen) for block in lines.blocks]
    raw = [read_out(one, block, chosen) for one, block in zip(light, lines.blocks, strict=True)]
    return Simulated(np.concatenate(light), np.concatenate(raw))


def _shown(lines: FarmLines, chosen: Mapping[Effect, str], light: Light) -> Light:
    """Electrons that samples show on average, those of the dark among them."""
    dark = dark_frame(lines.blocks[0], chosen) * np.float32(lines.rig.camera.electrons_per_dn)
    return light + dark


def _judged(state: Surveyed, setting: Setting, made: Simulated) -> Light:
    return _shown(state.lines, state.choice(setting).effects, made.light)


TOLERANCE = register(
    Tradeoff(
        stage="simulate",
        knob="tolerance",
        error=ERROR,
        unit="px*band",
        reference="everything that the rig has, exact; on average over the noise",
        settings=(EXACT, *TOLERANCES, ALL_CHEAP),
        prepare=_prepare,
        run=lambda state, setting: _simulate(state.lines, state.choice(setting).effects),
        judge=lambda state, setting, made: state.against.greatest(_judged(state, setting, made)),
        work=lambda state, _setting: state.lines.values,
        levels=lambda state: state.against.levels(),
        beside={
            "bound [σ]": lambda state, setting, _made: state.choice(setting).bound,  # noqa: RUF001
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
        beside=errors_beside(lambda state: state.against),
    )
)

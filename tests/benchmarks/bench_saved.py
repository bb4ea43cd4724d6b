"""Processor time that leaving out effects saves: what receipts say beside what captures with all effects take more.

Every `EVERY`-th block of all sweeps is rendered, with the chosen effects and with all of them, in turn.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence

from measure import Row

from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.effect import Chosen
from spectralzoom.pipeline.simulator.render import EFFECTS
from spectralzoom.pipeline.simulator.selection.choice import decide
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_survey
from spectralzoom.pipeline.simulator.simulated import BLOCK_LINES, SimulatedSource

SCENES = ("farm", "scouting", "trial")
SEEDS = (73, 74)
ROUNDS = 3
EVERY = 16
WITHIN = 0.25


def seconds(source: SimulatedSource, sweeps: Sequence[Sweep]) -> float:
    """Return the processor time of rendering all lines of the sweeps, by some blocks of each [s]."""
    spent = 0.0
    for sweep in sweeps:
        source.render(sweep, range(1))  # makes the tables of the sweep
        starts = range(0, sweep.lines, EVERY * BLOCK_LINES)
        began = time.thread_time()
        lines = [len(source.render(sweep, range(sweep.lines)[start : start + BLOCK_LINES])) for start in starts]
        spent += (time.thread_time() - began) / max(sum(lines), 1) * sweep.lines
    return spent


def choices(plan: SurveyPlan) -> tuple[Chosen, Chosen]:
    """Return the effects that a survey chooses, and all that the rig has."""
    settings = plan.settings
    probes = probe_survey(plan.field.scene, settings.simulated_rig, plan.typical, settings.tol.unit, settings.cost)
    decision = decide(probes, settings.simulated_rig, EFFECTS, settings.tol.value)
    return decision.chosen, decision.exact


def rows() -> list[Row]:
    """Return a row for each scene and seed, of uniform scans of the default field and rig."""
    found = []
    for scene in SCENES:
        for seed in SEEDS:
            plan = plan_survey(open_field(load_settings(None, {"scene": scene, "seed": seed}), planning=True))
            chosen, exact = choices(plan)
            few, every = (plan.field.simulated.with_effects(one, {}) for one in (chosen, exact))
            sweeps = plan.passes.coarse
            said = few.saved_seconds(exact, sweeps)
            turns = [seconds(every, sweeps) - seconds(few, sweeps) for _ in range(ROUNDS)]
            measured = statistics.median(turns)
            figure = f"said {said:.1f} s, measured {measured:.1f} s"
            found.append(Row(f"{scene}, seed {seed}", figure, "25 %", abs(said / measured - 1) <= WITHIN))
    return found

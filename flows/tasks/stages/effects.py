"""The stage that decides which effects of the rig are simulated, and how: probed, decided and verified once, then kept.

Its store is one small table, the manifest: what was computed, what was left out, and why. The captures follow from it,
and nothing of the scene is drawn to read it. The coarse pass and the scan of everything stand for all sweeps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from flows.settings.survey_settings import plain_value
from flows.tasks.run import CaptureRun
from flows.tasks.stage import Product, Wanted, stage
from pipeline.errors import IncompleteStoreError
from pipeline.simulator.effects.effect import Effect, Radiance, SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT
from pipeline.simulator.effects.probe import Probe, unit_at
from pipeline.simulator.render import BY_NAME, EFFECTS, expected_light
from pipeline.simulator.selection.choice import TOTAL, Decision, decide, list_effects, sum_up
from pipeline.simulator.selection.survey_probe import probe_survey
from pipeline.simulator.selection.verification import candidate_blocks, verify, worst_blocks
from pipeline.simulator.simulated import SimulatedSource, sweep_block, sweep_starts
from storage.archive.keys import StageRef
from storage.archive.manifests import read_table
from storage.archive.whole_files import to_json

RECORD = "effects.json"
MANIFEST = Product("effects", version=8, files=(RECORD,))
FOOTPRINT = {
    ROTATION: ROTATION.variants[0],
    SLIT: SLIT.variants[-1],
}  # what lines are chosen by: the footprint alone, where lines really lie
DRAFT, VERIFIED = 0.3, 1.0


@stage("choose_effects", "effects that matter", MANIFEST)
def choose_effects(run: CaptureRun) -> Wanted:
    """Decide for scene and rig which effects to simulate, and check it on the worst lines of the scene.

    Where a rig takes the lines there is nothing to decide. Raises BoundError: what would be left out changes light by
    more than its bound says; SceneError: the scene holds a number that is not finite.
    """
    tolerance, asked = run.settings.tol, run.settings.effects

    def write(path: Path, manifest: dict[str, Any]) -> None:
        (path / RECORD).write_text(to_json(manifest), encoding="utf-8")

    if not run.source.simulates:
        return Wanted(lambda path: write(path, {"effects": [], "total": None}), {"source": run.source.name})

    def build(path: Path) -> None:
        """Look at the scene, choose and check."""
        rig = run.settings.simulated_rig
        probes = probe_survey(run.scene, rig, run.planned, tolerance.unit)
        decision = decide(probes, rig, EFFECTS, tolerance.value, asked)
        run.report(DRAFT)
        measured = _verified(run, decision, probes)
        write(path, {"effects": list_effects(decision, measured), "total": sum_up(decision, measured)})
        run.report(VERIFIED)

    params = {
        "scene": run.scene.key,
        "seed": run.settings.seed,  # of what is drawn for the lines
        "asked": asked,
        "tol": str(tolerance),
        "camera": asdict(run.camera),
        "rig": {
            name: plain_value(part) for name, part in asdict(run.settings.simulated_rig).items() if name != "camera"
        },
        "sweeps": [asdict(sweep) for sweep in run.planned],
    }
    return Wanted(build, params)


def load_manifest(effects: StageRef) -> dict[str, Any]:
    """Read what was decided: ``effects``, a row for each, and ``total``."""
    return read_table(effects.path / RECORD)


def chosen_effects(effects: StageRef) -> dict[Effect, str]:
    """Effects that are on, with variants, in the chain's order (IncompleteStoreError: one that is not known here)."""
    chosen: dict[Effect, str] = {}
    for row in load_manifest(effects)["effects"]:
        if row["state"] != "on":
            continue
        if row["name"] not in BY_NAME or row["variant"] not in BY_NAME[row["name"]].variants:
            raise IncompleteStoreError(
                f"{effects.uri} has the effect {row['name']}, {row['variant']}, which this version does not know;"
                " discard the store to have it made again"
            )
        chosen[BY_NAME[row["name"]]] = row["variant"]
    return chosen


def source_with(
    source: SimulatedSource, effects: StageRef, clock: Mapping[str, float] | None = None
) -> SimulatedSource:
    """Give the source with the effects that were decided; ``clock`` says when its sweeps start, by name [s]."""
    return replace(source, chosen=chosen_effects(effects), clock=clock)


def _verified(run: CaptureRun, decision: Decision, probes: Sequence[Probe]) -> dict[str, float]:
    """Measure what is left out on the worst lines of the scene, in the unit of the tolerance; nothing of everything."""
    if decision.chosen == decision.exact:
        return {TOTAL: 0.0}
    scene, rig = run.scene, run.settings.simulated_rig

    def units(light: Radiance, binning: int) -> Radiance:
        return unit_at(light, rig, decision.unit, binning)

    renders = 0

    def render(block: SweepBlock, chosen: Mapping[Effect, str]) -> Radiance:
        nonlocal renders
        renders += 1
        run.report(DRAFT + (VERIFIED - DRAFT) * renders / (renders + len(EFFECTS)))  # how many there will be is open
        return expected_light(scene, block, chosen)

    clock = sweep_starts(run.planned, run.camera, run.settings.cost)
    whole = [  # every sweep as one block, each after those before it
        sweep_block(scene, rig, sweep, range(sweep.lines), seed=run.settings.seed, started_s=clock[sweep.name])
        for sweep in run.planned
    ]
    candidates = [
        block
        for probe in probes
        for block in candidate_blocks([one for one in whole if one.sweep in probe.sweeps], probe.places)
    ]
    worst = worst_blocks(candidates, lambda block: expected_light(scene, block, FOOTPRINT), units)
    return verify(decision, render, worst, units)

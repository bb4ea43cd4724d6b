"""Define the stage that chooses the simulated effects: it probes, decides and verifies.

Its store is a table of simulated and omitted effects, with reasons. Captures depend on it. The coarse pass and the full
scan represent all sweeps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from flows.settings.survey_settings import plain_value
from flows.settings.values import Tolerance
from flows.tasks.scene import FieldSource
from flows.tasks.stage import Product, Report, Wanted, stage
from pipeline.errors import IncompleteStoreError
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.simulator.effects.effect import Effect, Radiance, SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT
from pipeline.simulator.effects.probe import Probe, unit_at
from pipeline.simulator.render import BY_NAME, EFFECTS, expected_light
from pipeline.simulator.rig_model import OF_THE_SCENE, Rig
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.selection.choice import TOTAL, Decision, decide, list_effects, sum_up
from pipeline.simulator.selection.survey_probe import probe_survey
from pipeline.simulator.selection.verification import candidate_blocks, verify, worst_blocks
from pipeline.simulator.simulated import SimulatedSource, sweep_block, sweep_starts
from storage.archive.keys import StageRef
from storage.archive.manifests import read_table
from storage.archive.whole_files import to_json

RECORD = "effects.json"
MANIFEST = Product("effects", version=10, files=(RECORD,))
FOOTPRINT = {ROTATION: ROTATION.variants[0], SLIT: SLIT.variants[-1]}  # effects that choose lines for verification
DRAFT, VERIFIED = 0.3, 1.0


@stage("choose_effects", "choice of effects", MANIFEST)
def choose_effects(
    *,
    source: FieldSource,
    scene: RasterScene,
    simulated_rig: Rig,
    planned: Sequence[Sweep],
    cost: CostModel,
    seed: int,
    effects: str,
    tol: Tolerance,
    report: Report,
) -> Wanted:
    """Choose the effects to simulate for scene and rig, and verify the choice on the worst lines of the scene.

    A real rig has no choice. Raises BoundError: omitted effects change light by more than their bound; SceneError: the
    scene has a value that is not finite.
    """

    def write(path: Path, manifest: dict[str, Any]) -> None:
        (path / RECORD).write_text(to_json(manifest), encoding="utf-8")

    if not source.simulates:
        return Wanted(lambda path: write(path, {"effects": [], "total": None}), {"source": source.name})

    def build(path: Path) -> None:
        """Probe the scene, choose effects, and verify them."""
        probes = probe_survey(scene, simulated_rig, planned, tol.unit)
        decision = decide(probes, simulated_rig, EFFECTS, tol.value, effects)
        report(DRAFT)
        measured = {TOTAL: 0.0}
        if decision.chosen != decision.exact:
            clock = sweep_starts(planned, simulated_rig.camera, cost)
            whole = [  # each sweep as one block
                sweep_block(scene, simulated_rig, sweep, range(sweep.lines), seed=seed, started_s=clock[sweep.name])
                for sweep in planned
            ]
            measured = _verified(scene, simulated_rig, decision, probes, whole, report)
        write(path, {"effects": list_effects(decision, measured), "total": sum_up(decision, measured)})
        report(VERIFIED)

    params = {
        "scene": scene.key,
        "seed": seed,
        "asked": effects,
        "tol": str(tol),
        "camera": asdict(simulated_rig.camera),
        "rig": {name: plain_value(part) for name, part in _parts(simulated_rig).items() if name != "camera"},
        "sweeps": [asdict(sweep) for sweep in planned],
    }
    return Wanted(build, params)


def _parts(rig: Rig) -> dict[str, Any]:
    """Return the rig as tables, without the light, which is in the key of the scene."""
    parts = asdict(rig)
    return parts | {"sky": {name: value for name, value in parts["sky"].items() if name not in OF_THE_SCENE}}


def load_manifest(effects: StageRef) -> dict[str, Any]:
    """Read the table of effects: ``effects``, a row for each, and ``total``."""
    return read_table(effects.path / RECORD)


def chosen_effects(effects: StageRef) -> dict[Effect, str]:
    """Return the chosen effects with their variants. Raises IncompleteStoreError: this version lacks one."""
    chosen: dict[Effect, str] = {}
    for row in load_manifest(effects)["effects"]:
        if row["state"] != "on":
            continue
        if row["name"] not in BY_NAME or row["variant"] not in BY_NAME[row["name"]].variants:
            raise IncompleteStoreError(
                f"{effects.uri} has the effect {row['name']}, {row['variant']}, which this version does not know;"
                " delete the store to compute it again"
            )
        chosen[BY_NAME[row["name"]]] = row["variant"]
    return chosen


def source_with(
    source: SimulatedSource, effects: StageRef, clock: Mapping[str, float] | None = None
) -> SimulatedSource:
    """Return the source with the chosen effects; ``clock`` has the start of each sweep by name [s]."""
    return replace(source, chosen=chosen_effects(effects), clock=clock)


def _verified(
    scene: RasterScene,
    rig: Rig,
    decision: Decision,
    probes: Sequence[Probe],
    whole: Sequence[SweepBlock],
    report: Report,
) -> dict[str, float]:
    """Measure the error of omitted effects on the worst lines of the sweeps, in the unit of the tolerance."""

    def units(light: Radiance, binning: int) -> Radiance:
        return unit_at(light, rig, decision.unit, binning)

    renders = 0

    def render(block: SweepBlock, chosen: Mapping[Effect, str]) -> Radiance:
        nonlocal renders
        renders += 1
        report(DRAFT + (VERIFIED - DRAFT) * renders / (renders + len(EFFECTS)))  # their number is not known before
        return expected_light(scene, block, chosen)

    candidates = [
        block
        for probe in probes
        for block in candidate_blocks([one for one in whole if one.sweep in probe.sweeps], probe.places)
    ]
    worst = worst_blocks(candidates, lambda block: expected_light(scene, block, FOOTPRINT), units)
    ends_e = [(probe.darkest_e, probe.brightest_e) for probe in probes]
    range_e = max(high for _, high in ends_e) - min(low for low, _ in ends_e)
    return verify(decision, render, worst, units, range_e)

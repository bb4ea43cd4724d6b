"""Define the stage that chooses the simulated effects: it probes the scene and decides.

Its store is a table of simulated and omitted effects, with reasons. Captures depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from spectralzoom.flows.settings.survey_settings import plain_value
from spectralzoom.flows.settings.values import Tolerance
from spectralzoom.flows.tasks.scene import FieldSource
from spectralzoom.flows.tasks.stage import Product, Report, Wanted, stage
from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep
from spectralzoom.pipeline.simulator.effects.effect import Effect
from spectralzoom.pipeline.simulator.render import BY_NAME, EFFECTS
from spectralzoom.pipeline.simulator.rig_model import OF_THE_SCENE, Rig
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.selection.choice import decide, list_effects, sum_up
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_survey
from spectralzoom.storage.store import Ref, read_table
from spectralzoom.storage.whole_files import to_json

RECORD = "effects.json"
MANIFEST = Product("effects", version=12, files=(RECORD,))


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
    """Choose the effects to simulate for scene and rig.

    A real rig has no choice. Raises SceneError: the scene has a value that is not finite.
    """

    def write(path: Path, manifest: dict[str, Any]) -> None:
        (path / RECORD).write_text(to_json(manifest), encoding="utf-8")

    if not source.simulates:
        return Wanted(lambda path: write(path, {"effects": [], "total": None}), {"source": source.name})

    def build(path: Path) -> None:
        """Probe the scene and choose effects."""
        probes = probe_survey(scene, simulated_rig, planned, tol.unit, cost)
        decision = decide(probes, simulated_rig, EFFECTS, tol.value, effects)
        write(path, {"effects": list_effects(decision), "total": sum_up(decision)})
        report(1.0)

    params = {
        "scene": scene.key,
        "seed": seed,
        "asked": effects,
        "tol": str(tol),
        "camera": asdict(simulated_rig.camera),
        "rig": {name: plain_value(part) for name, part in _parts(simulated_rig).items() if name != "camera"},
        "sweeps": [asdict(sweep) for sweep in planned],
        "cost": asdict(cost),
    }
    return Wanted(build, params)


def _parts(rig: Rig) -> dict[str, Any]:
    """Return the rig as tables, without the light, which is in the key of the scene."""
    parts = asdict(rig)
    return parts | {"sky": {name: value for name, value in parts["sky"].items() if name not in OF_THE_SCENE}}


def load_manifest(effects: Ref) -> dict[str, Any]:
    """Read the table of effects: ``effects``, a row for each, and ``total``."""
    return read_table(effects.path / RECORD)


def chosen_effects(effects: Ref) -> dict[Effect, str]:
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

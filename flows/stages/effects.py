"""Choose the simulated effects: probe the scene, and decide.

The store is a table of simulated and omitted effects, with reasons. Captures depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from spectralzoom.flows.stage import Output, stage
from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep
from spectralzoom.pipeline.simulator.effects.effect import Effect
from spectralzoom.pipeline.simulator.effects.probe import Tolerance
from spectralzoom.pipeline.simulator.render import BY_NAME, EFFECTS
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.selection.choice import decide, list_effects, sum_up
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_survey
from spectralzoom.storage.store import Ref, read_table
from spectralzoom.storage.whole_files import to_json, write_new

RECORD = "effects.json"


@stage("choice of effects", version=14, product="effects", made_by=("pipeline/simulator",))
def choose_effects(
    out: Output, *, scene: RasterScene, rig: Rig, sweeps: Sequence[Sweep], cost: CostModel, asked: str, tol: Tolerance
) -> None:
    """Choose the effects to simulate for scene and rig. Raises SceneError: the scene has a value that is not finite."""
    probes = probe_survey(scene, rig, sweeps, tol.unit, cost)
    decision = decide(probes, rig, EFFECTS, tol.value, asked)
    text = to_json({"effects": list_effects(decision), "total": sum_up(decision)})
    write_new(out.path / RECORD, text)
    out.report(1.0)


def load_manifest(effects: Ref) -> dict[str, Any]:
    """Read the table of effects: ``effects``, a row for each, and ``total``."""
    return read_table(effects.path / RECORD)


def chosen_effects(effects: Ref, *, exact: bool = False) -> dict[Effect, str]:
    """Return the chosen effects with their variants, or all that the rig has as ``exact`` ones.

    Raises IncompleteStoreError: this version lacks one.
    """
    chosen: dict[Effect, str] = {}
    for row in load_manifest(effects)["effects"]:
        if exact and row["reason"] != "absent" and row["name"] in BY_NAME:
            row = {**row, "state": "on", "variant": BY_NAME[row["name"]].variants[0]}
        if row["state"] != "on":
            continue
        if row["name"] not in BY_NAME or row["variant"] not in BY_NAME[row["name"]].variants:
            raise IncompleteStoreError(
                f"{effects.uri} has the effect {row['name']}, {row['variant']}, which this version does not know;"
                " delete the store to compute it again"
            )
        chosen[BY_NAME[row["name"]]] = row["variant"]
    return chosen

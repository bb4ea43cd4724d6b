"""Defaults of a survey of recorded sweeps: those of the run that took them, where an archive tells.

So `survey --sweeps ARCHIVE/runs/NAME` alone plans as that run did, and draws the same map. Cubes of files know nothing
of a survey: without a budget or a scan every recorded line is read as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flows.settings.survey_settings import BUILT_IN_SCENES, OF_TWO_PASSES, PLAIN, RECORDED, RIG_FIELD, SPARING
from storage.readers.recorded_runs import find_recorded_run

OF_THE_PLAN = (*PLAIN, *OF_TWO_PASSES, *SPARING, "scan_exposure_ms", "look")
OF_THE_RUN = ("camera", "cost", "rig", "pose", "map", "zones", "kernel", "pointing_px", "seed", "weights", "unknown")
BUILT_IN_WEIGHTS = "farm"


def usual_of_recording(table: Mapping[str, object]) -> dict[str, Any]:
    """Return what the settings beside ``sweeps`` are by default.

    Raises SceneError, ArchiveError: there is no such recording, or no run of it.
    """
    if table.get("source", RECORDED) != RECORDED:
        return {}
    usual: dict[str, Any] = {"source": RECORDED, "scene": RIG_FIELD}
    asked = {name for name in OF_THE_PLAN if table.get(name) is not None}
    found = find_recorded_run(str(table["sweeps"]))
    if found is not None:
        run, shape = found
        uniform = any(run.settings.get(name) is not None for name in PLAIN)
        another_plan = asked if uniform else asked & set(PLAIN)
        names = OF_THE_RUN if another_plan else (*OF_THE_RUN, *OF_THE_PLAN)
        usual |= {name: run.settings[name] for name in names if run.settings.get(name) is not None}
        usual |= {"name": str(run.receipt.get("survey") or run.folder.name)}
        usual |= {} if shape is None else {"size": shape[::-1]}
        if run.settings.get("weights") is None and run.settings.get("scene") in BUILT_IN_SCENES:
            usual["weights"] = BUILT_IN_WEIGHTS
    elif not asked:
        usual["scan"] = RECORDED
    return usual

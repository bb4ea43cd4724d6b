"""What a choice of effects rests on, remembered: half of a small survey's time, and the same for the same question.

Only what is pure is kept, the look at the scene and the measured changes; the decision itself and its store are made
each time. Tests whose subject is the choice, or that surveys repeat themselves, put `WORKED_OUT` back.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flows.survey import effect_choice

WORKED_OUT: dict[str, Callable[..., Any]] = {
    name: getattr(effect_choice, name) for name in ("probe_survey", "_verified")
}


def remember(folder: Path, put: Callable[[object, str, Any], None] = setattr) -> None:
    """Have the stage look each question up in a folder, which several processes may share, before it works it out."""
    folder.mkdir(parents=True, exist_ok=True)

    def known(question: object, work_out: Callable[[], Any]) -> Any:
        path = folder / hashlib.sha256(repr(question).encode()).hexdigest()
        if path.exists():
            return pickle.loads(path.read_bytes())
        found = work_out()
        fresh = path.with_suffix(f".{os.getpid()}")
        fresh.write_bytes(pickle.dumps(found))
        fresh.replace(path)
        return found

    def probed(scene: Any, *given: Any) -> Any:
        return known((scene.key, given), lambda: WORKED_OUT["probe_survey"](scene, *given))

    def verified(run: Any, decision: Any, probes: Any) -> Any:
        told = run.settings
        question = run.scene.key, run.planned, told.simulated_rig, told.seed, told.cost, told.effects, told.tol
        return known(question, lambda: WORKED_OUT["_verified"](run, decision, probes))

    put(effect_choice, "probe_survey", probed)
    put(effect_choice, "_verified", verified)

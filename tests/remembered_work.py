"""What takes most of a small survey's time and is the same for the same question, remembered.

Only what is pure is kept: the look at the scene that a choice of effects rests on, the changes that were measured, and
the picture of what was stored. Decision, stores, receipt and run are made each time. Tests that surveys repeat
themselves put `WORKED_OUT` back.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from flows.publish import run_folder
from flows.survey.stages import effects as effect_choice

PURE = {effect_choice: ("probe_survey", "_verified"), run_folder: ("draw_quicklook",)}
WORKED_OUT: dict[str, tuple[ModuleType, Any]] = {
    name: (module, getattr(module, name)) for module, names in PURE.items() for name in names
}


def remember(folder: Path, put: Callable[[object, str, Any], None] = setattr) -> None:
    """Have surveys look each question up in a folder, which several processes may share, before they work it out."""
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
        return known((scene.key, given), lambda: WORKED_OUT["probe_survey"][1](scene, *given))

    def verified(run: Any, decision: Any, probes: Any) -> Any:
        told = run.settings
        question = run.scene.key, run.planned, told.simulated_rig, told.seed, told.cost, told.effects, told.tol
        return known(question, lambda: WORKED_OUT["_verified"][1](run, decision, probes))

    def drawn(path: Path, panels: Any) -> None:
        fresh: list[bytes] = []

        def draw() -> bytes:
            WORKED_OUT["draw_quicklook"][1](path, panels)
            fresh.append(path.read_bytes())
            return fresh[0]

        picture = known(hashlib.sha256(pickle.dumps(panels)).hexdigest(), draw)
        if not fresh:  # as often as a picture that is drawn: tests count what is written
            path.write_bytes(picture)

    for name, remembering in {"probe_survey": probed, "_verified": verified, "draw_quicklook": drawn}.items():
        put(WORKED_OUT[name][0], name, remembering)

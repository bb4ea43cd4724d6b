"""The choice of a rig's effects remembered: half of a small survey's time, and the same for the same question."""

from __future__ import annotations

import hashlib
import json
import os
from functools import wraps
from pathlib import Path
from typing import Any

from flows.survey.effect_choice import RECORD
from flows.survey.survey import STAGES

CHOICE = "choose_effects"
worked_out = STAGES[CHOICE]  # the product's own stage


def remembering(folder: Path) -> Any:
    """The stage that works out each choice once, and writes the same bytes where it is asked for again.

    Questions are told apart by what the stage itself keys its store with. Tests whose subject is the choice, or that a
    survey is repeatable, put `worked_out` back.
    """
    folder.mkdir(parents=True, exist_ok=True)

    @wraps(worked_out)
    def choose(run: Any, produce: Any) -> Any:
        def ask(name: str, build: Any, params: Any, refs: Any) -> Any:
            question = json.dumps(params, sort_keys=True, default=str).encode()
            known = folder / hashlib.sha256(question).hexdigest()

            def answer(path: Path) -> None:
                if known.exists():
                    (path / RECORD).write_bytes(known.read_bytes())
                    return
                build(path)
                fresh = known.with_suffix(f".{os.getpid()}")
                fresh.write_bytes((path / RECORD).read_bytes())
                fresh.replace(known)

            return produce(name, answer, params, refs)

        return worked_out(run, ask)

    return choose

"""What takes most of a small survey's time and is the same for the same question, remembered.

Only what is pure is kept: the look at the scene that a choice of effects rests on, and the choice, which each process
remembers by itself. Of pictures one of each kind is drawn and packed, and stands
for all of that kind. Stores, receipt and run are made each time. Tests that ask nothing of effects have no scene
looked at: `without_effects`.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from flows.publish import run_folder
from flows.publish.quicklook import QuicklookData
from flows.tasks.stages import effects as effect_choice
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import uniform_sweeps
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import raster_from_values

PURE = {effect_choice: ("probe_survey", "decide"), run_folder: ("draw_quicklook",)}
WORKED_OUT: dict[str, tuple[ModuleType, Any]] = {
    name: (module, getattr(module, name)) for module, names in PURE.items() for name in names
}
REMEMBERING: dict[str, tuple[ModuleType, Any]] = {}


def remember(folder: Path, put: Callable[[object, str, Any], None] = setattr) -> None:
    """Have surveys look each question up in a folder, which several processes may share, before they work it out."""
    folder.mkdir(parents=True, exist_ok=True)

    def known(question: object, work_out: Callable[[], Any]) -> Any:
        path = folder / hashlib.sha256(repr(question).encode()).hexdigest()
        if path.exists():
            return pickle.loads(path.read_bytes())
        found, fresh = work_out(), path.with_suffix(f".{os.getpid()}")
        fresh.write_bytes(pickle.dumps(found))
        fresh.replace(path)
        return found

    def probed(scene: Any, *given: Any) -> Any:
        return known((scene.key, given), lambda: WORKED_OUT["probe_survey"][1](scene, *given))

    decisions: dict[bytes, Any] = {}

    def decided(probes: Any, rig: Any, effects: Any, *given: Any) -> Any:
        question = pickle.dumps((probes, rig, given))
        if question not in decisions:
            decisions[question] = WORKED_OUT["decide"][1](probes, rig, effects, *given)
        return decisions[question]

    def drawn(panels: Any) -> Any:
        return known(_kind_of(panels), lambda: WORKED_OUT["draw_quicklook"][1](panels))

    each = {"probe_survey": probed, "decide": decided, "draw_quicklook": drawn}
    for name, remembering in each.items():
        REMEMBERING[name] = (WORKED_OUT[name][0], remembering)
        put(WORKED_OUT[name][0], name, remembering)


def _kind_of(panels: QuicklookData) -> object:
    """What decides how a picture is drawn, but for the numbers that it shows."""
    there = panels.truth is None, panels.confidence is None, panels.class_colours is None
    holes = tuple(bool(np.isnan(shown).any()) for shown in (panels.rectified, panels.score))
    none = np.size(panels.patch_index) == 0
    return "picture", panels.class_map.shape, panels.class_names, there, holes, none


@contextmanager
def without_effects() -> Iterator[None]:
    """Surveys look at no scene and simulate no effect but those that their settings name, in any of their variants."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(effect_choice, "probe_survey", lambda scene, rig, planned, unit, cost: _any_probes(unit))
        patch.setattr(
            effect_choice,
            "decide",
            lambda *told: REMEMBERING["decide"][1](*told[:-1], "none" if told[-1] == "auto" else told[-1]),
        )
        yield


@contextmanager
def with_effects() -> Iterator[None]:
    """Surveys choose their effects as they do where nothing else is said."""
    with pytest.MonkeyPatch.context() as patch:
        for name, (module, remembering) in REMEMBERING.items():
            patch.setattr(module, name, remembering)
        yield


@cache
def _any_probes(unit: Any) -> Any:
    """What a look at the smallest scene finds, for decisions that no test reads."""
    camera = LineCamera()
    scene = raster_from_values(np.full((32, 32, 3), 0.5), camera, name="t", wavelength_nm=np.linspace(460, 640, 3))
    sweeps = uniform_sweeps(SceneGrid(32, 32, 8), camera, "x", step=4)
    return REMEMBERING["probe_survey"][1](scene, Rig(camera), sweeps, unit)

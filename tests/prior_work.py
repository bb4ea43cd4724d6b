"""Remember the slow, repeatable parts of small surveys: the choice of effects and the drawing of pictures.

Only pure functions are kept: the probes of a scene that the choice of effects needs, and the choice, which each process
remembers by itself. One picture of each kind is drawn and packed, and stands for all pictures of that kind. Stores,
receipt and run are made each time. Tests that do not depend on effects skip the probes:
`without_effects`.
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

from spectralzoom.flows.publish import run_folder
from spectralzoom.flows.publish.quicklook import QuicklookData
from spectralzoom.flows.stages import effects as effect_choice
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.planning.coverage import uniform_sweeps
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import raster_from_values

PURE = {effect_choice: ("probe_survey", "decide"), run_folder: ("draw_quicklook",)}
WORKED_OUT: dict[str, tuple[ModuleType, Any]] = {
    name: (module, getattr(module, name)) for module, names in PURE.items() for name in names
}
REMEMBERING: dict[str, tuple[ModuleType, Any]] = {}


def remember(folder: Path, put: Callable[[object, str, Any], None] = setattr) -> None:
    """Make surveys look up results in a folder, which processes may share, before they compute them."""
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
    """Return the properties that decide how a picture is drawn, without the values that it shows."""
    there = (
        panels.truth is None,
        panels.again is None,
        panels.read is None,
        panels.gain is None,
        panels.class_colours is None,
    )
    holes = bool(np.isnan(panels.rectified).any())
    return "picture", panels.class_map.shape, panels.class_names, there, holes


@contextmanager
def without_effects() -> Iterator[None]:
    """Skip the probes of scenes; surveys simulate only effects that their settings name, in any of their variants."""
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
    """Let surveys choose their effects automatically, as by default."""
    with pytest.MonkeyPatch.context() as patch:
        for name, (module, remembering) in REMEMBERING.items():
            patch.setattr(module, name, remembering)
        yield


@cache
def _any_probes(unit: Any) -> Any:
    """Return the probes of the smallest scene, for decisions that no test reads."""
    camera = LineCamera()
    scene = raster_from_values(np.full((32, 32, 3), 0.5), camera, name="t", wavelength_nm=np.linspace(460, 640, 3))
    sweeps = uniform_sweeps(SceneGrid(32, 32, 8), camera, "x", step=4)
    return REMEMBERING["probe_survey"][1](scene, Rig(camera), sweeps, unit)

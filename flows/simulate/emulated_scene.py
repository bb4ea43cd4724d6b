"""What an emulated rig looks at: a scene of the settings, with the effects that a survey of it would choose."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flows.settings.survey_settings import Settings
from flows.simulate.command import open_simulation
from flows.survey.effect_choice import choose_effects, source_with
from flows.survey.stages import VERSIONS, Build
from pipeline.simulator.simulated import SimulatedSource
from storage.archive.archive import Archive, StageRef


@dataclass
class _Once:
    """Builds stores in an archive that is thrown away."""

    archive: Archive

    def __call__(self, name: str, build: Build, params: Mapping[str, Any], inputs: Sequence[StageRef]) -> StageRef:
        """Make the store of one stage."""
        keys = [given.key for given in inputs]
        return self.archive.produce(name, build, version=VERSIONS[name], params=params, inputs=keys)[0]


def emulated_source(settings: Settings) -> tuple[SimulatedSource, tuple[str, ...]]:
    """Give the scene through the simulated rig, and what was assumed of it. Nothing is kept.

    Raises
    ------
    PipelineError : the scene or the effects cannot be used.
    """
    with tempfile.TemporaryDirectory(prefix="spectralzoom-") as folder:
        apart = replace(settings, source="sim", out=str(Path(folder) / "effects"))
        run, _, notes = open_simulation(apart)
        return source_with(run.source, choose_effects(run, _Once(run.archive))), notes

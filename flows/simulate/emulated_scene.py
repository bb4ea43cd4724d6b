"""What an emulated rig looks at: a scene of the settings, with the effects that a survey of it would choose."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from flows.settings.survey_settings import Settings
from flows.simulate.command import open_simulation
from flows.survey.stages.effects import choose_effects, source_with
from pipeline.simulator.simulated import SimulatedSource


def emulated_source(settings: Settings) -> tuple[SimulatedSource, tuple[str, ...]]:
    """Give the scene through the simulated rig, and what was assumed of it. Nothing is kept.

    Raises
    ------
    PipelineError : the scene or the effects cannot be used.
    """
    with tempfile.TemporaryDirectory(prefix="spectralzoom-") as folder:
        apart = replace(settings, source="sim", out=str(Path(folder) / "effects"))
        run, _, notes = open_simulation(apart)
        effects, _ = choose_effects.produce(run.archive, choose_effects.needed(run))
        return source_with(run.simulated, effects), notes

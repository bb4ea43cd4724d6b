"""Who looks at the field for a survey: the simulator, or the rig that the settings name, behind one seam."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from flows.settings.survey_settings import Settings
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import Effect
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import Source


class FieldSource(Protocol):
    """Who looks at the field for a survey: the one seam between what is simulated and what is there."""

    @property
    def name(self) -> str:
        """What the receipt calls it."""

    @property
    def simulates(self) -> bool:
        """Whether effects are chosen for it, which then stand in what is stored of its lines."""

    def key(self, field: str) -> dict[str, Any]:
        """What its light depends on, beside scene, camera, seed, sweeps and effects."""

    def saying(self, say: Callable[[str], None]) -> FieldSource:
        """The same, telling somebody what it is at while no line comes."""

    def lit(self, chosen: Mapping[Effect, str], clock: Mapping[str, float]) -> FieldSource:
        """The same with the effects that were decided, and when sweeps start by name [s]."""

    def opened(self, spool: Path) -> AbstractContextManager[Source]:
        """What lines come from, held on to; what it keeps on the way goes beside the lines in ``spool``."""


@dataclass(frozen=True)
class SimulatedField:
    """The simulated rig before a scene."""

    source: SimulatedSource
    simulates = True

    @property
    def name(self) -> str:
        return self.source.name

    def key(self, field: str) -> dict[str, Any]:
        return {}

    def saying(self, say: Callable[[str], None]) -> SimulatedField:
        return self  # lines come all the time

    def lit(self, chosen: Mapping[Effect, str], clock: Mapping[str, float]) -> SimulatedField:
        return SimulatedField(replace(self.source, chosen=chosen, clock=clock))

    def opened(self, spool: Path) -> AbstractContextManager[Source]:
        return nullcontext(self.source)


def field_source(
    scene: RasterScene, settings: Settings, simulated: SimulatedSource, planned: Sequence[Sweep]
) -> FieldSource:
    """Give who looks, as the settings say; raises what `flows.survey.rig_field.rig_field` does."""
    if settings.source != "rig":
        return SimulatedField(simulated)
    from flows.survey.rig_field import rig_field  # drivers load pyserial and scipy, which others do without

    return rig_field(scene, settings, planned)


def for_rig(settings: Settings) -> Settings:
    """Give the settings of a survey through a rig: this look at the field has a name, and no control is simulated."""
    if settings.source != "rig":
        return settings
    return replace(settings, visit=settings.visit or f"{datetime.now(UTC):%Y-%m-%d}", controls=False)

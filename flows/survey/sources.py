"""Who looks at the field for a survey: the simulator, or the rig that the settings name, behind one seam."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from flows.settings.survey_settings import Settings
from pipeline.geometry.mounting import STRAIGHT
from pipeline.geometry.scan import Sweep, sweep_positions
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.camera.camera_settings import CameraLimits, check_times
from pipeline.rig.clock import SYSTEM_CLOCK, Clock
from pipeline.simulator.effects.effect import Effect
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import Source
from storage.arrays.fetched_files import FetchedFiles

if TYPE_CHECKING:
    from pipeline.rig.capture.capture_runner import RigDevices
    from pipeline.rig.capture.rig_source import RigSource

FETCHED = "camera"  # folder within a capture's spool


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


@dataclass(frozen=True)
class RigField:
    """The rig that the settings name. Its effects are its own; what its camera gives is kept beside the lines."""

    rig: RigSource
    name = "rig"
    simulates = False

    def key(self, field: str) -> dict[str, Any]:
        mounting = self.rig.rig.mounting
        return {"field": field} | ({} if mounting == STRAIGHT else {"mounting": asdict(mounting)})

    def saying(self, say: Callable[[str], None]) -> RigField:
        return RigField(self.rig.saying(say))

    def lit(self, chosen: Mapping[Effect, str], clock: Mapping[str, float]) -> RigField:
        return self

    @contextmanager
    def opened(self, spool: Path) -> Iterator[Source]:
        source = self.rig.keeping(FetchedFiles(spool / FETCHED))
        with source.session():
            yield source


def field_source(
    scene: RasterScene, settings: Settings, simulated: SimulatedSource, planned: Sequence[Sweep]
) -> FieldSource:
    """Give who looks, as the settings say. Of a rig nothing is connected before its first line.

    Raises
    ------
    SettingsError : exposure and frame period are nothing that the camera takes.
    PoseError : the mirror, as mounted, does not reach all of the planned sweeps.
    """
    if settings.source != "rig":
        return SimulatedField(simulated)
    from pipeline.rig.capture.rig_source import RigSource, RigView  # drivers load pyserial, which others do without

    camera = settings.camera
    check_times(camera.exposure_ms, camera.frame_ms, CameraLimits(most_rate_hz=camera.max_rate_hz))
    if settings.rig.mounting != STRAIGHT:
        for sweep in planned:
            settings.rig.mounting.to_device(sweep_positions(sweep, camera))
    view = RigView(camera, scene.wavelength_nm, scene.shape)
    pairs = settings.cost.vector_pairs
    return RigField(
        RigSource(view, lambda: open_devices(settings), KeptInMemory(), rig=settings.rig, vector_pairs=pairs)
    )


def open_devices(settings: Settings, clock: Clock = SYSTEM_CLOCK) -> RigDevices:
    """Connect to mirror and camera; nothing moves.

    Raises
    ------
    DeviceGone : no such port, in use, not permitted, or the camera is not there. DeadlinePassed : nothing answers.
    RigError : another device does.
    """
    from pipeline.rig.camera.headwall_camera import HeadwallCamera  # these three load pyserial too
    from pipeline.rig.capture.capture_runner import RigDevices
    from pipeline.rig.mirror.mirror_controller import open_mirror

    rig = settings.rig
    mirror = open_mirror(rig.mirror(settings.cost.vector_pairs), clock, known=True)
    limits = CameraLimits(most_rate_hz=settings.camera.max_rate_hz)
    camera = HeadwallCamera.at(rig.camera, rig.files, limits=limits, clock=clock)
    devices = RigDevices(mirror, camera, clock)
    try:
        camera.is_capturing()
    except BaseException:
        devices.close()
        raise
    return devices


def for_rig(settings: Settings) -> Settings:
    """Give the settings of a survey through a rig: this look at the field has a name, and no control is simulated."""
    if settings.source != "rig":
        return settings
    return replace(settings, visit=settings.visit or f"{datetime.now(UTC):%Y-%m-%d}", controls=False)

"""A small scene in front of an emulated rig in this process, and the rig as a source of lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import STRAIGHT, Mounting
from pipeline.geometry.scan import Sweep
from pipeline.rig.camera.camera_files import Kept, KeptInMemory
from pipeline.rig.device_settings import SurveyRig
from pipeline.rig.drivers import RigDevices
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.pro_mode import Command
from pipeline.rig.rig_source import RigSource
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import raster_from_values
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import Line
from tests.pipeline.rig.camera_faults import CameraFault, CameraFaults, FaultyRig
from tests.pipeline.rig.in_process import InProcessRig, ManualClock
from tests.pipeline.rig.mirror_faults import Fault
from tests.pipeline.simulator.small_scenes import effects_on

CAMERA = LineCamera(samples=48)
NAMES = ("rotation", "slit", "smear", "vignetting", "shot", "read-noise")
COARSE = Sweep("coarse-0", "coarse", "x", 0.0, -21.5, 10, 4, 4)
FINE = Sweep("fine-3", "fine", "x", 3.25, -7.5, 17)


def small_source(**changed: Any) -> SimulatedSource:
    """Return a simulated source of 40 x 48 px and 3 bands, with usual effects."""
    values = np.random.default_rng(11).uniform(20, 200, (40, 48, 3))
    scene = raster_from_values(values, CAMERA, name="small", wavelength_nm=np.array([460.0, 550.0, 640.0]))
    return replace(SimulatedSource(scene, Rig(CAMERA), 5, effects_on(*NAMES)), **changed)


def set_anything(mirror: MirrorDevice) -> bool:
    """Return whether any register or vector of the mirror was set."""
    return any(request.command in (Command.SET_VALUES, Command.SET_VECTOR) for request in mirror.requests)


@cache
def simulated_lines(sweep: Sweep) -> list[Line]:
    """Return the simulated source's lines of a sweep, cached."""
    return list(small_source().lines(sweep))


def assert_simulated(found: Sequence[Line], sweep: Sweep, first: int = 0) -> None:
    """Assert the numbers of the simulated source's lines from ``first`` on, bit for bit and in order."""
    expected = simulated_lines(sweep)[first:]
    assert [line.number for line in found] == [line.number for line in expected]
    np.testing.assert_array_equal([line.data for line in found], [line.data for line in expected])


@dataclass
class SmallRig:
    """An emulated rig and the settings of its sources."""

    line: InProcessRig
    settings: SurveyRig
    vector_pairs: int
    wavelength_nm: NDArray[np.float64]
    opened: int = 0

    @property
    def emulated(self) -> FaultyRig:
        """Return both emulated devices."""
        return cast("FaultyRig", self.line.rig)

    @property
    def captures(self) -> list[str]:
        """Return the capture commands that the camera received, without references."""
        return [said for said in self.emulated.camera.commands if "capture(" in said and "references" not in said]

    def devices(self) -> RigDevices:
        """Connect to both devices."""
        self.opened += 1
        return self.line.devices(self.settings, self.vector_pairs)

    def source(self, kept: Kept | None = None) -> RigSource:
        """Return a source that captures with the rig; each call acts as another process."""
        return RigSource(
            self.emulated.camera.view.source.camera,
            self.wavelength_nm,
            self.emulated.camera.view.source.field_shape,
            self.devices,
            KeptInMemory() if kept is None else kept,
            rig=self.settings,
            vector_pairs=self.vector_pairs,
        )


@contextmanager
def small_rig(
    source: SimulatedSource | None = None,
    *,
    faults: dict[CameraFault, int] | None = None,
    passes: int = 0,
    mirror_faults: list[Fault] | tuple[Fault, ...] = (),
    vector_pairs: int = 1500,
    mounting: Mounting = STRAIGHT,
    **settings: Any,
) -> Iterator[SmallRig]:
    """Yield an emulated rig in front of a source's scene, with its mirror mounted as ``mounting``.

    Settings and cable have one pulse per held position, and requests to the mirror a CRC, unless ``settings`` differ.
    """
    told = {"pulses": "position", "with_crc": True, **settings}
    viewed = small_source() if source is None else source
    clock = ManualClock(50.0)
    camera_faults = CameraFaults(dict(faults or {}), 0, passes)
    rig = FaultyRig(
        viewed, clock, mirror_faults=mirror_faults, wired=told["pulses"], camera_faults=camera_faults, mounting=mounting
    )
    with InProcessRig(rig) as line:
        yield SmallRig(line, SurveyRig(**told), vector_pairs, viewed.wavelength_nm)

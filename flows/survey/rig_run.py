"""A survey through the rig that the settings name: its devices, its field, and where what comes of them is kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from flows.settings.survey_settings import RIG_FIELD, Settings
from pipeline.errors import SettingsError
from pipeline.geometry.mounting import STRAIGHT
from pipeline.geometry.scan import Sweep, sweep_positions
from pipeline.lazy import Once
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.camera.camera_settings import CameraLimits, check_times
from pipeline.rig.clock import SYSTEM_CLOCK, Clock
from pipeline.simulator.raster import Light, Raster
from pipeline.simulator.scene import RasterScene
from pipeline.source import Line, Source
from storage.arrays.fetched_files import FetchedFiles

if TYPE_CHECKING:
    from flows.survey.run import CaptureRun
    from pipeline.rig.capture.capture_runner import RigDevices
    from pipeline.rig.capture.rig_source import RigSource

FETCHED = "camera"  # folder within a capture's spool
RIG_RECORD = "rig.json"  # in a capture's store, beside its cubes


def rig_source(scene: RasterScene, settings: Settings, planned: Sequence[Sweep]) -> RigSource:
    """Give the rig as a source of lines; nothing is connected before the first of them.

    Raises
    ------
    SettingsError : exposure and frame period are nothing that the camera takes.
    PoseError : the mirror, as mounted, does not reach all of the planned sweeps.
    """
    from pipeline.rig.capture.rig_source import RigSource, RigView  # drivers load scipy, which a plan does without

    camera = settings.camera
    check_times(camera.exposure_ms, camera.frame_ms, CameraLimits(most_rate_hz=camera.max_rate_hz))
    if settings.rig.mounting != STRAIGHT:
        for sweep in planned:
            settings.rig.mounting.to_device(sweep_positions(sweep, camera))
    view = RigView(camera, scene.wavelength_nm, scene.shape)
    return RigSource(
        view, lambda: open_devices(settings), KeptInMemory(), rig=settings.rig,
        vector_pairs=settings.cost.vector_pairs,
    )  # fmt: skip


def open_devices(settings: Settings, clock: Clock = SYSTEM_CLOCK) -> RigDevices:
    """Connect to mirror and camera; nothing moves.

    Raises
    ------
    DeviceGone : no such port, in use, not permitted, or the camera is not there. DeadlinePassed : nothing answers.
    RigError : another device does.
    """
    from pipeline.rig.camera.headwall_camera import HeadwallCamera
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


@contextmanager
def capture_source(run: CaptureRun, key: str) -> Iterator[Source]:
    """Give what a capture's lines come from: the simulated source, or the rig with its devices held on to.

    What the rig's camera gives is kept beside the lines under way and goes with them.
    """
    if run.rig is None:
        yield run.source
        return
    source = run.rig.keeping(FetchedFiles(run.archive.spool_folder(key) / FETCHED))
    run.report(0.0)  # a rig is at work long before its first line is here
    with source.session():
        yield source


def held_lines(source: Source, sweep: Sweep, numbers: Sequence[int]) -> Iterator[Line]:
    """Give single lines that a rig gave before, from the files of their captures; not valid where these are gone."""
    return cast("RigSource", source).lines_again(sweep, numbers)


def rig_record(source: Source) -> dict[str, Any]:
    """What a rig's captures were like, for their store: how lines were tied to the mirror, and by which settings."""
    return cast("RigSource", source).record


def for_rig(settings: Settings) -> Settings:
    """Give the settings of a survey through a rig: this look at the field has a name, and no control is simulated."""
    if settings.source != "rig":
        return settings
    return replace(settings, visit=settings.visit or f"{datetime.now(UTC):%Y-%m-%d}", controls=False)


def field_before_rig(settings: Settings) -> RasterScene:
    """Give a field of which only size and bands are known.

    Raises
    ------
    SettingsError : they are not given.
    """
    for name, value in {"size": settings.size, "wavelengths": settings.wavelengths}.items():
        if value is None:
            raise SettingsError(
                f"scene {RIG_FIELD!r} is what stands before the rig: give its {name}, which no file tells"
            )
    assert settings.size is not None
    assert settings.wavelengths is not None
    width, height = settings.size
    bands = len(settings.wavelengths)
    nothing = np.zeros((height, width, 1), np.float32)
    return RasterScene(
        name=settings.name or RIG_FIELD,
        key=f"{RIG_FIELD}/{settings.name or ''}/{width}x{height}",
        raster=Raster.of(nothing),
        light=Once.of(Light(np.zeros((1, bands), np.float32), np.full(bands, settings.camera.full_well_e, np.float32))),
        panel=np.full(bands, settings.rig.panel, np.float32),
        wavelength_nm=np.array(settings.wavelengths, np.float64),
    )

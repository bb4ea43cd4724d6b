"""The rig as a source of lines: mirror and camera take a sweep in captures, and its lines come back in order.

Each capture has as many lines as the mirror's vector memory holds positions for. Its files are fetched, and its lines
get their positions: that of the path at a line's time by the camera's stamps.

A journal beside the fetched files records all that the rig has acknowledged. A later call with the same ``kept``
continues a transfer where it broke off, and captures only what the camera does not have.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import STRAIGHT
from spectralzoom.pipeline.geometry.scan import Sweep, exposing
from spectralzoom.pipeline.rig.camera.camera_cubes import as_references
from spectralzoom.pipeline.rig.camera.camera_files import NOT_LOGGED_IN, Kept, KeptInMemory
from spectralzoom.pipeline.rig.capture_paths import (
    REFERENCES,
    CaptureRecord,
    UnusableCaptureError,
    locate_lines,
    next_path,
    path_of,
)
from spectralzoom.pipeline.rig.capture_runner import CaptureJournal, CaptureRunner, Say
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.drivers import RigDevices
from spectralzoom.pipeline.rig.transports import DeviceRefused, StateUnknown
from spectralzoom.pipeline.simulator.effects.effect import Chosen, Effect
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.pipeline.source import RECORD, Line, References

LOG = logging.getLogger(__name__)
BARREN = 2  # captures in a row without a line, after which a sweep fails


@dataclass(eq=False)
class RigSource:
    """A :class:`pipeline.source.Source` over a rig, the devices of which are connected when they are first needed.

    ``open_devices`` connects both; they are closed when a session, or a call outside of one, ends. A fake camera sees
    the lines of ``seen``. ``keep`` opens a folder for the camera's files and the journal; that of an earlier process
    continues its captures. ``say`` gets the present step while no line comes: upload, capture or transfer; ``note``
    gets what is odd about the references.
    """

    camera: LineCamera
    wavelength_nm: NDArray[np.float64]
    open_devices: Callable[[SimulatedSource | None], RigDevices]
    keep: Callable[[Path], Kept] = lambda folder: KeptInMemory()
    rig: SurveyRig = field(default_factory=SurveyRig)
    vector_pairs: int = 1500
    field_name: str = ""
    seen: SimulatedSource | None = None
    say: Say = lambda step: None
    note: Say = LOG.warning
    unknown: list[str] = field(default_factory=list)  # why the rig's state is unknown; shared by copies of this source
    name = "rig"

    def __post_init__(self) -> None:
        self._use(KeptInMemory())

    def _use(self, kept: Kept) -> None:
        """Use the files and the journal in ``kept``."""
        self._kept = kept
        self._journal = CaptureJournal(kept)
        self._runner: CaptureRunner | None = None
        self._whole: dict[str, References] = {}  # of all samples, by folder

    @property
    def key(self) -> Mapping[str, Any]:
        """Return field, white reference and mounting; of a fake camera also what its scene depends on."""
        white = {"white_reference": self.rig.white_reference, "white_at_rest": self.rig.white_at_rest}
        seen = {} if self.seen is None else self.seen.key
        return {"field": self.field_name, **white, "mounting": self.rig.mounting, **seen}

    @property
    def effects(self) -> Sequence[Effect]:
        """Return those of the scene before a fake camera."""
        return () if self.seen is None else self.seen.effects

    @property
    def record(self) -> dict[str, Any]:
        """Return settings and captures of these files, with the possible error of the lines' positions."""
        rig: dict[str, Any] = {name: getattr(self.rig, name) for name in ("ends", "provenance")}
        if self.rig.mounting != STRAIGHT:
            rig["mounting"] = asdict(self.rig.mounting)
        damage = {"journal": self._journal.damage} if self._journal.damage else {}
        return {"rig": rig, "captures": self._journal.captures, **damage}

    def with_effects(self, chosen: Chosen, clock: Mapping[str, float]) -> RigSource:
        """Return the same rig, before the fake camera of which the scene has these effects."""
        return replace(self, seen=None if self.seen is None else self.seen.with_effects(chosen, clock))

    def keeping(self, kept: Kept) -> RigSource:
        """Return the same rig with its files elsewhere."""
        other = replace(self)
        other._use(kept)
        return other

    @contextmanager
    def opened(self, kept: Path) -> Iterator[RigSource]:
        """Connect the devices for the block, with their files in ``kept``; the record of the captures is left there.

        Raises as `session`.
        """
        source = self.keeping(self.keep(kept))
        with source.session():
            yield source
        (kept / RECORD).unlink(missing_ok=True)
        with (kept / RECORD).open("x") as file:  # a new file, so that no link is followed
            file.write(json.dumps(source.record, indent=1) + "\n")

    @contextmanager
    def session(self) -> Iterator[CaptureRunner]:
        """Keep the devices open over several calls; inner sessions share them.

        Raises DeviceGone, DeadlinePassed or RigError where a device is missing or another one answers. Raises
        StateUnknown where a motion or capture of an earlier session was not acknowledged.
        """
        if self.unknown:
            raise StateUnknown(f"the rig gets no further command: {self.unknown[0]}; look at it, then run again")
        devices = self.open_devices(self.seen) if self._runner is None else None
        try:
            if devices is not None:
                self._runner = CaptureRunner(devices, self._journal, self.camera, self.rig, say=self.say)
            assert self._runner is not None
            yield self._runner
        except StateUnknown as error:
            self.unknown.append(str(error))
            raise
        finally:
            if devices is not None:
                self._runner = None
                devices.close()

    def lines(self, sweep: Sweep, first: int = 0) -> Iterator[Line]:
        """Yield the sweep's lines one by one, from line ``first`` on.

        Raises PoseError: a position is beyond the mirror's reach. Raises StateUnknown: a motion or a capture was sent
        and not acknowledged. Raises RigError: a device failed, or its answer does not fit; earlier lines and
        acknowledged captures stay.
        """
        if first >= sweep.lines:
            return
        line = first
        barren = 0
        with self.session() as runner:
            while line < sweep.lines:
                before = line
                reason = "its files or positions end there"
                held = self._journal.holding(sweep, line)
                if held is None:
                    taken = runner.take(next_path(sweep, line, self.camera, vector_pairs=self.vector_pairs))
                else:
                    taken = held
                    runner.wait(taken)
                try:
                    for found in self._read(runner, taken, line):
                        yield found
                        line += 1
                except (UnusableCaptureError, DeviceRefused) as error:
                    if isinstance(error, DeviceRefused) and error.code == NOT_LOGGED_IN:
                        raise  # the camera still has the capture
                    reason = str(error)
                barren = 0 if line > before else barren + 1
                if line < taken.stop:
                    self._journal.record_spent(taken, reason)
                    if barren >= BARREN:
                        raise RigError(
                            f"sweep {sweep.name}: {BARREN} captures in a row gave no line {line}; the last, "
                            f"{taken.folder}: {reason}. The {line} lines before it are kept; mend that and run again"
                        )
                    LOG.warning("%s: line %d is captured again; %s: %s", sweep.name, line, taken.folder, reason)

    def references(self, sweep: Sweep) -> References:
        """Return the dark and white frames; they are captured once for each exposure."""
        exposure_ms = sweep.exposure_ms
        folders = self._journal.references
        if folders.get(exposure_ms, "") not in self._whole:
            with self.session() as runner:
                known = self._known_references(runner, folders[exposure_ms], sweep) if exposure_ms in folders else None
                for read in (self._known_references, self._whole_references):
                    if not known:  # again where an emptied camera used the name of a folder whose files are held
                        self._journal.record_references(runner.capture_at_rest(REFERENCES, exposure_ms), exposure_ms)
                        known = read(runner, folders[exposure_ms], sweep)
                assert known is not None
                self._whole[folders[exposure_ms]] = known
        whole = self._whole[folders[exposure_ms]]
        bad = None if whole.bad is None or not whole.bad.any() else whole.bad
        return replace(whole, bad=bad, by_mirror=self.rig.white_at_rest)

    def _known_references(self, runner: CaptureRunner, folder: str, sweep: Sweep) -> References | None:
        """Return the frames of an earlier session; None where the camera does not have them any more."""
        try:
            return self._whole_references(runner, folder, sweep)
        except RigError as error:
            if type(error) not in (RigError, DeviceRefused) or getattr(error, "code", None) == NOT_LOGGED_IN:
                raise
            LOG.warning("dark and white frames are taken again; %s: %s", folder, error)
            return None

    def _whole_references(self, runner: CaptureRunner, folder: str, sweep: Sweep) -> References:
        """Return the dark and white frames of all samples."""
        frames = runner.devices.camera.references(folder, self._kept)
        if missing := [kind for kind in ("dark", "white") if kind not in frames]:
            raise RigError(
                f"the camera gives no {' and no '.join(missing)} frame of {folder}; take both, by its driver or with "
                "its own program, then run again"
            )
        exposure_ms = exposing(self.camera, sweep).exposure_ms
        dark, white = frames["dark"], frames["white"]
        whole, notes = as_references(
            dark,
            white,
            white_reference=self.rig.white_reference,
            exposure_ms=exposure_ms,
            full_scale_dn=self.camera.full_scale_dn,
        )
        self._check_size(whole.dark.shape, folder)
        for note in notes:
            self.note(f"{folder}: {note}")
        return whole

    def _read(self, runner: CaptureRunner, taken: CaptureRecord, line: int) -> Iterator[Line]:
        """Fetch a capture and yield its lines from ``line`` on; those without data or position are not valid."""
        try:
            captured = runner.devices.camera.fetch(
                taken.folder,
                self._kept,
                lambda _, held, size: self.say(f"fetching: {held / 1e6:.1f} of {size / 1e6:.1f} MB"),
            )
        except RigError as error:
            if type(error) is not RigError:  # a device that is gone, or a full disk: the capture is in order
                raise
            raise UnusableCaptureError(str(error)) from error
        self._check_size(captured.values.shape[1:], taken.folder)
        path = path_of(taken.sweep, (taken.first, taken.stop), self.camera)
        located = locate_lines(captured, path, taken, self.camera)
        self._journal.record_positions(taken, located.positions, captured.notes)
        sweep = taken.sweep
        nothing = np.zeros(captured.values.shape[1:], np.uint16)
        for place in range(line - path.first, len(located.row)):
            row = int(located.row[place])
            valid = located.is_valid(place)
            x, y = located.positions.position[row] if valid else path.middle[place]
            yield Line(
                number=path.first + place,
                data=captured.values[row] if row >= 0 else nothing,
                mirror_x=float(x),
                mirror_y=float(y),
                time_s=self._time_s(sweep, path.first + place, int(located.stamp_us[row]) if row >= 0 else -1),
                exposure_ms=exposing(self.camera, sweep).exposure_ms,
                valid=valid,
            )

    def _time_s(self, sweep: Sweep, number: int, stamp_us: int) -> float:
        """Return the time of mid exposure since the sweep's start, by the camera's stamps, else by its frame rate."""
        known = stamp_us >= 0
        exposed = exposing(self.camera, sweep)
        origin = self._journal.origin_us(sweep, stamp_us if known and number == 0 else None)
        if known and origin is not None:
            return (stamp_us - origin) * 1e-6 + exposed.mid_exposure_s(0.0)
        return exposed.mid_exposure_s(float(number))

    def _check_size(self, found: tuple[int, ...], folder: str) -> None:
        wanted = (self.camera.samples, len(self.wavelength_nm))
        if found != wanted:
            raise RigError(
                f"{folder} holds lines of {found} (sample, band), the settings say {wanted}; set camera.samples and "
                "the wavelengths to what the camera gives"
            )

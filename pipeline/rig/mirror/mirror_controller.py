"""The mirror controller's driver: a mirror that can be sent somewhere, or along a path.

Written for the documented protocol and tested against an emulator; never run on hardware. Positions are those of a
mirror mounted straight; on the wire they are the device's own, as the settings say that it is mounted.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from pipeline.errors import RigError, SettingsError
from pipeline.geometry.scan import device_range
from pipeline.rig.device_settings import MirrorSettings, ReadBack
from pipeline.rig.devices import SYSTEM_CLOCK, Clock, Closing
from pipeline.rig.mirror.mirror_requests import Identity, Modes, ProLink
from pipeline.rig.mirror.path_player import (
    Logger,
    MotionLog,
    Progress,
    check_play,
    hold_values,
    run_values,
    upload,
    wire_positions,
)
from pipeline.rig.mirror.pro_mode import Value, ask_status, cell_int, get_value, get_values, read_values, set_values
from pipeline.rig.mirror.registers import Status, Trigger, Unit, VectorRegister, X, Y
from pipeline.rig.transports import SerialTransport, Transport, Wire

LOG = logging.getLogger(__name__)
_POLL_S = 0.01
KNOWN_MODELS = ("MR-E", "MRE")  # begin the ids of the controllers that the documents are of


class MirrorController(Closing):
    """A mirror controller on a port. :meth:`connect` first; use it as a context, or close it.

    Motions (goto, run, park) are sent once. One that is not acknowledged raises StateUnknown, and so does every later
    one of this object; what only reads, and :meth:`halt`, still work. Every method that speaks to the device raises
    DeviceRefused, DeadlinePassed or DeviceGone besides what it says itself, and RigError before connect.
    """

    def __init__(
        self, transport: Transport, settings: MirrorSettings | None = None, clock: Clock = SYSTEM_CLOCK
    ) -> None:
        self.settings = settings or MirrorSettings()
        self.wire = Wire(transport, clock, self.settings.patience)
        self._link = ProLink(self.wire, self.settings.with_crc, self.settings.strict_crc)
        self._modes = Modes(self._link)
        self._log = Logger(self._link, self.settings.log_samples)
        self._identity: Identity | None = None
        self._pairs = 0  # that the vector memory holds

    def connect(self, *, known: bool = False) -> Identity:
        """Find the controller in whichever mode it is, and bring it to pro mode. Nothing moves.

        With ``known`` only the models that the documents are of are taken, or the one that the settings expect. Raises
        DeadlinePassed or DeviceGone where nothing answers, RigError where another device does.
        """
        self._pairs, self._identity = 0, None
        found, expected = self._modes.connect(), self.settings.expected_id
        if expected.lower() not in found.device.lower():
            raise RigError(
                f"expected a controller whose id holds {expected!r} on {self.wire.port}, got {found.device!r}; is this "
                "the mirror?"
            )
        if known:
            check_model(found, self.wire.port, expected)
        self._identity = found  # not before: closing parks what is connected, and another device is not moved
        return found

    def identity(self) -> Identity:
        """What the controller said it is when it was connected; RigError where it is not connected."""
        self._check_connected()
        assert self._identity is not None
        return self._identity

    @property
    def found_in_pro(self) -> bool:
        """Whether it was in pro mode as it was connected: an earlier session, or another program, had been there."""
        return self._modes.found_in_pro

    def status(self) -> Status:
        """Status bits, now."""
        self._check_connected()
        return Status(self._link.ask(ask_status(), "the status", cell_int))

    def temperature(self) -> float:
        """Temperature, read in simple mode; RigError where a path plays, as modes are not changed under it. [deg C]"""
        self._check_idle("ask for its temperature")
        with self._modes.simple() as lines:
            return lines.temperature()

    def why_unanswered(self, *, with_crc: bool) -> str:
        """Try frames with a CRC, or without, and come back to those of the settings; return why none is answered.

        Return "" where they are answered. Nothing moves. Raises RigError where a path plays, as `temperature` does.
        """
        self._check_idle("try other frames")
        with self._modes.simple():
            return self._modes.why_unanswered(with_crc=with_crc)

    def goto(self, x: float, y: float) -> None:
        """Send the mirror to a position and hold it there; comes back once that is acknowledged, not at rest.

        Raises PoseError outside the disk, before anything is sent, RigError where the status forbids motion, and
        StateUnknown where it was not acknowledged, or motions are frozen.
        """
        target = wire_positions([(x, y)], self.settings.mounting)[0]
        self._move(hold_values(*target), f"going to {target[0]:.6g}; {target[1]:.6g}")

    def settle(self, within_s: float) -> None:
        """Wait until the mirror is at rest; RigError where it is not, or the device trimmed the target to the rim."""
        until = self.wire.clock.now() + within_s
        while Status.NOT_STABLE in (status := self.status()):
            if self.wire.clock.now() >= until:
                raise RigError(f"the mirror on {self.wire.port} is not at rest after {within_s:g} s; {status.sentence}")
            self.wire.clock.sleep(_POLL_S)
        if Status.TRIMMED in status:
            raise RigError(f"the mirror on {self.wire.port} is not where it was sent; {status.sentence}")

    def load_path(
        self, positions: ArrayLike, read_back: ReadBack | None = None, progress: Progress | None = None
    ) -> None:
        """Put positions (position, 2) into the vector memory: X of all, then Y of all, from cell 0 on. Nothing moves.

        ``read_back`` says how much is read back and compared; None takes it from the settings. ``progress`` is called
        with cells done and cells in all. Raises PoseError or ShapeError where a position is outside the disk,
        SettingsError where there are too many, before anything is sent; RigError where a path plays, or the memory
        holds something else than was sent.
        """
        cells = wire_positions(positions, self.settings.mounting)
        if len(cells) > self.settings.vector_pairs:
            raise SettingsError(
                f"the vector memory holds {self.settings.vector_pairs} positions, got {len(cells)}; load in parts"
            )
        self._check_idle("load another one")
        self._pairs = 0
        upload(self._link, cells.T.astype(">f4").tobytes(), read_back or self.settings.read_back, progress)
        self._pairs = len(cells)

    def run(self, first: int, stop: int, rate_hz: float, cycles: int = 1, trigger: Trigger = Trigger.OFF) -> None:
        """Play the loaded positions ``first`` to ``stop``, half open, at ``rate_hz`` positions a second.

        X plays from cell 0 on, Y from behind the X of all loaded positions, ``cycles`` times (-1: without end);
        ``trigger`` says which edges step to the next position instead. Raises SettingsError where the range is not
        within what is loaded, or a number means nothing, and what :meth:`goto` does.
        """
        check_play(first, stop, rate_hz, cycles, self._pairs)
        with self.wire.lock:
            self.wire.check_known("running a path")
            self.halt()
            for name, begin, channel in (("X", 0, X), ("Y", self._pairs, Y)):
                start, end = device_range((begin + first, begin + stop), self.settings.ends)
                values: dict[VectorRegister, Value] = {
                    VectorRegister.UNIT: int(Unit.XY),
                    VectorRegister.START: start,
                    VectorRegister.END: end,
                    VectorRegister.FREQUENCY: float(rate_hz),
                    VectorRegister.CYCLES: cycles,
                    VectorRegister.TRIGGER: int(trigger),
                }
                frame = set_values({channel.vector(register): value for register, value in values.items()})
                self._link.tell(frame, f"setting up the path's {name}")
            self._move(run_values(), f"running positions {first}:{stop}")

    def halt(self) -> None:
        """Stop playing; the mirror stays where it is. Works where motions are frozen, too."""
        self._check_connected()
        self._link.tell(set_values({channel.vector(VectorRegister.RUN): 0 for channel in (X, Y)}), "halting the path")

    def is_playing(self) -> bool:
        """Whether a unit plays a path."""
        self._check_connected()
        registers = [channel.vector(VectorRegister.RUN) for channel in (X, Y)]
        return any(map(cell_int, self._link.ask(get_values(registers), "whether a path plays", read_values)))

    def index(self) -> int:
        """Position of the loaded path that plays now: the cell of X."""
        self._check_connected()
        return self._link.ask(get_value(X.vector(VectorRegister.INDEX)), "the place in the path", cell_int)

    def start_log(self, rate_hz: float | None = None, *, with_index: bool = False) -> None:
        """Begin to log measured positions, and the cells that are played, at the settings' rate if none is given."""
        self._check_connected()
        self._log.start(self.settings.log_rate_hz if rate_hz is None else rate_hz, with_index=with_index)

    def read_log(self, samples: int | None = None) -> MotionLog:
        """End the log and fetch ``samples`` of it, or as many as the time since its start has."""
        log = self._log.read(samples)
        return replace(log, position=self.settings.mounting.to_model(log.position).astype(np.float32, copy=False))

    def park(self) -> None:
        """Send the mirror to 0; 0, as :meth:`goto` does."""
        self.goto(0.0, 0.0)

    def close(self) -> None:
        """Let go of the port; park before, where the settings say so and motions are not frozen."""
        try:
            if self.settings.park_at_close and self._identity is not None:
                self.park()
        except RigError as error:
            LOG.warning("not parked: %s", error)
        finally:
            self._identity = None
            self.wire.transport.close()

    def _move(self, values: dict[int, Value], name: str) -> None:
        self._check_connected()
        self.wire.check_known(name)
        if self.settings.check_status and (status := self.status()).stops_motion:
            raise RigError(f"{name} is refused on {self.wire.port}; {status.sentence}; mend that first")
        self._link.move(set_values(values), name)

    def _check_idle(self, purpose: str) -> None:
        if self.is_playing():
            raise RigError(f"{self.wire.port} plays a path; {purpose} when that is over, or halt it")

    def _check_connected(self) -> None:
        if self._identity is None:
            raise RigError(f"{self.wire.port} is not connected; call connect first")


def open_mirror(settings: MirrorSettings, clock: Clock = SYSTEM_CLOCK, *, known: bool = False) -> MirrorController:
    """Open the port that the settings name and connect to the controller there, see its connect. Nothing moves.

    Raises DeviceGone where there is no such port, it is in use, or not permitted.
    """
    mirror = MirrorController(SerialTransport(settings.port, settings.baud, clock), settings, clock)
    try:
        mirror.connect(known=known)
    except BaseException:
        mirror.close()
        raise
    return mirror


def check_model(identity: Identity, port: str, expected: str) -> None:
    """Refuse a model that the documents are not of, unless the settings expect it by its id (RigError)."""
    if not expected and not identity.device.upper().startswith(KNOWN_MODELS):
        raise RigError(
            f"firmware not known on {port}: {identity.words}; expected an id that begins with {KNOWN_MODELS[0]}: is "
            "another device at this port? If it is the mirror, set rig.expected_id to a part of its id"
        )

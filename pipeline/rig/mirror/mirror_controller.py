"""The mirror controller's driver: sends a mirror to a position, or along a path.

It follows the documented protocol and was tested against an emulator; it never ran on hardware. Positions are those of
a mirror mounted straight. The wire carries the device's own positions, by the mounting in the settings.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import RigError, SettingsError, ShapeError
from pipeline.geometry.mirror import STRAIGHT, Mounting, check_reach
from pipeline.geometry.scan import device_range
from pipeline.rig.device_settings import MirrorSettings, ReadBack
from pipeline.rig.mirror import pro_mode as pro
from pipeline.rig.mirror.mirror_requests import Identity, Modes, ProLink
from pipeline.rig.transports import SYSTEM_CLOCK, Clock, Closing, DeviceRefused, SerialTransport, Transport, Wire

LOG = logging.getLogger(__name__)
SAMPLED_EVERY = 10  # frames; "sampled" also reads back the ends of both channels
Progress = Callable[[int, int], None]  # cells done, cells in all


def wire_positions(positions: ArrayLike, mounting: Mounting = STRAIGHT) -> NDArray[np.float32]:
    """Return positions (position, 2) as float32 for the wire; rounding moves none of them beyond the rim.

    Positions of a mirror mounted straight become those of the device in its ``mounting``. Raises ShapeError: they have
    another shape, or there is none. Raises PoseError: one is not finite or lies beyond the rim.
    """
    exact = np.array(positions)
    if exact.ndim != 2 or exact.shape[1:] != (2,) or not len(exact):
        raise ShapeError(f"a path needs positions as (position, 2), at least one, got shape {exact.shape}")
    exact = check_reach(exact).astype(np.float64)
    exact /= np.maximum(np.hypot(exact[:, :1], exact[:, 1:]), 1)  # the slack that check_reach allows
    rounded: NDArray[np.float32] = exact.astype(np.float32)
    beyond = np.hypot(*rounded.astype(np.float64).T) > 1
    rounded[beyond] = np.nextafter(rounded[beyond], np.float32(0))
    return rounded if mounting == STRAIGHT else wire_positions(mounting.to_device(rounded))


def upload(link: ProLink, cells: bytes, read_back: ReadBack, progress: Progress | None = None) -> None:
    """Write cells, X of all positions and then Y of all, to the vector memory, and compare what it holds then.

    ``read_back`` is "none", "sampled" (every tenth frame and the ends of both channels) or "all". ``progress`` gets
    cells done and cells in all, including those read back. Raises RigError: a cell holds another value.
    """
    size = pro.VECTOR_CELLS * pro.CELL
    frames = [(at // pro.CELL, cells[at : at + size]) for at in range(0, len(cells), size)]
    checked = [frames[number] for number in frames_to_check(len(frames), read_back)]
    total = (len(cells) + sum(len(sent) for _, sent in checked)) // pro.CELL
    done = 0
    for number, (start, sent) in enumerate([*frames, *checked]):
        stop = start + len(sent) // pro.CELL
        if number < len(frames):
            link.set(pro.set_vector(pro.VECTOR_MEMORY, start, sent), f"writing cells {start} to {stop}")
        else:
            held = read_cells(link, pro.VECTOR_MEMORY, start, stop - start)
            _compare(link.wire.port, start, sent, held, len(cells) // pro.CELL // 2)
        done += stop - start
        if progress is not None:
            progress(done, total)


def _compare(port: str, start: int, sent: bytes, held: bytes, pairs: int) -> None:
    """Raise RigError for the first cell that holds another value than was sent."""
    for cell, (one, other) in enumerate(zip(pro.split_cells(sent), pro.split_cells(held), strict=True), start):
        if one != other:
            axis, position = ("X", cell) if cell < pairs else ("Y", cell - pairs)
            raise RigError(
                f"cell {cell} of the vector memory on {port} ({axis} of position {position}) holds "
                f"{pro.cell_float(other):.9g}, {pro.cell_float(one):.9g} was sent; nothing was moved: load the path "
                "again"
            )


def frames_to_check(frames: int, read_back: ReadBack) -> list[int]:
    """Return the numbers of the frames that are read back."""
    if read_back == "none":
        return []
    if read_back == "all":
        return list(range(frames))
    half = frames // 2  # X ends and Y begins here
    ends = (0, half - 1, half, frames - 1)
    return sorted({number for number in chain(range(0, frames, SAMPLED_EVERY), ends) if 0 <= number < frames})


def read_cells(link: ProLink, register: int, start: int, count: int) -> bytes:
    """Read cells of a vector, at most as many as one frame takes."""

    def parse(payload: bytes) -> bytes:
        if len(payload) != count * pro.CELL:
            raise ShapeError(f"expected {count} cells, got {len(payload)} bytes")
        return payload

    return link.ask(pro.get_vector(register, start, count), f"reading cells {start} to {start + count}", parse)


def hold_values(x: float, y: float) -> dict[int, pro.Value]:
    """Return the registers that send both channels to a position, hold it and end any path; they fill one frame."""
    follow = {**pro.X.followed(pro.X.static_system), **pro.Y.followed(pro.Y.static_system)}
    return {pro.X.static_xy: float(x), pro.Y.static_xy: float(y), **follow, **_run_values(0)}


def _run_values(run: int) -> dict[int, pro.Value]:
    """Return the registers that start (1) or halt (0) the vector units of both channels, in one frame."""
    return {channel.vector(pro.VectorRegister.RUN): run for channel in (pro.X, pro.Y)}


@dataclass(frozen=True)
class MotionLog:
    """Positions that the controller measured at a steady rate.

    ``started_s`` is the time of the acknowledgement of the start, by the driver's clock. The log began at most
    ``start_error_s`` earlier, the duration of the request.
    """

    position: NDArray[np.float32]  # (sample, 2) X and Y
    rate_hz: float
    started_s: float
    start_error_s: float


_POLL_S = 0.01
KNOWN_MODELS = ("MR-E", "MRE")  # beginnings of the ids of documented controllers


class MirrorController(Closing):
    """A mirror controller on a port, a `pipeline.rig.drivers.MirrorDriver`. Call :meth:`connect` first.

    Motions (goto, run) are sent once. One that is not acknowledged raises StateUnknown, and so does every later motion
    of this object; reads and :meth:`halt` still work. Every method that speaks to the device may also raise
    DeviceRefused, DeadlinePassed or DeviceGone, and RigError before connect.
    """

    def __init__(
        self, transport: Transport, settings: MirrorSettings | None = None, clock: Clock = SYSTEM_CLOCK
    ) -> None:
        self.settings = settings or MirrorSettings()
        self.wire = Wire(transport, clock, self.settings.patience)
        self._link = ProLink(self.wire, self.settings.with_crc, self.settings.strict_crc)
        self._modes = Modes(self._link)
        self._logging: tuple[float, float, float] | None = None  # rate; before the request and after its answer
        self._identity: Identity | None = None
        self._pairs = 0  # positions in the vector memory

    def connect(self, *, known: bool = False) -> Identity:
        """Find the controller in either mode, and change it to pro mode. Nothing moves.

        ``known`` accepts documented models only, or the one that the settings expect. Raises DeadlinePassed or
        DeviceGone where nothing answers, RigError where another device answers.
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
        self._identity = found
        return found

    def identity(self) -> Identity:
        """Return the controller's identity; RigError where it is not connected."""
        self._check_connected()
        assert self._identity is not None
        return self._identity

    @property
    def found_in_pro(self) -> bool:
        """Return whether it was in pro mode at connect: an earlier session or another program left it so."""
        return self._modes.found_in_pro

    def status(self) -> pro.Status:
        """Return the present status bits."""
        self._check_connected()
        return pro.Status(self._link.ask(pro.ask_status(), "the status", pro.cell_int))

    def why_unanswered(self, *, with_crc: bool) -> str:
        """Try frames with a CRC, or without, and return to those of the settings; return why none is answered, or "".

        Nothing moves. Raises RigError: a path plays.
        """
        self._check_idle("try other frames")
        return self._modes.try_frames(with_crc=with_crc)

    def goto(self, x: float, y: float) -> None:
        """Send the mirror to a position and hold it there; return once that is acknowledged, not at rest.

        Raises PoseError: the position is outside the disk; no byte is sent. Raises RigError: the status forbids motion.
        Raises StateUnknown: it was not acknowledged, or an earlier motion was not.
        """
        target = wire_positions([(x, y)], self.settings.mounting)[0]
        self._move(hold_values(*target), f"going to {target[0]:.6g}; {target[1]:.6g}")

    def settle(self, within_s: float) -> None:
        """Wait until the mirror is at rest; RigError where it is not, or the device trimmed the target to the rim."""
        until = self.wire.clock.now() + within_s
        while pro.Status.NOT_STABLE in (status := self.status()):
            if self.wire.clock.now() >= until:
                raise RigError(f"the mirror on {self.wire.port} is not at rest after {within_s:g} s; {status.sentence}")
            self.wire.clock.sleep(_POLL_S)
        if pro.Status.TRIMMED in status:
            raise RigError(f"the mirror on {self.wire.port} is not where it was sent; {status.sentence}")

    def load_path(
        self, positions: ArrayLike, read_back: ReadBack | None = None, progress: Progress | None = None
    ) -> None:
        """Put positions (position, 2) into the vector memory: X of all, then Y of all, from cell 0 on. Nothing moves.

        ``read_back`` selects the cells to read back and compare, by default as in the settings. ``progress`` gets cells
        done and cells in all. Raises PoseError or ShapeError where a position is outside the disk, and SettingsError
        where there are too many; nothing is sent then. Raises RigError: a path plays, or a cell holds another value.
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

    def run(
        self, first: int, stop: int, rate_hz: float, cycles: int = 1, trigger: pro.Trigger = pro.Trigger.OFF
    ) -> None:
        """Play the loaded positions ``first`` to ``stop``, half open, at ``rate_hz`` positions a second.

        X plays from cell 0 on, Y from behind the X of all loaded positions. The path is repeated ``cycles`` times (-1:
        without end). With a ``trigger`` the edges at its input step to the next position instead. Raises SettingsError:
        the range is not loaded, or the rate or cycles are out of range. Raises also as :meth:`goto`.
        """
        if not (0 <= first < stop <= self._pairs):
            raise SettingsError(f"{first}:{stop} is no range of the {self._pairs} positions loaded; load them first")
        if not (0 < rate_hz < float("inf")) or cycles == 0 or not -1 <= cycles < 2**31:
            raise SettingsError(
                f"expected a rate above 0 Hz, and cycles of 1 or more, or -1 for no end, got {rate_hz} Hz and {cycles} "
                "cycles"
            )
        with self.wire.lock:
            self.wire.check_known("running a path")
            self.halt()
            for name, begin, channel in (("X", 0, pro.X), ("Y", self._pairs, pro.Y)):
                start, end = device_range((begin + first, begin + stop), self.settings.ends)
                values: dict[pro.VectorRegister, pro.Value] = {
                    pro.VectorRegister.UNIT: int(pro.Unit.XY),
                    pro.VectorRegister.START: start,
                    pro.VectorRegister.END: end,
                    pro.VectorRegister.FREQUENCY: float(rate_hz),
                    pro.VectorRegister.CYCLES: cycles,
                    pro.VectorRegister.TRIGGER: int(trigger),
                }
                frame = pro.set_values({channel.vector(register): value for register, value in values.items()})
                self._link.set(frame, f"setting up the path's {name}")
            follow = {**pro.X.followed(pro.X.vector_system), **pro.Y.followed(pro.Y.vector_system)}
            self._move(follow | _run_values(1), f"running positions {first}:{stop}")  # one frame: both begin together

    def halt(self) -> None:
        """Stop playing; the mirror stays where it is. Works also where motions are refused."""
        self._check_connected()
        self._link.set(pro.set_values(_run_values(0)), "halting the path")

    def is_playing(self) -> bool:
        """Return whether a unit plays a path."""
        self._check_connected()
        cells = self._link.ask(pro.get_values(list(_run_values(0))), "whether a path plays", pro.read_values)
        return any(map(pro.cell_int, cells))

    def index(self) -> int:
        """Return the position of the loaded path that plays now: the cell of X."""
        self._check_connected()
        register = pro.X.vector(pro.VectorRegister.INDEX)
        return self._link.ask(pro.get_value(register), "the place in the path", pro.cell_int)

    def start_log(self, rate_hz: float) -> None:
        """Start to log measured positions ``rate_hz`` times a second: X in slot 0, Y in slot 1."""
        self._check_connected()
        self._logging = None
        self._link.set(pro.set_values({pro.LOG_RUN: 0}), "stopping the log")
        slots = {pro.log_slot(0): pro.FEEDBACK_X, pro.log_slot(1): pro.FEEDBACK_Y}
        self._link.set(pro.set_values({**slots, pro.LOG_RATE: float(rate_hz)}), "setting up the log")
        before = self.wire.clock.now()
        self._link.set(pro.set_values({pro.LOG_RUN: 1}), "starting the log")
        self._logging = float(rate_hz), before, self.wire.clock.now()

    def read_log(self) -> MotionLog:
        """End the log and fetch the samples since its start, at most as many as the logger holds.

        A shorter log ends where the device says so. Raises RigError: no log was started.
        """
        if self._logging is None:
            raise RigError(f"no log was started on {self.wire.port}; start one before the path runs")
        rate_hz, before, after = self._logging
        samples = min(int((self.wire.clock.now() - after) * rate_hz), self.settings.log_samples)
        self._link.set(pro.set_values({pro.LOG_RUN: 0}), "stopping the log")
        self._logging = None
        columns = [self._logged(slot, samples) for slot in (0, 1)]
        held = min(map(len, columns)) // pro.CELL
        measured = np.stack([np.frombuffer(column, ">f4", held) for column in columns], axis=-1).astype(np.float32)
        position = self.settings.mounting.to_model(measured).astype(np.float32, copy=False)
        return MotionLog(position, rate_hz, after, after - before)

    def close(self) -> None:
        """Close the port; the mirror stays where it is."""
        self._identity = None
        self.wire.transport.close()

    def _move(self, values: dict[int, pro.Value], name: str) -> None:
        self._check_connected()
        self.wire.check_known(name)
        if (status := self.status()).stops_motion:
            raise RigError(f"{name} is refused on {self.wire.port}; {status.sentence}; mend that first")
        self._link.move(pro.set_values(values), name)

    def _logged(self, slot: int, samples: int) -> bytes:
        cells = b""
        for start in range(0, samples, pro.VECTOR_CELLS):
            try:
                cells += read_cells(self._link, pro.log_slot(slot), start, min(pro.VECTOR_CELLS, samples - start))
            except DeviceRefused as error:
                if error.code != pro.ErrorCode.VECTOR_INDEX:
                    raise
                LOG.warning("the log on %s ends at %d of %d samples", self.wire.port, start, samples)
                break
        return cells

    def _check_idle(self, purpose: str) -> None:
        if self.is_playing():
            raise RigError(f"{self.wire.port} plays a path; {purpose} when that is over, or halt it")

    def _check_connected(self) -> None:
        if self._identity is None:
            raise RigError(f"{self.wire.port} is not connected; call connect first")


def open_mirror(settings: MirrorSettings, clock: Clock = SYSTEM_CLOCK, *, known: bool = False) -> MirrorController:
    """Open the port of the settings and connect to the controller there, as `MirrorController.connect`. Nothing moves.

    Raises DeviceGone: there is no such port, it is in use, or not permitted.
    """
    mirror = MirrorController(SerialTransport(settings.port, settings.baud, clock), settings, clock)
    try:
        mirror.connect(known=known)
    except BaseException:
        mirror.close()
        raise
    return mirror


def check_model(identity: Identity, port: str, expected: str) -> None:
    """Raise RigError for an undocumented model, unless the settings expect it by its id."""
    if not expected and not identity.device.upper().startswith(KNOWN_MODELS):
        raise RigError(
            f"firmware not known on {port}: {identity.summary}; expected an id that begins with {KNOWN_MODELS[0]}: is "
            "another device at this port? If it is the mirror, set rig.expected_id to a part of its id"
        )

"""The emulated mirror controller: bytes in, bytes out. No transport, and time only by the clock that it is given.

Both modes of the documented protocol. Assumed, as the documents leave it open: an empty line has no answer; a reset is
answered by OK, and what comes while the controller boots is lost; in pro mode bytes that are no frame are answered by
error 0001 at the next boundary, requests are checked by their CRC after GOPROCRC alone, and replies always carry it.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.rig.clock import Clock
from pipeline.rig.emulator.exchange import Chunk, Mode, Request, VanishedError
from pipeline.rig.emulator.fault import Fault
from pipeline.rig.emulator.mirror_registers import RegisterFile
from pipeline.rig.emulator.mirror_state import MirrorState, MirrorUnit
from pipeline.rig.emulator.pro_answers import answer_frame
from pipeline.rig.emulator.simple_answers import answer_line
from pipeline.rig.mirror.pro_mode import BOUNDARY, ERROR_FLAG, Command, Damaged, ErrorCode, Frame, FrameReader, encode
from pipeline.rig.mirror.pro_payloads import refuse
from pipeline.rig.mirror.registers import Status
from pipeline.rig.mirror.simple_mode import END, GO_PRO, GO_PRO_CRC, MOST_LINE, RESET, Answer

KEPT_ACTS = 5_000
_BOUNDARY = bytes((BOUNDARY,))


@dataclass(frozen=True)
class Act:
    """A request that was carried out, for whoever checks what happened, and when. [s]"""

    time_s: float
    request: Request


class MirrorDevice:
    """One emulated controller with its mirror.

    ``acts`` are the requests carried out so far, the newest ``KEPT_ACTS``; ``gone`` and ``hung`` say that the
    port knows no device any more, or takes no bytes. Methods may be called from several threads: the port's, and that
    of an emulated camera, which gives triggers and asks for positions.
    """

    def __init__(self, clock: Clock, faults: Sequence[Fault] = (), *, unit: MirrorUnit | None = None) -> None:
        self.clock, self.faults, self.unit = clock, tuple(faults), MirrorUnit() if unit is None else unit
        self.acts: deque[Act] = deque(maxlen=KEPT_ACTS)
        self.gone = self.hung = False
        self._lock = threading.RLock()
        self.state = MirrorState(clock, self.unit)
        self.restart(boot_s=0.0)
        for fault in self.faults:
            fault.begin(self)

    def opened(self) -> list[Chunk]:
        """Give what a user finds in the port when it is opened: nothing, but for faults."""
        with self._lock:
            return [chunk for fault in self.faults for chunk in fault.opened(self)]

    def receive(self, data: bytes) -> list[Chunk]:
        """Take bytes, and give what comes back as (delay from now [s], bytes).

        Raises
        ------
        VanishedError : a fault took the device away.
        """
        with self._lock:
            if self.gone:
                raise VanishedError("the device is gone")
            for fault in self.faults:
                instead = fault.instead(self, data)
                if instead is not None:
                    return instead
                data = fault.incoming(self, data)
            out: list[Chunk] = []
            while data and not self.gone and self.clock.now() >= self._boots_until:
                data = self._take_line(data, out) if self.mode is Mode.SIMPLE else self._take_frame(data, out)
            return out

    def trigger(
        self, count: int = 1, *, period_s: float = 0.0, started_s: float | None = None, width_s: float = 1e-4
    ) -> None:
        """Take ``count`` pulses at the trigger input, one every ``period_s``, from now or from ``started_s`` on."""
        with self._lock:
            self.state.trigger(count, period_s, started_s, width_s)

    def positions(self, times_s: ArrayLike) -> NDArray[np.float64]:
        """Give where the mirror truly was, (..., 2) device X and Y, at times of the clock up to now (...)."""
        with self._lock:
            return self.state.positions(times_s)

    def status(self) -> Status:
        """Give the status bits as the controller reports them: what is so, and what faults make of it."""
        status = self.state.status()
        for fault in self.faults:
            status = fault.status(status)
        return status

    def restart(self, *, boot_s: float | None = None) -> None:
        """Lose everything and be in simple mode, deaf for a while: a reset, or a loss of power."""
        with self._lock:
            now = self.clock.now()
            self.state.restart(now)
            self.registers = RegisterFile(self.state)
            self.mode = Mode.SIMPLE
            self._line, self._reader = b"", FrameReader()
            boot_s = self.unit.boot_s if boot_s is None else boot_s
            self._boots_until = now + boot_s if boot_s > 0 else -math.inf

    def set_mode(self, mode: Mode) -> None:
        """Speak another mode from the next byte on."""
        self.mode, self._line, self._reader = mode, b"", FrameReader()

    def _take_line(self, data: bytes, out: list[Chunk]) -> bytes:
        """Take bytes up to the end of a line, and give those behind it: a line may change the mode."""
        taken, end, rest = data.partition(b"\n")
        self._line = (self._line + taken)[: 2 * MOST_LINE]  # enough to know, at its end, that it is too long
        if end:
            line, self._line = self._line.rstrip(b"\r"), b""
            if line:
                self._answer(Request(Mode.SIMPLE, line=line.decode("ascii", "replace").strip().upper()), out)
        return rest

    def _take_frame(self, data: bytes, out: list[Chunk]) -> bytes:
        """Take bytes up to a boundary, and give those behind it: a frame may change the mode."""
        taken, end, rest = data.partition(_BOUNDARY)
        for found in self._reader.feed(taken + end):
            if isinstance(found, Frame):
                self._answer(Request(self.mode, frame=found), out)
            else:
                self._answer(Request(self.mode, damaged=found), out)
        return rest

    def _answer(self, request: Request, out: list[Chunk]) -> None:
        """Carry a request out, unless a fault has its own way with it, and add the reply."""
        reply: bytes | None = None
        for fault in self.faults:
            reply = fault.verdict(self, request) if reply is None else reply
        if reply is None:
            reply = self.carry_out(request)
        chunks = [Chunk(self.unit.turnaround_s, reply)] if reply else []
        for fault in self.faults:
            chunks = fault.outgoing(self, request, chunks)
        out += chunks

    def carry_out(self, request: Request) -> bytes:
        """Do what a request asks for and give the bytes of the reply, whatever faults there are."""
        self.acts.append(Act(self.clock.now(), request))
        if request.damaged is not None:
            return encode(_refuse_damaged(request.damaged))
        return self._simple(request.line) if request.frame is None else encode(self._pro(request.frame))

    def _simple(self, line: str) -> bytes:
        modes = {GO_PRO: Mode.PRO, GO_PRO_CRC: Mode.PRO_CRC}
        if line in modes:
            self.set_mode(modes[line])
        elif line == RESET:
            self.restart()
        else:
            return answer_line(self.state, line, self.status()).encode("ascii") + END
        return Answer.OK.encode("ascii") + END

    def _pro(self, frame: Frame) -> Frame:
        if self.mode is Mode.PRO_CRC and not frame.crc_good:
            return refuse(frame.command & ~ERROR_FLAG, ErrorCode.CRC_WRONG)
        reply = answer_frame(self.registers, frame, self.status())
        if reply.command == Command.SET_MODE:
            self.set_mode(Mode.SIMPLE)
        return reply


def _refuse_damaged(damaged: Damaged) -> Frame:
    """The answer to bytes between boundaries that are no frame: to the command that they seem to hold, if any."""
    command = damaged.data[1] if len(damaged.data) > 1 else 0
    return refuse(command & ~ERROR_FLAG, ErrorCode.FRAME_INVALID)

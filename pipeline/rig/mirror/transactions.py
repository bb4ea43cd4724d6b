"""Transactions with one device: a lock, a deadline, what is retried and what never is, and what stays frozen."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from typing import Literal, TypeVar

from pipeline.errors import RigError
from pipeline.rig.device_settings import Patience
from pipeline.rig.devices import Clock, DeadlinePassed, DeviceGone, DeviceRefused, StateUnknown
from pipeline.rig.transports import Transport

LOG = logging.getLogger(__name__)
BITS_PER_BYTE = 10  # a start bit, eight of data, a stop bit

# a greeting is a read that a device in another mode does not answer, and before which others may have left bytes
Kind = Literal["greeting", "read", "write", "motion"]
_READS = ("greeting", "read")
Answer = TypeVar("Answer")
# Takes bytes as they come and gives the answer once it is whole.
Receiver = Callable[[bytes], Answer | None]


class Wire:
    """One device behind a transport. Only one transaction runs at a time, and each begins with an empty line.

    A read is asked again, within the deadline of the first; a write never is; a motion never is, and one that is not
    acknowledged freezes all motions: where the mirror is is for a person to see, who connects anew then.
    """

    def __init__(self, transport: Transport, clock: Clock, patience: Patience) -> None:
        self.transport = transport
        self.clock = clock
        self.patience = patience
        self.lock = threading.RLock()
        self.unknown = ""  # why the state is unknown; empty where it is known
        self._owed = 0  # requests whose answer may still come

    @property
    def port(self) -> str:
        """Name of the port."""
        return self.transport.port

    def exchange(self, data: bytes, name: str, kind: Kind, receiver: Callable[[], Receiver[Answer]]) -> Answer:
        """Send a request, called ``name`` in messages, and wait for its answer.

        ``receiver`` makes a receiver, one for each time that the request is sent. Raises StateUnknown where a motion
        was not acknowledged, or motions are frozen since an earlier one was not; DeviceRefused; DeadlinePassed where a
        read or a write was not answered in time; DeviceGone.
        """
        with self.lock:
            if kind == "motion":
                self.check_known(name)
            self._empty_line(f"before {name}", level=logging.INFO if kind == "greeting" else logging.WARNING)
            deadline = self.clock.now() + self.patience.deadline_s
            left = 1 + (self.patience.retries if kind in _READS else 0)
            while True:
                silence_s = (deadline - self.clock.now()) / left
                try:
                    return self._once(data, name, receiver(), silence_s, deadline)
                except RigError as error:
                    if kind == "motion" and not isinstance(error, DeviceRefused):
                        self.unknown = f"{name} was sent and not acknowledged"
                        raise StateUnknown(
                            f"{name} was sent to {self.port} and may have happened or not: {error}. It is not sent "
                            "again, and all motions are refused. Look at the mirror, then run again, which connects "
                            "anew"
                        ) from error
                    left -= 1
                    again = error.garbled if isinstance(error, DeviceRefused) else not isinstance(error, DeviceGone)
                    if left == 0 or not again:
                        raise
                    usual = kind == "greeting" and isinstance(error, DeadlinePassed) and error.silent
                    LOG.log(logging.INFO if usual else logging.WARNING, "%s; asking again", error)
                    self._empty_line("before asking again", deadline)
                    if self.clock.now() >= deadline:
                        raise
                except BaseException:  # whoever is interrupted here does not know either
                    self.unknown = f"{name} was interrupted" if kind == "motion" else self.unknown
                    raise

    def _once(self, data: bytes, name: str, receiver: Receiver[Answer], silence_s: float, deadline: float) -> Answer:
        """Send once, and wait until the device has said nothing for a while, or to the deadline where it goes on."""
        began = self.clock.now()
        self._owed += 1
        self.transport.write(data, deadline)
        came = b""
        until = min(began + silence_s, deadline)
        while self.clock.now() < until:
            part = self.transport.read(4096, until)
            until = min(self.clock.now() + silence_s, deadline) if part else until
            came += part
            try:
                answer = receiver(part) if part else None
            except DeviceRefused:  # an answer all the same; of what is none, the answer may still come
                self._owed -= 1
                raise
            if answer is not None:
                self._owed -= 1
                return answer
        said = f"{len(came)} bytes that are none came: {came[:32].hex(' ')}" if came else "nothing came"
        raise DeadlinePassed(
            f"no answer to {name} from {self.port} within {self.clock.now() - began:.3g} s ({said}); is the "
            f"controller on, its cable in, and the port's speed right?",
            silent=not came,
        )

    def _empty_line(self, when: str, latest: float = math.inf, *, level: int = logging.WARNING) -> None:
        """Drop what is on the line. Where an answer is still owed, wait for silence: it would pass for the next one."""
        stale = self.transport.drain()
        now = self.clock.now()
        latest = min(latest, now + 5 * self.patience.quiet_s)  # some devices never stop
        until = min(now + self.patience.quiet_s, latest)
        while self._owed and (part := self.transport.read(4096, until)):
            stale += part
            until = min(self.clock.now() + self.patience.quiet_s, latest)
        self._owed = 0
        if stale:
            LOG.log(level, "%s: dropped %d stale bytes %s: %s", self.port, len(stale), when, stale[:64].hex(" "))

    def check_known(self, name: str) -> None:
        """Refuse a motion where an earlier one was not acknowledged (StateUnknown)."""
        if self.unknown:
            raise StateUnknown(
                f"{name} is refused on {self.port}: {self.unknown}, so where the mirror is is not known. Look at it, "
                f"then run again, which connects anew"
            )

"""A transport with a script of sent and received bytes, which fails on every byte that differs."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count

from spectralzoom.pipeline.rig.fakes import FakeClock
from spectralzoom.pipeline.rig.transports import Clock


class Incoming:
    """Data on their way to a driver, possibly with an error; reading advances the clock."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.coming: list[tuple[float, int, bytes | Exception]] = []  # by the time at which they can be read
        self._order = count()

    def expect(self, when_s: float, data: bytes | Exception) -> None:
        """Schedule data for a time, after all that is scheduled for the same time."""
        heapq.heappush(self.coming, (when_s, next(self._order), data))

    def read(self, at_most: int, deadline: float) -> bytes:
        """Return the next part, at its time."""
        if not self.coming or self.coming[0][0] > deadline:
            self.clock.sleep(deadline - self.clock.now())
            return b""
        when_s, order, data = heapq.heappop(self.coming)
        self.clock.sleep(when_s - self.clock.now())
        if isinstance(data, Exception):
            raise data
        if data[at_most:]:
            heapq.heappush(self.coming, (when_s, order, data[at_most:]))
        return data[:at_most]


@dataclass(frozen=True)
class Late:
    """Bytes that can be read ``after_s`` after the request was sent."""

    after_s: float
    data: bytes


Reply = bytes | Late | Exception
Pair = tuple[bytes, bytes | Sequence[Reply]]


class ScriptedTransport(Incoming):
    """Transport that plays (sent, received) pairs. Received data may be parts, late or an error; waiting takes no time.

    ``stale`` is on the line at first.
    """

    port = "scripted"

    def __init__(self, pairs: Sequence[Pair], clock: FakeClock, stale: bytes = b"") -> None:
        super().__init__(clock)
        self.drained = b""
        self.sent = 0
        self.closed = False
        self._pairs = deque(pairs)
        if stale:
            self.expect(clock.now(), stale)

    def write(self, data: bytes) -> None:
        """Accept the next request, which must be equal to the byte."""
        assert self._pairs, f"nothing more was expected, {data.hex(' ')} was sent"
        expected, received = self._pairs.popleft()
        assert data == expected, f"expected {expected.hex(' ')}, {data.hex(' ')} was sent"
        self.sent += 1
        for part in [received] if isinstance(received, bytes) else received:
            after, reply = (part.after_s, part.data) if isinstance(part, Late) else (0.0, part)
            if reply:
                self.expect(self.clock.now() + after, reply)

    def read(self, at_most: int, deadline: float) -> bytes:
        """Return the next part, and record it where nothing is waited for."""
        waits = deadline > self.clock.now()
        found = super().read(at_most, deadline)
        self.drained += b"" if waits else found
        return found

    def close(self) -> None:
        """Record that the port was closed."""
        self.closed = True

    def check(self) -> None:
        """Fail on requests that were not sent, and on bytes that were not read."""
        assert not self._pairs, f"{self._pairs[0][0].hex(' ')} was not sent"
        assert not self.coming, f"{self.coming[0][2]!r} was not read"


@contextmanager
def scripted(pairs: Sequence[Pair], *, stale: bytes = b"", drained: bytes = b"") -> Iterator[ScriptedTransport]:
    """Play pairs, and fail at the end on unsent or unread ones. ``drained`` must be dropped unread."""
    transport = ScriptedTransport(pairs, FakeClock(), stale)
    yield transport
    transport.check()
    assert transport.drained == drained

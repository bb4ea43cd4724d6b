"""The mirror's whole vector memory through a real pty whose bytes are paced: wall time over the bytes' own.

2 x 1500 positions by the driver at two speeds, with each way of reading back. The time on the wire is that of the bytes
really sent and received, at 10 bits each, one after the other: a request waits for the reply before it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from measure import Row

from pipeline.rig.device_settings import ReadBack, SurveyRig
from pipeline.rig.emulator.emulated_rig import EmulatedPort
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.mirror_controller import open_mirror
from pipeline.rig.transports import BITS_PER_BYTE, SYSTEM_CLOCK, Transport

PAIRS = 1500
BAUDS = (115200, 256000)
READ_BACKS: tuple[ReadBack, ...] = ("none", "sampled", "all")
GOAL = 1.2
ROUNDS = 3


def rows() -> Sequence[Row]:
    return [_row(baud, read_back) for baud in BAUDS for read_back in READ_BACKS]


def _row(baud: int, read_back: ReadBack) -> Row:
    taken = [_upload(baud, read_back) for _ in range(ROUNDS)]
    wall_s, wire_s, cpu_s = min(taken)
    ratio = wall_s / wire_s
    return Row(
        f"upload of 2 x {PAIRS} positions at {baud} baud, read back: {read_back}",
        f"{ratio:.3f}x the wire time",
        f"<= {GOAL}x" if read_back == "none" else "",
        ratio <= GOAL if read_back == "none" else None,
        f"{wall_s:.2f} s for {wire_s:.2f} s of bytes; {cpu_s:.2f} s of processor, the emulator's included",
    )


class Counted:
    """A transport that counts what goes over it."""

    def __init__(self, transport: Transport) -> None:
        self.transport, self.bytes = transport, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.transport, name)

    def write(self, data: bytes, deadline: float) -> None:
        """Send and count."""
        self.bytes += len(data)
        self.transport.write(data, deadline)

    def read(self, at_most: int, deadline: float) -> bytes:
        """Read and count."""
        found = self.transport.read(at_most, deadline)
        self.bytes += len(found)
        return found


def _upload(baud: int, read_back: ReadBack) -> tuple[float, float, float]:
    """Wall time, time on the wire and processor time [s] of one upload."""
    turn = np.linspace(0, 2 * np.pi, PAIRS)
    positions = 0.9 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    device = MirrorDevice(SYSTEM_CLOCK)
    with (
        EmulatedPort(device, baud=baud) as port,
        open_mirror(SurveyRig(port=port.path, baud=baud, read_back=read_back), PAIRS) as mirror,
    ):
        mirror.halt()  # as the upload does first: everything is loaded
        mirror.wire.transport = counted = Counted(mirror.wire.transport)
        began_s, began_cpu_s = time.perf_counter(), time.process_time()
        mirror.load_path(positions)
        wall_s, cpu_s = time.perf_counter() - began_s, time.process_time() - began_cpu_s
        wire_s = counted.bytes * BITS_PER_BYTE / baud
    if not np.array_equal(device.state.memory, positions.T.ravel().astype(np.float32)):
        raise AssertionError("the memory holds something else")
    return wall_s, wire_s, cpu_s

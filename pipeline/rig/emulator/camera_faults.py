"""What can go wrong with the emulated camera, on request."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise

import numpy as np


class CameraFault(Enum):
    """A fault, and where it strikes."""

    SLOW = "slow"  # a reply, late but in time
    LATE = "late"  # a reply, after any deadline
    SILENT = "silent"  # a command is done and its reply lost
    SPLIT = "split"  # a reply in pieces
    MERGED = "merged"  # a reply together with one to a command that nobody sent
    STALE = "stale"  # a reply to another command before the right one
    NOT_JSON = "not JSON"  # a reply that is none
    HANGS_UP = "hangs up"  # a command is done and the connection closed without a reply
    FULL = "full"  # a capture, refused
    BUSY = "busy"  # a capture, refused
    CUT_CUBE = "cut off in a cube"  # a capture that ends within a line
    BREAKS_OFF = "breaks off"  # a transfer, closed half way
    REFUSES_FILES = "refuses files"  # a connection for files, closed at once


@dataclass
class CameraFaults:
    """Faults still to come, each so many times, after ``passes`` occasions; where pieces are cut is by the seed."""

    left: dict[CameraFault, int] = field(default_factory=dict)
    seed: int = 0
    passes: int = 0
    slow_s: float = 1.0
    late_s: float = 60.0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    @classmethod
    def of(cls, times: Mapping[CameraFault, int] | None, seed: int = 0) -> CameraFaults:
        """Faults, each to strike so many times."""
        return cls(dict(times or {}), seed)

    def strikes(self, fault: CameraFault) -> bool:
        """Whether the fault strikes now; it is then one less to come."""
        if self.left.get(fault, 0) < 1:
            return False
        if self.passes > 0:
            self.passes -= 1
            return False
        self.left[fault] -= 1
        return True

    def cut(self, data: bytes) -> list[bytes]:
        """Pieces of some bytes, two to seven where they are long enough."""
        count = min(int(self.rng.integers(1, 7)), max(len(data) - 1, 0))
        ends = sorted(int(end) + 1 for end in self.rng.permutation(max(len(data) - 1, 0))[:count])
        edges = [0, *ends, len(data)]
        return [data[start:stop] for start, stop in pairwise(edges)]

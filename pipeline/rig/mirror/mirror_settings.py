"""Settings of the mirror driver, and where those come from that nobody has confirmed on hardware."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.errors import SettingsError
from pipeline.geometry.mounting import STRAIGHT, Mounting
from pipeline.geometry.vector_memory import Ends
from pipeline.rig.mirror.steering import ReadBack


@dataclass(frozen=True)
class Patience:
    """How long a transaction may take, how often a read is asked again within that, and how long silence lasts. [s]"""

    deadline_s: float = 1.0
    retries: int = 2
    quiet_s: float = 0.1


@dataclass(frozen=True)
class MirrorSettings:
    """How to reach the mirror controller, and what to believe of it.

    Assumed until tried on hardware: ``baud`` (public software opens 115200, the manual of a later model says 256000;
    over USB it does not matter), ``with_crc`` and that the CRC of replies fits (hence ``strict_crc`` off), ``ends``
    (erratum E14), ``vector_pairs`` (2900 cells are used in public), ``log_samples`` (not published). ``provenance``
    says who confirmed what.
    """

    port: str = "/dev/ttyACM0"
    baud: int = 115200
    expected_id: str = ""  # part of what GETID answers; empty takes any
    deadline_s: float = 1.0  # of one transaction, retries included
    retries: int = 2  # of requests that only read
    quiet_s: float = 0.1  # silence after which an answer that is owed will not come
    with_crc: bool = True
    strict_crc: bool = False
    ends: Ends = "exclusive"
    vector_pairs: int = 1500
    read_back: ReadBack = "sampled"
    check_status: bool = True  # before each motion
    park_at_close: bool = False
    log_rate_hz: float = 10000.0
    log_samples: int = 2000
    provenance: str = "assumed"
    mounting: Mounting = STRAIGHT

    def __post_init__(self) -> None:
        for name, low, high in _RANGES:
            value = getattr(self, name)
            if isinstance(value, bool) or not (math.isfinite(value) and low <= value <= high):
                raise SettingsError(f"mirror.{name} must lie between {low:g} and {high:g}, got {value!r}")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise SettingsError(f"mirror.{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")

    @property
    def patience(self) -> Patience:
        """How long transactions may take."""
        return Patience(self.deadline_s, self.retries, self.quiet_s)


_RANGES = (
    ("baud", 1200, 4_000_000),
    ("deadline_s", 0.01, 60),
    ("retries", 0, 20),
    ("quiet_s", 0, 5),
    ("vector_pairs", 1, 8191),  # cells are addressed by a byte offset of 16 bits
    ("log_rate_hz", 0.1, 10000),
    ("log_samples", 1, 16383),
)
_CHOICES = {"ends": ("exclusive", "inclusive"), "read_back": ("none", "sampled", "all")}

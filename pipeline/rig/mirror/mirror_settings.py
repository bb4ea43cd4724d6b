"""Settings of the mirror driver, and where those come from that nobody has confirmed on hardware."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from pipeline.errors import SettingsError
from pipeline.geometry.mirror import STRAIGHT, Mounting
from pipeline.geometry.scan import CostModel, Ends
from pipeline.rig.mirror.steering import ReadBack
from pipeline.stated import assumed, check_stated, stated


@dataclass(frozen=True)
class Patience:
    """How long a transaction may take, how often a read is asked again within that, and how long silence lasts. [s]"""

    deadline_s: float = 1.0
    retries: int = 2
    quiet_s: float = 0.1


@dataclass(frozen=True)
class MirrorLink:
    """What settings say of the mirror controller."""

    port: str = stated("/dev/ttyACM0", "Port of the mirror controller; or socket://host:port")
    # public software opens 115200
    baud: int = assumed(
        115200, "Bits a second; over USB any will do; the manual of a later model says 256000", "", 1200, 4_000_000
    )
    expected_id: str = stated("", "Part of what the controller calls itself; any by default", example="MR-E")
    deadline_s: float = stated(
        Patience.deadline_s, "Time for one request to the mirror, retries included", "s", 0.01, 60
    )
    retries: int = stated(Patience.retries, "Of requests that only read; motions are sent once", "", 0, 20)
    quiet_s: float = assumed(Patience.quiet_s, "Silence after which an answer that is owed will not come", "s", 0, 5)
    with_crc: bool = assumed(True, "Requests carry a CRC")
    strict_crc: bool = stated(False, "Refuse replies whose CRC does not fit, which is warned of otherwise")
    ends: Ends = assumed("exclusive", "What the mirror takes the end of a range for")  # erratum E14
    read_back: ReadBack = stated("sampled", "How much of a path is read back and compared")
    check_status: bool = stated(True, "Ask for the mirror's status before each motion")
    park_at_close: bool = stated(False, "Send the mirror to 0; 0 at the end")
    log_rate_hz: float = stated(
        10000.0, "Rate of measured positions, at most; without pulses they place the lines", "Hz", 0.1, 10_000
    )
    log_samples: int = assumed(2000, "Samples that the controller's log holds", "", 1, 16_383)  # not published


MOST_PAIRS = 8191  # cells of the vector memory are addressed by a byte offset of 16 bits


@dataclass(frozen=True)
class MirrorSettings(MirrorLink):
    """How to reach the mirror controller, and what to believe of it; ``provenance`` says who confirmed what."""

    vector_pairs: int = stated(CostModel.vector_pairs, "Positions that its memory holds", "", 1, MOST_PAIRS)
    provenance: str = "assumed"
    mounting: Mounting = STRAIGHT

    def __post_init__(self) -> None:
        check_stated(self, "mirror")
        for name, choices in {"ends": get_args(Ends), "read_back": get_args(ReadBack)}.items():
            if getattr(self, name) not in choices:
                raise SettingsError(f"mirror.{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")

    @property
    def patience(self) -> Patience:
        """How long transactions may take."""
        return Patience(self.deadline_s, self.retries, self.quiet_s)

"""Registers and status bits of the mirror controller. A register's id is its system's, times 256, plus its number.

From what the maker publishes and from public software for the controller; none of it was tried on hardware. Positions
(units of 1 at the rim of the mirror's disk) are what unit 2, XY, stands for.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

CHANNELS = 2  # 0 is X, 1 is Y

FEEDBACK_X, FEEDBACK_Y = 0x2302, 0x2303
LOG_SLOTS = 6
LOG_RUN, LOG_RATE = 0x2410, 0x2411
VECTOR_MEMORY = 0x2600  # one vector, shared by the channels


class Unit(IntEnum):
    """What the numbers of an input are."""

    CURRENT = 0
    FEEDBACK = 1
    XY = 2


class Trigger(IntEnum):
    """Which edges at the trigger input step through the vector memory."""

    OFF = 0
    BOTH_EDGES = 1
    RISING_EDGE = 2


class Status(IntFlag):
    """Status bits, and what each says. The ``WAS`` bits stay until they are acknowledged."""

    says: str

    DISCONNECTED = 1 << 0, "the mirror head is not connected"
    ELECTRONICS_WARM = 1 << 1, "the mirror head's electronics are too warm"
    MIRROR_WARM = 1 << 2, "the mirror is too warm"
    EEPROM_INVALID = 1 << 3, "the mirror's own calibration cannot be read"
    NOT_STABLE = 1 << 4, "the mirror is not at rest"
    OUTPUT_LIMIT = 1 << 5, "the drive is at its limit"
    AVERAGE_LIMIT = 1 << 6, "the drive's average is at its limit"
    TRIMMED = 1 << 7, "a target was beyond the rim, and was trimmed to it"
    WAS_DISCONNECTED = 1 << 8, "the mirror head was not connected (since acknowledged last)"
    WAS_ELECTRONICS_WARM = 1 << 9, "the mirror head's electronics were too warm (since acknowledged last)"
    WAS_MIRROR_WARM = 1 << 10, "the mirror was too warm (since acknowledged last)"
    WAS_OUTPUT_LIMIT = 1 << 11, "the drive was at its limit (since acknowledged last)"
    WAS_AVERAGE_LIMIT = 1 << 12, "the drive's average was at its limit (since acknowledged last)"
    WAS_TRIMMED = 1 << 13, "a target was trimmed to the rim (since acknowledged last)"

    def __new__(cls, bit: int, says: str = "") -> Status:
        status = int.__new__(cls, bit)
        status._value_, status.says = bit, says
        return status

    @property
    def words(self) -> list[str]:
        """What is on, in words for whoever stands before the rig; bits without a known meaning by their number."""
        known = [bit.says for bit in Status if bit in self]
        rest = int(self) & ~sum(Status)
        return known + [f"bit {place}, whose meaning is not known" for place in range(32) if rest >> place & 1]

    @property
    def sentence(self) -> str:
        """The bits and what they say, for messages."""
        return f"status {int(self):08X}: {'; '.join(self.words) or 'nothing is amiss'}"

    @property
    def stops_motion(self) -> bool:
        """Whether something is on, now, with which the mirror does not go where it is sent."""
        return bool(self & _STOPS)


_STOPS = Status.DISCONNECTED | Status.ELECTRONICS_WARM | Status.MIRROR_WARM | Status.EEPROM_INVALID


@dataclass
class ChannelRegisters:
    """The registers of one channel: the inputs it can follow, and which of them it does."""

    channel: int

    def __post_init__(self) -> None:
        self.static_system = 0x50 + self.channel  # of held positions
        self.vector_system = 0x68 + self.channel  # plays the vector memory
        self.xy_system = 0xC0 + self.channel  # controls position
        self.static_xy = self.static_system << 8 | Unit.XY  # held position, float
        self.input = 0x4000 + 5 * self.channel  # which system the channel follows
        self.control = 0x4002 + 5 * self.channel  # which system controls the channel

    def vector(self, register: VectorRegister) -> int:
        """Id of a register of the vector unit."""
        return self.vector_system << 8 | register

    def followed(self, system: int) -> dict[int, int]:
        """Values that make the channel follow an input, controlled by position."""
        return {self.control: self.xy_system, self.input: system}


class VectorRegister(IntEnum):
    """Registers of the vector unit."""

    UNIT = 0x0
    RUN = 0x1
    START = 0x2
    END = 0x3
    FREQUENCY = 0x4  # cells per second, float
    LOWEST = 0x5  # float, read only
    HIGHEST = 0x6  # float, read only
    CYCLES = 0x7  # -1 is without end
    TRIGGER = 0x8
    OUTPUT = 0x9  # float, read only
    INDEX = 0xA  # read only


X, Y = ChannelRegisters(0), ChannelRegisters(1)


def log_slot(slot: int) -> int:
    """Id of the register that says what a slot of the logger takes down, and of the vector that it takes down."""
    return 0x2400 | slot

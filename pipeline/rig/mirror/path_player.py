"""The controller's vector units: which part of the vector memory plays, how fast, and whether it does now."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.errors import SettingsError
from pipeline.rig.mirror.mirror_requests import ProLink
from pipeline.rig.mirror.pro_payloads import Value, cell_int, get_value, get_values, read_values, set_values
from pipeline.rig.mirror.registers import ChannelRegisters, Trigger, Unit, VectorRegister, X, Y
from pipeline.vector_memory import Ends, device_range


@dataclass(frozen=True)
class Play:
    """What plays: positions ``first`` to ``stop`` of those loaded, half open, at ``rate_hz``, ``cycles`` times."""

    first: int
    stop: int
    rate_hz: float
    cycles: int = 1  # -1 is without end
    trigger: Trigger = Trigger.OFF

    def check(self, loaded: int) -> None:
        """Refuse what cannot play.

        Raises
        ------
        SettingsError : the range is not within the ``loaded`` positions, or the rate or the cycles mean nothing.
        """
        if not (0 <= self.first < self.stop <= loaded):
            raise SettingsError(
                f"{self.first}:{self.stop} is no range of the {loaded} positions loaded; load them first"
            )
        if not (0 < self.rate_hz < float("inf")) or self.cycles == 0 or not -1 <= self.cycles < 2**31:
            raise SettingsError(
                f"expected a rate above 0 Hz, and cycles of 1 or more, or -1 for no end, got {self.rate_hz} Hz and "
                f"{self.cycles} cycles"
            )


class PathPlayer:
    """The vector units of both channels. X plays from cell 0 on, Y from behind the X of all loaded positions."""

    def __init__(self, link: ProLink, ends: Ends) -> None:
        self._link = link
        self._ends = ends

    def set_up(self, play: Play, loaded: int) -> None:
        """Tell both units what to play; nothing moves."""
        for name, begin, channel in (("X", 0, X), ("Y", loaded, Y)):
            start, end = device_range((begin + play.first, begin + play.stop), self._ends)
            values: dict[VectorRegister, Value] = {
                VectorRegister.UNIT: int(Unit.XY), VectorRegister.START: start, VectorRegister.END: end,
                VectorRegister.FREQUENCY: float(play.rate_hz), VectorRegister.CYCLES: play.cycles,
                VectorRegister.TRIGGER: int(play.trigger),
            }  # fmt: skip
            frame = set_values({channel.vector(register): value for register, value in values.items()})
            self._link.tell(frame, f"setting up the path's {name}")

    def halt(self) -> None:
        """Stop both units."""
        self._link.tell(set_values({channel.vector(VectorRegister.RUN): 0 for channel in (X, Y)}), "halting the path")

    def is_playing(self) -> bool:
        """Whether a unit plays."""
        registers = [channel.vector(VectorRegister.RUN) for channel in (X, Y)]
        cells = self._link.ask(get_values(registers), "whether a path plays", read_values)
        return any(cell_int(cell) for cell in cells)

    def index(self) -> int:
        """Cell that X plays now, which is the position."""
        return self._link.ask(get_value(X.vector(VectorRegister.INDEX)), "the place in the path", cell_int)


def run_values() -> dict[int, Value]:
    """Registers that make both channels play, in one frame so that they begin together."""
    return {
        **followed(X, X.vector_system), **followed(Y, Y.vector_system),
        X.vector(VectorRegister.RUN): 1, Y.vector(VectorRegister.RUN): 1,
    }  # fmt: skip


def hold_values(x: float, y: float) -> dict[int, Value]:
    """Registers that send both channels to a position, hold it and end any path, in one frame, which they fill."""
    return {
        X.static_xy: float(x), Y.static_xy: float(y),
        **followed(X, X.static_system), **followed(Y, Y.static_system),
        X.vector(VectorRegister.RUN): 0, Y.vector(VectorRegister.RUN): 0,
    }  # fmt: skip


def followed(channel: ChannelRegisters, system: int) -> dict[int, Value]:
    """Registers that make a channel follow an input, controlled by position."""
    return {channel.control: channel.xy_system, channel.input: system}

"""How the emulated controller answers lines of simple mode.

Assumed: NO answers a line that is not known, ERROR one that is known and cannot be read; a position beyond the rim is
pulled in to it, and the answer says to which side it lay.
"""

from __future__ import annotations

import re

from pipeline.rig.emulator.mirror_state import MirrorState
from pipeline.rig.mirror.registers import CHANNELS, ChannelRegisters, Status, Unit
from pipeline.rig.mirror.simple_mode import (
    ACKNOWLEDGE,
    END,
    ID,
    MOST_LINE,
    SERIAL,
    START,
    STATUS,
    TEMPERATURE,
    VERSION,
    Answer,
)  # fmt: skip

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:E[-+]?\d+)?"
_PLACE = re.compile(rf"(X|Y|XY)=({_NUMBER})(?:;({_NUMBER}))?")


def answer_line(state: MirrorState, line: str, status: Status) -> str:
    """Carry out a line, in capitals and without its end, and give the answer without an end.

    Lines that change the mode or restart the controller are not known here.
    """
    if len(line) + len(END) > MOST_LINE:
        return Answer.ERROR
    unit = state.unit
    texts = {
        ID: unit.model,
        VERSION: unit.version,
        SERIAL: unit.serial_number,
        TEMPERATURE: f"{unit.temperature_c:.2f}",
    }
    if line in texts:
        return texts[line]
    if line == STATUS:
        return f"{int(status):08X}"
    if line == ACKNOWLEDGE:
        state.acknowledge()
        return Answer.OK
    if line == START:
        return Answer.OK
    return _go(state, line)


def _go(state: MirrorState, line: str) -> Answer:
    name, equals, _ = line.partition("=")
    if not equals or name not in ("X", "Y", "XY"):
        return Answer.NO
    found = _PLACE.fullmatch(line)
    if found is None or (name == "XY") != (found[3] is not None):
        return Answer.ERROR
    places = [float(number) for number in found.groups()[1:] if number is not None]
    x, y = (axis[Unit.XY] for axis in state.static)
    x, y = {"X": (places[0], y), "Y": (x, places[0]), "XY": (places[0], places[-1])}[name]
    for channel in range(CHANNELS):
        registers = ChannelRegisters(channel)
        state.inputs[channel], state.controls[channel] = registers.static_system, registers.xy_system
    state.hold({0: x, 1: y})
    if not state.trimmed:
        return Answer.OK
    return Answer.BELOW if -min(places) > max(places) else Answer.ABOVE

"""What a capture is called: its prefix says which lines of which sweep it takes, so that a folder tells what it holds.

``coarse-0_cy-31p5_0p5_96x16x16_0`` is the sweep ``coarse-0``, a coarse one whose lines lie along y, on strip -31.5 px,
from scan coordinate 0.5 px on, of 96 lines of 16 held positions, binned by 16; the capture begins at its line 0. ``p``
is the decimal point; a number that takes more room than its bits is ``b`` and those, to base 32.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Literal

from pipeline.rig.camera.camera_settings import check_capture
from pipeline.scan import Axis, Sweep

REFERENCES = "references"  # prefix of a capture that is made for the dark and white frames in its folder
_DIGITS = "0123456789abcdefghijklmnopqrstuv"
_LONGEST = 14  # b and 64 bits
_NUMBER = r"(-?\d+(?:p\d+)?|b[0-9a-v]{13})"
_FORM = re.compile(rf"(.+)_([cf])([xy]){_NUMBER}_{_NUMBER}_(\d+)x(\d+)x(\d+)_(\d+)", re.DOTALL)
_KINDS: dict[str, Literal["coarse", "fine"]] = {"c": "coarse", "f": "fine"}


@dataclass(frozen=True)
class Announced:
    """A sweep, and its line that a capture's first frame takes."""

    sweep: Sweep
    first: int


def capture_prefix(sweep: Sweep, first: int = 0) -> str:
    """Give the prefix of a capture of a sweep's lines from ``first`` on.

    Raises
    ------
    SettingsError : the sweep's name holds what a folder's name must not, or is too long.
    """
    sizes = f"{sweep.lines}x{sweep.step}x{sweep.binning}"
    place = f"{sweep.kind[0]}{sweep.along}{_written(sweep.strip_px)}_{_written(sweep.start_px)}"
    prefix = f"{sweep.name}_{place}_{sizes}_{first}"
    check_capture(0, 0, prefix)
    return prefix


def announced(prefix: str) -> Announced | None:
    """Read a capture's prefix; None where it announces no sweep."""
    found = _FORM.fullmatch(prefix)
    if found is None:
        return None
    name, kind, along, strip, start, *sizes = found.groups()
    axis: Axis = "x" if along == "x" else "y"
    lines, step, binning, first = map(int, sizes)
    if lines < 1 or step < 1 or binning < 1 or first >= lines:
        return None
    return Announced(Sweep(name, _KINDS[kind], axis, _read(strip), _read(start), lines, step, binning), first)


def _written(value: float) -> str:
    short = repr(float(value)).removesuffix(".0")
    if len(short) < _LONGEST and set(short) <= set("-.0123456789"):
        return short.replace(".", "p")
    bits = int.from_bytes(struct.pack(">d", value), "big")
    return "b" + "".join(_DIGITS[bits >> shift & 31] for shift in range(60, -1, -5))


def _read(text: str) -> float:
    if not text.startswith("b"):
        return float(text.replace("p", "."))
    bits = 0
    for digit in text[1:]:
        bits = bits << 5 | _DIGITS.index(digit)
    return float(struct.unpack(">d", (bits & (1 << 64) - 1).to_bytes(8, "big"))[0])

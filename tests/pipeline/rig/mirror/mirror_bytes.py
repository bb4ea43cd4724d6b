"""Exchanges with the mirror controller, as bytes written by hand from the protocol, not by the encoder."""

from __future__ import annotations

import struct
from typing import Any

from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.mirror_controller import MirrorController
from spectralzoom.pipeline.rig.pro_mode import Frame
from tests.pipeline.rig.scripted import Pair, ScriptedTransport


def pair(sent: str, received: str) -> Pair:
    """Return a pair of bytes from hexadecimal."""
    return bytes.fromhex(sent), bytes.fromhex(received)


def set_value(register: int, value: float) -> Frame:
    """Return a frame that sets one register, which the driver never sends."""
    return Frame(0x10, register.to_bytes(2, "big") + struct.pack(">f", value))


def get_value(register: int) -> Frame:
    """Return a request for one register, which the driver never sends."""
    return Frame(0x11, register.to_bytes(2, "big"))


ASK_FIRMWARE = Frame(0x01, b"\x00\x00")
GREET: Pair = (b"START\r\n", b"OK\r\n")
WHO: list[Pair] = [(b"GETID\r\n", b"MR-E-2\r\n"), (b"GETVERSION\r\n", b"1.2.4065\r\n"), (b"GETSN\r\n", b"ABCD0123\r\n")]
ENTER: Pair = (b"GOPROCRC\r\n", b"OK\r\n")
LEAVE = pair("7E 00 06 02 00 00 A1 48 7E", "7E 00 06 00 03 A0 7E")
WELL = pair("7E 00 02 02 00 00 A0 78 7E", "7E 00 02 04 00 00 00 00 F0 22 7E")
WARM = pair("7E 00 02 02 00 00 A0 78 7E", "7E 00 02 04 00 00 00 04 F1 E1 7E")
UNREST = pair("7E 00 02 02 00 00 A0 78 7E", "7E 00 02 04 00 00 00 10 F1 EE 7E")
TRIMMED = pair("7E 00 02 02 00 00 A0 78 7E", "7E 00 02 04 00 00 00 80 F1 82 7E")
CONNECT: list[Pair] = [GREET, *WHO, ENTER, WELL]
DONE = "7E 00 12 00 0C A0 7E"  # acknowledgement of several registers
GOTO = (  # positions 0.5 and -0.25, control C0 and C1, inputs 50 and 51, both units stopped
    "7E 00 12 32 00 08 50 02 51 02 40 02 40 00 40 07 40 05 68 01 69 01 3F 00 00 00 BE 80 00 00 00 00 00 C0"
    " 00 00 00 50 00 00 00 C1 00 00 00 51 00 00 00 00 00 00 00 00 BA 0A 7E"
)
PATH = [[0.5, -0.25], [0, 0], [1, 0]]
LOAD = pair(
    "7E 00 14 1D 26 00 00 00 18 3F 00 00 00 00 00 00 00 3F 80 00 00 BE 80 00 00 00 00 00 00 00 00 00 00 DC 2D 7E",
    "7E 00 14 00 0F 00 7E",
)
READ_BACK = pair(
    "7E 00 15 05 26 00 00 00 18 4D 59 7E",
    "7E 00 15 18 3F 00 00 00 00 00 00 00 3F 80 00 00 BE 80 00 00 00 00 00 00 00 00 00 00 81 75 7E",
)
HALT = pair("7E 00 12 0E 00 02 68 01 69 01 00 00 00 00 00 00 00 00 BE 49 7E", DONE)
# Three positions at 10 Hz: X in cells 0 to 3, Y in cells 3 to 6, ends excluded.
SET_X = pair(
    "7E 00 12 26 00 06 68 00 68 02 68 03 68 04 68 07 68 08"
    " 00 00 00 02 00 00 00 00 00 00 00 03 41 20 00 00 00 00 00 01 00 00 00 00 8E C3 7E",
    DONE,
)
SET_Y = pair(
    "7E 00 12 26 00 06 69 00 69 02 69 03 69 04 69 07 69 08"
    " 00 00 00 02 00 00 00 03 00 00 00 06 41 20 00 00 00 00 00 01 00 00 00 00 49 85 7E",
    DONE,
)
SET_X_INCLUSIVE = pair(
    "7E 00 12 26 00 06 68 00 68 02 68 03 68 04 68 07 68 08"
    " 00 00 00 02 00 00 00 00 00 00 00 02 41 20 00 00 00 00 00 01 00 00 00 00 8C 42 7E",
    DONE,
)
SET_Y_INCLUSIVE = pair(
    "7E 00 12 26 00 06 69 00 69 02 69 03 69 04 69 07 69 08"
    " 00 00 00 02 00 00 00 03 00 00 00 05 41 20 00 00 00 00 00 01 00 00 00 00 4C 46 7E",
    DONE,
)
RUN = (  # control C0 and C1, inputs 68 and 69, both units running
    "7E 00 12 26 00 06 40 02 40 00 40 07 40 05 68 01 69 01"
    " 00 00 00 C0 00 00 00 68 00 00 00 C1 00 00 00 69 00 00 00 01 00 00 00 01 AE E3 7E"
)


def connected(transport: ScriptedTransport, vector_pairs: int = 1500, **settings: Any) -> MirrorController:
    """Return a connected controller; the script begins with CONNECT, and its CRCs have to fit."""
    told = {"with_crc": True, **settings}
    mirror = MirrorController(transport, SurveyRig(**told), transport.clock, vector_pairs=vector_pairs)
    mirror.connect()
    return mirror

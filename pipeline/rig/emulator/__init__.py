"""Emulators of the rig's devices: the same bytes as the documented protocols, over a pty, a socket or in process."""

from typing import NamedTuple


class Chunk(NamedTuple):
    """Bytes that a device sends, so long after it took the request. [s]"""

    delay_s: float
    data: bytes

"""Where the camera is, how long it is waited for, and what it is never asked to do: refused before anything is sent."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from pipeline.errors import SettingsError

_PREFIX = re.compile(r"[A-Za-z0-9_-]{0,64}")


@dataclass(frozen=True)
class CameraAddress:
    """Where the camera is; as its maker sets it, unless changed there."""

    host: str = "10.0.65.50"
    port: int = 8100
    connect_s: float = 3.0


@dataclass(frozen=True)
class ControlPatience:
    """How long a command may take from its first byte to the prompt, and how often reads are asked again."""

    deadline_s: float = 5.0
    retries: int = 2
    pause_s: float = 0.5  # before connecting again


@dataclass(frozen=True)
class FileServer:
    """The camera's FTP server, and how long it is waited for. User and password as public programs use them."""

    host: str = CameraAddress.host
    port: int = 21
    user: str = "ftpuser"
    password: str = "ftpuser"
    stall_s: float = 10.0  # for a reply, for logging in, and for least_kb_s * stall_s of a file
    tries: int = 3  # without a byte gained in between
    pause_s: float = 1.0
    block: int = 1 << 16  # bytes handed over at a time
    overlap: int = 4096  # last bytes held that are fetched again, to see that it is the same file
    least_kb_s: float = 100.0  # of a file that comes; slower counts as stalled
    read_twice: bool = True  # every byte, to see that no other came: FTP has no checksums of its own

    @property
    def where(self) -> str:
        """The server in messages."""
        return f"the camera's file server {self.host}:{self.port}"

    def most_s(self, size: int) -> float:
        """Seconds that a file of ``size`` bytes may take with all its tries."""
        return 2 * size / (1e3 * self.least_kb_s) + 3 * self.tries * (self.stall_s + self.pause_s)


@dataclass(frozen=True)
class CameraLimits:
    """What is refused before the wire. Assumed, from a data sheet: set them for the camera at hand."""

    least_exposure_ms: float = 0.5
    most_rate_hz: float = 350.0
    most_period_ms: float = 10_000.0


def check_times(exposure_ms: float, frame_period_ms: float, limits: CameraLimits) -> None:
    """Refuse times that cannot be meant.

    Raises
    ------
    SettingsError : a time is none, too short (given in seconds?) or too long, or the exposure exceeds the period.
    """
    least_period_ms = 1000 / limits.most_rate_hz
    _check_time("exposure", exposure_ms, limits.least_exposure_ms, limits.most_period_ms)
    _check_time("frame period", frame_period_ms, least_period_ms * (1 - 1e-6), limits.most_period_ms)
    if exposure_ms > frame_period_ms:
        raise SettingsError(
            f"an exposure of {exposure_ms:g} ms does not fit a frame period of {frame_period_ms:g} ms; "
            f"take a period of at least {exposure_ms:g} ms"
        )


def check_capture(frames: int, cubes: int, prefix: str) -> None:
    """Refuse numbers and prefixes that cannot be meant.

    Raises
    ------
    SettingsError : a number is none, or the prefix is no part of a folder's name.
    """
    for name, number in (("frames", frames), ("cubes", cubes)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 0:
            raise SettingsError(f"expected a whole number of {name}, or 0 for no limit, got {number!r}")
    if not _PREFIX.fullmatch(prefix):
        raise SettingsError(f"a prefix names a folder: expected up to 64 letters, digits, - and _, got {prefix!r}")


def _check_time(name: str, value_ms: float, least_ms: float, most_ms: float) -> None:
    if isinstance(value_ms, bool) or not math.isfinite(value_ms) or value_ms <= 0:
        raise SettingsError(f"expected {name} above 0 ms, got {value_ms!r}; correct it")
    if value_ms < least_ms:
        raise SettingsError(
            f"{name} of {value_ms:g} ms is below {least_ms:.4g} ms; it is given in ms: {value_ms:g} s would be "
            f"{value_ms * 1000:g}"
        )
    if value_ms > most_ms:
        raise SettingsError(
            f"{name} of {value_ms:g} ms is above {most_ms:g} ms; it is given in ms: {value_ms:g} us would be "
            f"{value_ms / 1000:g}"
        )

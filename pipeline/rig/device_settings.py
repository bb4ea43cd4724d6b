"""Settings of both devices of a rig and of their drivers, and the table [rig] of a survey that holds them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from typing import Literal

from pipeline.errors import SettingsError
from pipeline.geometry.mirror import STRAIGHT, Axes, Mounting
from pipeline.geometry.scan import CostModel, Ends
from pipeline.setting_fields import assumed, check_stated, stated

ReadBack = Literal["none", "sampled", "all"]
Pulses = Literal["position", "frame", "none"]
MOST_PAIRS = 8191  # cells of the vector memory are addressed by a byte offset of 16 bits


@dataclass(frozen=True)
class CameraAddress:
    """Address of the camera, as its maker sets it, unless changed there."""

    host: str = "10.0.65.50"
    port: int = 8100
    connect_s: float = 3.0


@dataclass(frozen=True)
class ControlPatience:
    """Time that a command may take from its first byte to the prompt, and how often reads are asked again."""

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
        """Return the seconds that a file of ``size`` bytes may take with all its tries."""
        return 2 * size / (1e3 * self.least_kb_s) + 3 * self.tries * (self.stall_s + self.pause_s)


@dataclass(frozen=True)
class CameraLimits:
    """Limits that are checked before the wire. Assumed, from a data sheet: set them for the camera at hand."""

    least_exposure_ms: float = 0.5
    most_rate_hz: float = 350.0
    most_period_ms: float = 10_000.0


def check_times(exposure_ms: float, frame_period_ms: float, limits: CameraLimits) -> None:
    """Refuse times that cannot be meant (SettingsError): none, too short (given in seconds?), too long, not fitting."""
    least_period_ms = 1000 / limits.most_rate_hz * (1 - 1e-6)
    for name, value_ms, least_ms in (
        ("exposure", exposure_ms, limits.least_exposure_ms),
        ("frame period", frame_period_ms, least_period_ms),
    ):
        if isinstance(value_ms, bool) or not math.isfinite(value_ms) or value_ms <= 0:
            raise SettingsError(f"expected {name} above 0 ms, got {value_ms!r}; correct it")
        if value_ms < least_ms:
            raise SettingsError(
                f"{name} of {value_ms:g} ms is below {least_ms:.4g} ms; it is given in ms: {value_ms:g} s would be "
                f"{value_ms * 1000:g}"
            )
        if value_ms > limits.most_period_ms:
            raise SettingsError(
                f"{name} of {value_ms:g} ms is above {limits.most_period_ms:g} ms; it is given in ms: {value_ms:g} us "
                f"would be {value_ms / 1000:g}"
            )
    if exposure_ms > frame_period_ms:
        raise SettingsError(
            f"an exposure of {exposure_ms:g} ms does not fit a frame period of {frame_period_ms:g} ms; "
            f"take a period of at least {exposure_ms:g} ms"
        )


def check_capture(frames: int, cubes: int, prefix: str) -> None:
    """Refuse numbers that are none, and a prefix that is no part of a folder's name (SettingsError)."""
    for name, number in (("frames", frames), ("cubes", cubes)):
        if isinstance(number, bool) or not isinstance(number, int) or number < 0:
            raise SettingsError(f"expected a whole number of {name}, or 0 for no limit, got {number!r}")
    if not re.fullmatch(r"[A-Za-z0-9_-]{0,64}", prefix):
        raise SettingsError(f"a prefix names a folder: expected up to 64 letters, digits, - and _, got {prefix!r}")


@dataclass(frozen=True)
class Patience:
    """Time that a transaction may take, how often a read is asked again within that, and how long silence lasts. [s]"""

    deadline_s: float = 1.0
    retries: int = 2
    quiet_s: float = 0.1


@dataclass(frozen=True)
class MirrorLink:
    """Settings of the link to the mirror controller."""

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
    with_crc: bool = assumed(False, "Requests carry a CRC; `rig check` tries both")
    strict_crc: bool = stated(False, "Refuse replies whose CRC does not fit, which is warned of otherwise")
    ends: Ends = assumed("exclusive", "What the mirror takes the end of a range for")  # erratum E14
    read_back: ReadBack = stated("sampled", "How much of a path is read back and compared")
    log_rate_hz: float = stated(
        10000.0, "Rate of measured positions, at most; without pulses they place the lines", "Hz", 0.1, 10_000
    )
    log_samples: int = assumed(2000, "Samples that the controller's log holds", "", 1, 16_383)  # not published


@dataclass(frozen=True)
class MirrorSettings(MirrorLink):
    """Settings of the mirror controller: its port and assumptions on it; ``provenance`` says who confirmed what."""

    vector_pairs: int = stated(CostModel.vector_pairs, "Positions that its memory holds", "", 1, MOST_PAIRS)
    provenance: str = "assumed"
    mounting: Mounting = STRAIGHT

    def __post_init__(self) -> None:
        check_stated(self, "mirror")

    @property
    def patience(self) -> Patience:
        """Return deadline, retries and quiet time of transactions."""
        return Patience(self.deadline_s, self.retries, self.quiet_s)


@dataclass(frozen=True)
class SurveyRig(MirrorLink):
    """The table [rig] of a survey: both devices, the cable between them, and the white reference.

    Written for the documented protocols and tested against emulators; never run on hardware. ``provenance`` says which
    of the assumed values are confirmed.
    """

    mirror_driver: str = stated(
        "",
        "Driver of a mirror of another make, as module:function; by default that of the MR-E-2",
        example="lab:mirror",
    )
    camera_driver: str = stated(
        "",
        "Driver of a camera of another make, as module:function; by default that of the Nano-Hyperspec",
        example="lab:camera",
    )
    mirror_axes: Axes = assumed(
        Mounting.axes,
        "What the device's X and Y are of a mirror mounted straight: '-x,-y' is upside down, 'y,-x' turned",
    )
    mirror_clocking_deg: float = stated(
        Mounting.clocking_deg, "Small turn of the mirror beyond that, anticlockwise from X to Y", "deg", -45, 45
    )
    mirror_offset_x: float = stated(
        Mounting.offset_x, "The device's X where the mirror looks straight ahead, of -1 to 1", "", -0.5, 0.5
    )
    mirror_offset_y: float = stated(Mounting.offset_y, "The device's Y there", "", -0.5, 0.5)
    host: str = stated(CameraAddress.host, "Address of the camera, as its maker sets it")
    control_port: int = stated(CameraAddress.port, "Port of its commands", "", 1, 65_535)
    file_port: int = stated(FileServer.port, "Port of its FTP server", "", 1, 65_535)
    user: str = stated(FileServer.user, "User of its FTP server")
    password: str = stated(FileServer.password, "Password of that user; receipts do not repeat it")
    connect_s: float = stated(CameraAddress.connect_s, "Most that the camera may take to answer at all", "s", 0.1, 60)
    stall_s: float = stated(
        FileServer.stall_s,
        "Silence after which a transfer is taken up again; most that a reply of its files may take",
        "s",
        0.1,
        600,
    )
    least_kb_s: float = stated(
        FileServer.least_kb_s, "Least speed of the camera's files; slower counts as silence", "kB/s", 0.001, 1e6
    )
    read_twice: bool = stated(
        FileServer.read_twice, "Read the camera's files twice: FTP has no checksums, so two readings have to agree"
    )
    pulses: Pulses = assumed(
        "none",
        "At the mirror's trigger input: one a held position (a pulse generator between camera and mirror), one a frame "
        "(steps fine sweeps only), or none: the path then goes by the mirror's clock",
    )
    settle_s: float = stated(2.0, "Most that the mirror may take to come to rest", "s", 0.01, 60)
    white_reference: float = stated(1.0, "Value of the white reference", "", 1e-6, 1e6)
    white_at_rest: bool = stated(True, "The white frame was taken through the mirror at 0; 0")
    provenance: str = stated("assumed", "Who confirmed the assumed values")

    def mirror(self, vector_pairs: int) -> MirrorSettings:
        """Return the settings of the mirror's driver; SettingsError where they are out of range."""
        link = {item.name: getattr(self, item.name) for item in fields(MirrorLink)}
        return MirrorSettings(**link, vector_pairs=vector_pairs, provenance=self.provenance, mounting=self.mounting)

    @property
    def mounting(self) -> Mounting:
        """Return the mounting of the mirror."""
        return Mounting(self.mirror_axes, self.mirror_clocking_deg, self.mirror_offset_x, self.mirror_offset_y)

    @property
    def camera(self) -> CameraAddress:
        """Return the address of the camera's control socket."""
        return CameraAddress(self.host, self.control_port, self.connect_s)

    @property
    def files(self) -> FileServer:
        """Return the address of the camera's files."""
        own = {name: getattr(self, name) for name in ("user", "password", "stall_s", "least_kb_s", "read_twice")}
        return FileServer(self.host, self.file_port, **own)

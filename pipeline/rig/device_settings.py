"""Settings of both devices of a rig and of their drivers, and the table [rig] of a survey."""

from __future__ import annotations

from dataclasses import dataclass

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.mirror import Axes, Mounting
from spectralzoom.pipeline.geometry.scan import Ends
from spectralzoom.pipeline.setting_fields import Text, assumed, settings_table, stated

FAKE = "fake"  # of a driver's name
# settings on which the light depends; a receipt, which may be another person's, gives no others
OF_THE_LIGHT = (
    *("mirror_axes", "mirror_clocking_deg", "mirror_offset_x", "mirror_offset_y", "white_reference", "white_at_rest"),
    *("ends", "provenance"),
)
CONTROL_PORT = 8100  # of the camera's commands; the maker's
MOST_PAIRS = 8191  # a byte offset of 16 bits addresses the cells of the vector memory


@dataclass(frozen=True)
class FileServer:
    """The camera's FTP server. User and password are those of public programs."""

    host: str = "10.0.65.50"  # the maker's
    port: int = 21
    user: str = "ftpuser"
    password: str = "ftpuser"

    @property
    def where(self) -> str:
        """The server in messages."""
        return f"the camera's file server {self.host}:{self.port}"


LEAST_EXPOSURE_MS = 0.5  # assumed, from a data sheet
MOST_PERIOD_MS = 10_000.0  # likewise


def check_times(exposure_ms: float, frame_period_ms: float, most_rate_hz: float) -> None:
    """Raise SettingsError for times that are too short (in seconds?), too long, or do not fit each other."""
    least_ms = 1000 / most_rate_hz * (1 - 1e-6)
    if not least_ms <= frame_period_ms <= MOST_PERIOD_MS:
        raise SettingsError(
            f"frame period {frame_period_ms:g} ms, expected {least_ms:.4g} to {MOST_PERIOD_MS:g} ms; times are in ms"
        )
    if not LEAST_EXPOSURE_MS <= exposure_ms <= frame_period_ms:
        raise SettingsError(
            f"exposure {exposure_ms:g} ms, expected {LEAST_EXPOSURE_MS:g} ms up to the frame period of "
            f"{frame_period_ms:g} ms; times are in ms"
        )


@settings_table
class SurveyRig:
    """The table [rig] of a survey: both devices, and the white reference.

    The drivers follow the documented protocols and were tested against scripted bytes; they never ran on hardware.
    ``provenance`` says which of the assumed values are confirmed.
    """

    port: Text = stated(
        "/dev/ttyACM0", "Port of the mirror controller; or socket://HOST:PORT or rfc2217://HOST:PORT of a network"
    )
    with_crc: bool = assumed(False, "Requests carry a CRC, and replies whose CRC does not fit are refused")
    ends: Ends = assumed("exclusive", "Whether the mirror's index ranges include their end")  # erratum E14
    mirror_driver: str = stated(
        "",
        "Driver of another mirror: fake, or module:function of another make; by default that of the MR-E-2",
        example="lab:mirror",
    )
    camera_driver: str = stated(
        "",
        "Driver of another camera: fake (sees the scene), or module:function of another make; by default that of the"
        " Nano-Hyperspec",
        example="lab:camera",
    )
    mirror_axes: Axes = assumed(
        Mounting.axes,
        "The device's X and Y as axes of a mirror mounted straight: '-x,-y' is upside down, 'y,-x' turned",
    )
    mirror_clocking_deg: float = stated(
        Mounting.clocking_deg, "Small turn of the mirror beyond that, anticlockwise from X to Y", "deg", -45, 45
    )
    mirror_offset_x: float = stated(
        Mounting.offset_x, "The device's X where the mirror looks straight ahead, of -1 to 1", "", -0.5, 0.5
    )
    mirror_offset_y: float = stated(Mounting.offset_y, "The device's Y there", "", -0.5, 0.5)
    host: Text = stated(FileServer.host, "Address of the camera; the maker's by default")
    user: Text = stated(FileServer.user, "User of its FTP server")
    password: Text = stated(
        FileServer.password,
        "Password of that user; only in a settings file, and not repeated in receipts",
        exclude=True,
    )
    white_reference: float = stated(1.0, "Value of the white reference", "", 1e-6, 1e6)
    white_at_rest: bool = stated(True, "The white frame was taken through the mirror at 0; 0")
    provenance: Text = stated("assumed", "Person who confirmed the assumed values")

    @property
    def mounting(self) -> Mounting:
        """Return the mounting of the mirror."""
        return Mounting(self.mirror_axes, self.mirror_clocking_deg, self.mirror_offset_x, self.mirror_offset_y)

    @property
    def files(self) -> FileServer:
        """Return the address of the camera's files."""
        return FileServer(self.host, user=self.user, password=self.password)

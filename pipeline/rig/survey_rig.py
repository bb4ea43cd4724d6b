"""Settings of the rig that a survey looks through, the table [rig]: where its devices are, what to believe of them.

Written for the documented protocols and tested against emulators; never run on hardware. ``provenance`` says which of
the assumed values somebody has confirmed.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from pipeline.geometry.mirror import Axes, Mounting
from pipeline.rig.device_settings import CameraAddress, FileServer
from pipeline.rig.mirror.mirror_settings import MirrorLink, MirrorSettings
from pipeline.stated import assumed, stated

Pulses = Literal["position", "frame", "none"]


@dataclass(frozen=True)
class SurveyRig(MirrorLink):
    """Both devices, the cable between them, and the white panel."""

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
        "position",
        "At the mirror's trigger input: one a held position (a pulse generator between camera and mirror), one a frame "
        "(steps fine sweeps only), or none",
    )
    log_pulses: bool = stated(
        False, "Read the mirror's log with pulses too: lines lie where it measured, tied by edges"
    )
    settle_s: float = stated(2.0, "Most that the mirror may take to come to rest", "s", 0.01, 60)
    panel: float = stated(1.0, "Value of the white panel", "", 1e-6, 1e6)
    white_at_rest: bool = stated(True, "The white frame was taken through the mirror at 0; 0")
    provenance: str = stated("assumed", "Who confirmed the assumed values")

    def mirror(self, vector_pairs: int) -> MirrorSettings:
        """Give the settings of the mirror's driver; SettingsError where they are out of range."""
        link = {item.name: getattr(self, item.name) for item in fields(MirrorLink)}
        return MirrorSettings(**link, vector_pairs=vector_pairs, provenance=self.provenance, mounting=self.mounting)

    @property
    def mounting(self) -> Mounting:
        """How the mirror is mounted."""
        return Mounting(self.mirror_axes, self.mirror_clocking_deg, self.mirror_offset_x, self.mirror_offset_y)

    @property
    def camera(self) -> CameraAddress:
        """Where the camera's control socket is."""
        return CameraAddress(self.host, self.control_port, self.connect_s)

    @property
    def files(self) -> FileServer:
        """Where the camera's files are."""
        return FileServer(
            self.host,
            self.file_port,
            self.user,
            self.password,
            self.stall_s,
            least_kb_s=self.least_kb_s,
            read_twice=self.read_twice,
        )

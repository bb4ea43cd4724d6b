"""Settings of the rig that a survey looks through, the table [rig]: where its devices are, what to believe of them.

Written for the documented protocols and tested against emulators; never run on hardware. ``provenance`` says which of
the assumed values somebody has confirmed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipeline.geometry.mounting import Mounting
from pipeline.geometry.vector_memory import Ends
from pipeline.rig.camera.camera_settings import CameraAddress, FileServer
from pipeline.rig.mirror.mirror_settings import MirrorSettings
from pipeline.rig.mirror.steering import ReadBack

Pulses = Literal["position", "frame", "none"]


@dataclass(frozen=True)
class SurveyRig:
    """Both devices, the cable between them, and the white panel."""

    port: str = "/dev/ttyACM0"  # of the mirror controller, or an address such as socket://host:port
    baud: int = 115200
    expected_id: str = ""
    deadline_s: float = 1.0
    retries: int = 2
    quiet_s: float = 0.1
    with_crc: bool = True
    strict_crc: bool = False
    ends: Ends = "exclusive"
    read_back: ReadBack = "sampled"
    check_status: bool = True
    park_at_close: bool = False
    log_rate_hz: float = 10000.0
    log_samples: int = 2000
    mirror_axes: str = "x,y"  # of a mirror mounted straight that the device's X and Y are; see `Mounting`
    mirror_clocking_deg: float = 0.0
    mirror_offset_x: float = 0.0
    mirror_offset_y: float = 0.0
    host: str = "10.0.65.50"  # of the camera
    control_port: int = 8100
    file_port: int = 21
    user: str = "ftpuser"
    password: str = "ftpuser"
    connect_s: float = 3.0
    stall_s: float = 10.0
    least_kb_s: float = 100.0  # of the camera's files; slower counts as stalled
    read_twice: bool = True  # the camera's files: FTP has no checksums, so two readings have to agree
    pulses: Pulses = "position"  # at the mirror's trigger input: one a held position, one a frame, or none
    log_pulses: bool = False  # with pulses read the mirror's log too: lines lie where it measured, tied by its edges
    settle_s: float = 2.0  # most that the mirror may take to come to rest
    panel: float = 1.0  # value of the white panel
    white_at_rest: bool = True  # the white frame was taken through the mirror at 0; 0
    provenance: str = "assumed"

    def mirror(self, vector_pairs: int) -> MirrorSettings:
        """Give the settings of the mirror's driver; SettingsError where they are out of range."""
        return MirrorSettings(
            port=self.port,
            baud=self.baud,
            expected_id=self.expected_id,
            deadline_s=self.deadline_s,
            retries=self.retries,
            quiet_s=self.quiet_s,
            with_crc=self.with_crc,
            strict_crc=self.strict_crc,
            ends=self.ends,
            vector_pairs=vector_pairs,
            read_back=self.read_back,
            check_status=self.check_status,
            park_at_close=self.park_at_close,
            log_rate_hz=self.log_rate_hz,
            log_samples=self.log_samples,
            provenance=self.provenance,
            mounting=self.mounting,
        )

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

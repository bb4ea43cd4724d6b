"""How fast the mirror must go: the right forms of the paper's equations 8 and 9, for whoever drives a rig.

Frame period and imaging time (equation 10) are :class:`pipeline.geometry.camera.LineCamera`'s, the layout of the
vector memory :mod:`pipeline.geometry.vector_memory`'s. The paper's own forms are in
:mod:`pipeline.geometry.paper_equations`.
"""

from __future__ import annotations

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera


def scene_speed(camera: LineCamera, distance_m: float) -> float:
    """Give the speed of a scene that passes one pixel PITCH each frame PERIOD, p d / (f t) (erratum E11). [m/s]"""
    return camera.ifov_rad * distance_m / (camera.frame_ms * 1e-3)


def mirror_rates(camera: LineCamera) -> tuple[float, float]:
    """Give the mirror's own turning rates for square pixels, in and across the plane of incidence (E11). [rad/s]

    The view turns by twice the mirror's angle in the plane, and by sqrt 2 times across it.
    """
    view = camera.ifov_rad / (camera.frame_ms * 1e-3)
    return view / 2, view / 2**0.5


def sample_rate_hz(samples: int, lines: int, camera: LineCamera) -> float:
    """Give the rate at which ``samples`` positions last for ``lines`` lines (E12). [Hz]

    Raises
    ------
    SettingsError : a count is below 1.
    """
    if samples < 1 or lines < 1:
        raise SettingsError(f"expected at least one sample and one line, got {samples} and {lines}")
    return samples / camera.scan_seconds(lines)

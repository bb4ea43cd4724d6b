"""How fast the mirror must go, and the cells of its vector memory: the right forms of the paper's equations 8 to 10.

Frame period and imaging time are :class:`pipeline.camera.LineCamera`'s. The paper's own forms are in
:mod:`pipeline.paper`.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.camera import LineCamera
from pipeline.errors import SettingsError


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


@dataclass(frozen=True)
class Cells:
    """Cells of the one vector memory that channels share: from ``start`` up to, not including, ``stop`` (E14)."""

    start: int
    stop: int

    def to_device(self, *, inclusive: bool) -> tuple[int, int]:
        """Give start and end as the device counts them; whether its ends are included is to be tested on it."""
        return self.start, self.stop - 1 if inclusive else self.stop


def channel_cells(samples: int, memory: int = 3000) -> tuple[Cells, Cells]:
    """Lay out X and Y of ``samples`` positions one behind the other.

    Raises
    ------
    SettingsError : they do not fit the memory, or there are none.
    """
    if not 1 <= samples <= memory // 2:
        raise SettingsError(f"{samples} positions do not fit a vector memory of {memory // 2}; send them in parts")
    return Cells(0, samples), Cells(samples, 2 * samples)

"""Effects that the model leaves out: their sizes for the rig."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_normal, scene_to_direction
from tests.pipeline.geometry.paper_equations import line_points

_REST_INCIDENCE = float(np.sqrt(0.5))
_STEEPEST, _SHALLOWEST = float(np.sin(np.deg2rad(20.0))), float(np.sin(np.deg2rad(70.0)))


def distance_error(camera: LineCamera, distance_m: float, lever_m: float = 0.1) -> float:
    """Give the error at a line's end of taking the scene for infinitely far: half a line times L / d. [px]

    The virtual pinhole sits ``lever_m`` behind the pivot (assumed 0.1 m).
    """
    return camera.samples / 2 * lever_m / distance_m


def relief_error(camera: LineCamera, nearest_m: float, farthest_m: float, lever_m: float = 0.1) -> float:
    """Give the error at a line's end between the nearest and the farthest part of a scene, once one is right. [px]"""
    return camera.samples / 2 * lever_m * abs(1 / nearest_m - 1 / farthest_m)


def pivot_error(camera: LineCamera, distance_m: float, offset_m: float) -> float:
    """Give the greatest error of a mirror whose surface lies ``offset_m`` off its pivot. [px]

    2 delta |sin i - sin 45 deg| / (d IFOV) at incidences i of 20 to 70 deg.
    """
    turn = max(abs(sine - _REST_INCIDENCE) for sine in (_STEEPEST, _SHALLOWEST))
    return 2 * abs(offset_m) * turn / (distance_m * camera.ifov_rad)


def pointing_error(camera: LineCamera, tilt_rad: float) -> tuple[float, float]:
    """Give what a tilt error of the mirror moves the view by, at rest: in and across the plane of incidence. [px]"""
    return 2 * tilt_rad / camera.ifov_rad, 2**0.5 * tilt_rad / camera.ifov_rad


def line_stretch(
    camera: LineCamera, along_px: NDArray[np.float64], scan_px: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Give by how much a line's centre is stretched along the line, 1 / (2 |n_x n_z|), for arrays that broadcast. [-]

    Never below 1: strips one line apart always touch, and resolution falls by as much.
    """
    tangents = np.stack(np.broadcast_arrays(along_px, scan_px), axis=-1) * camera.ifov_rad
    normal = direction_to_normal(scene_to_direction(tangents))
    stretch: NDArray[np.float64] = 0.5 / np.abs(normal[..., 0] * normal[..., 2])
    return stretch


def staircase_jitter(samples: int, lines: int) -> float:
    """Give the rms error of line centres for ``samples`` held positions over ``lines`` lines 1 px apart. [px]

    Sample and hold with samples / lines positions per frame; 0 where that is a whole number.
    """
    # Area under the staircase in whole numbers: its differences then lose nothing.
    held, part = np.divmod(np.arange(lines + 1, dtype=np.int64) * samples, lines)
    area = lines * (held * (held - 1) // 2) + held * part
    off = np.diff(area) * (lines / samples**2) - np.arange(lines)
    return float(np.std(off))


CAMERA = LineCamera()


def test_distance_and_relief():
    """A lever of 0.1 m errs by 1.05 px at 30.5 m and 0.11 at 300 m; a scene of one distance has no relief."""
    assert distance_error(CAMERA, 30.5) == pytest.approx(1.05, abs=0.005)
    assert distance_error(CAMERA, 300) == pytest.approx(0.11, abs=0.005)
    assert relief_error(CAMERA, 30.5, 300) == pytest.approx(distance_error(CAMERA, 30.5) - distance_error(CAMERA, 300))
    assert relief_error(CAMERA, 50, 50) == 0


def test_pivot_and_pointing():
    """1 mm off the pivot is 0.23 px at 30 m, ten times that at 3 m; 40 urad are 0.76 and 0.54 px, 0.15 deg 50 px."""
    assert pivot_error(CAMERA, 30, 1e-3) == pytest.approx(0.23, abs=0.005)
    assert pivot_error(CAMERA, 3, -1e-3) == pytest.approx(2.3, abs=0.05)
    assert pointing_error(CAMERA, 40e-6) == pytest.approx((0.76, 0.54), abs=0.005)
    assert pointing_error(CAMERA, np.deg2rad(0.15))[0] == pytest.approx(50, abs=0.5)


@pytest.mark.parametrize(("samples", "lines", "px"), [(1450, 640, 0.011), (1500, 600, 0.020), (1500, 1000, 0.056)])
def test_staircase_shakes_lines(samples: int, lines: int, px: float):
    """Positions that do not divide among the frames put lines off by hundredths of a px."""
    assert staircase_jitter(samples, lines) == pytest.approx(px, abs=5e-4)


@pytest.mark.parametrize(("samples", "lines"), [(1500, 500), (1500, 1500), (640, 640), (1, 1)])
def test_whole_numbers_of_samples_shake_nothing(samples: int, lines: int):
    """An integer number of positions per frame leaves the line centres even."""
    assert staircase_jitter(samples, lines) < 1e-12


def test_lines_stretch_as_their_points_do():
    """The stretch is the derivative of the line's own points, and nowhere below 1."""
    swaths, scan = np.array([-4000.0, 0.0, 3000.0]), np.array([-4500.0, 0.0, 2500.0])
    found = line_stretch(CAMERA, swaths[:, None], scan)
    for row, swath in enumerate(swaths):
        along, across = line_points("L4", swath, scan, CAMERA)
        apart = np.hypot(np.diff(along[:, 319:321]), np.diff(across[:, 319:321]))[:, 0]
        psi = np.arctan2(np.diff(across[:, 319:321]), np.diff(along[:, 319:321]))[:, 0]
        assert found[row] == pytest.approx(apart * np.cos(psi), rel=1e-6)
    assert found.min() >= 1
    assert found[1, 1] == pytest.approx(1)

"""The simulated instrument: which light each sample of a line gathers, along exact rays through mirror and slit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.coverage import on_scene as on_scene
from pipeline.mirror import mirror_throughput, position_to_normal
from pipeline.scan import Axis, Sweep, line_positions, shifted_position, sweep_positions
from pipeline.simulator.scene import DEFAULT_EXPOSURE_MS, Scene, to_bands

ALL_EFFECTS = frozenset({"slit", "smear", "throughput", "shot", "read"})
SLIT_NODES = 4
PIXEL_NODES = 2


def expected_lines(
    scene: Scene,
    camera: LineCamera,
    sweep: Sweep,
    lines: range,
    *,
    effects: frozenset[str] = ALL_EFFECTS,
    shift_px: NDArray[np.float64] | None = None,
) -> NDArray[np.float32]:
    """Give the electrons that each sample of some lines gathers on average.

    The footprint is a box, the slit wide and a pixel long in camera slopes, carried to the scene by exact rays and
    integrated by Gauss-Legendre nodes; it is averaged over the positions that the mirror holds in the exposure.

    Parameters
    ----------
    lines
        Numbers of the lines within the sweep. A line's result does not depend on the others asked for.
    effects
        Without ``slit`` the footprint is the ray of the sample's centre; without ``smear`` the mirror stands at mid
        exposure; without ``throughput`` it passes as much light at any tilt as at rest.
    shift_px
        (line, 2) how far beside the plan the mirror looks, along the line and the scan, at all that it holds in the
        line's exposure. [px]

    Returns
    -------
    (line, sample, band) float32, all samples of the camera before binning. [e-]

    Raises
    ------
    PoseError : a position, with its shift, is out of the mirror's reach.
    """
    position = _held_positions(camera, sweep, lines, effects)
    if shift_px is not None:
        position = shifted_position(position, shift_px[:, None], camera)
    normals = position_to_normal(position)
    share = mirror_throughput(position).astype(np.float32) if "throughput" in effects else None
    across, along, weights = _footprint(camera, effects)
    slopes = camera.pixel_slopes()
    gathered = np.zeros((len(lines) * camera.samples, scene.electrons.shape[0]), np.float32)
    for step, held in enumerate(np.moveaxis(normals, 1, 0)):
        for turn, run, weight in zip(across, along, weights, strict=True):
            y, x = _ray_pixels(held[:, None], turn, slopes + run, scene.shape, along=sweep.along, ifov=camera.ifov_rad)
            seen = scene.sample(y.ravel(), x.ravel())
            seen *= np.float32(weight / normals.shape[1])
            if share is not None:
                seen *= np.repeat(share[:, step], camera.samples)[:, None]
            gathered += seen
    light = gathered.reshape(len(lines), camera.samples, gathered.shape[1])
    return to_bands(light, scene.electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS))


def _held_positions(camera: LineCamera, sweep: Sweep, lines: range, effects: frozenset[str]) -> NDArray[np.float64]:
    """Mirror positions held in each line's exposure, (line, step, 2)."""
    asked = slice(lines.start, lines.stop, lines.step)
    if "smear" in effects:
        return sweep_positions(sweep, camera)[asked]
    return line_positions(sweep, camera)[asked, None]


def _footprint(camera: LineCamera, effects: frozenset[str]) -> tuple[NDArray[np.float64], ...]:
    """Offsets of the rays in camera slope, across and along the line, and their weights of sum 1, (ray,) each."""
    if "slit" not in effects:
        return np.zeros(1), np.zeros(1), np.ones(1)
    slit, slit_weight = np.polynomial.legendre.leggauss(SLIT_NODES)
    pixel, pixel_weight = np.polynomial.legendre.leggauss(PIXEL_NODES)
    across, along = np.meshgrid(slit * camera.slit_px / 2, pixel / 2, indexing="ij")
    weights = np.outer(slit_weight, pixel_weight) / 4
    return across.ravel() * camera.ifov_rad, along.ravel() * camera.ifov_rad, weights.ravel()


def _ray_pixels(
    normal: NDArray[np.float64],
    across: float,
    slopes: NDArray[np.float64],
    shape: tuple[int, int],
    *,
    along: Axis,
    ifov: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows and columns of the scene that camera rays (across, slope, 1) meet after the mirror, (line, sample) each.

    ``normal`` is (line, 1, 3). The reflection is written out for the two tangents; the ray's length cancels.
    """
    twice = 2 * (normal[..., 0] * across + normal[..., 1] * slopes + normal[..., 2])
    ahead = across - twice * normal[..., 0]
    line = (slopes - twice * normal[..., 1]) / ahead / ifov
    scan = (1 - twice * normal[..., 2]) / ahead / ifov
    y, x = (scan, line) if along == "x" else (line, scan)
    return y + (shape[0] - 1) / 2, x + (shape[1] - 1) / 2

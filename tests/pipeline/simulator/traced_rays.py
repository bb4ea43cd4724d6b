"""Light by brute force: exact rays through mirror, slit and pixel, summed one after the other."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from pipeline.geometry.scan import Sweep, sweep_positions
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, Scene, to_bands


def expected_lines(
    scene: Scene, camera: LineCamera, sweep: Sweep, lines: range, *, nodes: tuple[int, int] = (4, 2)
) -> np.ndarray:
    """Electrons that each sample of some lines gathers on average, (line, sample, band).

    The footprint is a box, the slit wide and a pixel long in camera slopes, integrated by Gauss-Legendre nodes across
    and along it; it is averaged over the positions that the mirror holds in the exposure.
    """
    (across, across_weight), (along, along_weight) = (np.polynomial.legendre.leggauss(count) for count in nodes)
    normals = position_to_normal(sweep_positions(sweep, camera)[lines.start : lines.stop])
    gathered = 0.0
    for held in np.moveaxis(normals, 1, 0):
        for turn, share in zip(across * camera.slit_px / 2, across_weight, strict=True):
            for run, part in zip(along / 2, along_weight, strict=True):
                slopes = camera.pixel_slopes() + run * camera.ifov_rad
                rays = np.stack([np.full_like(slopes, turn * camera.ifov_rad), slopes, np.ones_like(slopes)], axis=-1)
                met = direction_to_scene(reflect(rays, held[:, None])) / camera.ifov_rad
                y, x = (met[..., 1], met[..., 0]) if sweep.along == "x" else (met[..., 0], met[..., 1])
                seen = scene.sample((y + (scene.shape[0] - 1) / 2).ravel(), (x + (scene.shape[1] - 1) / 2).ravel())
                gathered = gathered + seen * (share * part / 4 / normals.shape[1])
    light = np.asarray(gathered, np.float32).reshape(len(lines), camera.samples, -1)
    return to_bands(light, scene.electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS))

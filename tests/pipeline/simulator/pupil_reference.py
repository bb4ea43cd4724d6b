"""An independent reference with all effects on: the pupil's own integral, dense in frequency, instead of few kernels.

The light of a sample of random tiles on even ground is summed over all waves that the pupil passes. The sum contains
linear pixels, slit, pixel, held positions, blurs, and the autocorrelation of the elliptic pupil. No
kernel is fitted, no weight is tabulated, no tail is cut; only the geometry of rays and the pupil's contrast, which a
test transforms from the pattern, are the renderer's. A tile repeats after `PERIOD_PX`, where almost nothing of the
pattern is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import j1

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import position_to_normal
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE, keystone_shift
from spectralzoom.pipeline.simulator.effects.effect import Effect
from spectralzoom.pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR
from spectralzoom.pipeline.simulator.effects.probe import noise_electrons
from spectralzoom.pipeline.simulator.optics.rays import RayViews, exact_views, pupil_contrast
from spectralzoom.pipeline.simulator.render import expected_light
from spectralzoom.pipeline.simulator.rig_model import Air, Optics, Rig
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.small_scenes import made_scene

Floats = NDArray[np.float64]
PERIOD_PX = 768
TILE_PX = 120  # of a tile; the scene around it is even
EDGE_PX = 8
SAMPLES = 3  # of a tile that are compared
KINDS = ("noise", "edges", "points", "field")
ALL: dict[Effect, str] = {
    effect: effect.variants[0] for effect in (KEYSTONE, ABERRATION, DEFOCUS, DIFFRACTION, SLIT, SMEAR, ROTATION)
}


@dataclass(frozen=True)
class Tile:
    """A scene of one band, the line that is taken of it, and the compared samples."""

    kind: str
    scene: RasterScene
    rig: Rig
    sweep: Sweep
    samples: NDArray[np.intp]


def random_tile(number: int, focus_m: float | None = None) -> Tile:
    """Return the tile of a number, always the same; kinds alternate. ``focus_m``: for a scene at 40 m; None: sharp."""
    rng = np.random.default_rng([17, number])
    kind = KINDS[number % len(KINDS)]
    size = TILE_PX + 2 * EDGE_PX
    values = np.full((size, size), rng.choice([0.0, 0.1, 0.5]))
    values[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX] = _drawn(rng, kind, float(values[0, 0]))
    nm = float(rng.uniform(450, 1000))
    electrons = float(rng.uniform(5e3, 2e4))
    scene = made_scene(values[..., None], np.array([[electrons]]), [nm])
    air = Air() if focus_m is None else Air(distance_m=40.0)
    optics = Optics(aberration_px=float(rng.uniform(0, 0.4)), keystone_px=float(rng.uniform(0, 0.4)))
    rig = Rig(LineCamera(samples=64), optics if focus_m is None else replace(optics, focus_m=focus_m), air=air)
    step = int(rng.choice([1, 1, 1, 2]))
    start = float(rng.uniform(-TILE_PX / 2, TILE_PX / 2))
    sweep = Sweep("tile", "fine" if step == 1 else "coarse", "x", float(rng.uniform(-20, 20)), start, 1, step)
    return Tile(kind, scene, rig, sweep, np.sort(rng.choice(64, SAMPLES, replace=False)))


def _drawn(rng: np.random.Generator, kind: str, ground: float) -> Floats:
    shape = (TILE_PX, TILE_PX)
    if kind == "noise":
        grain = gaussian_filter(rng.standard_normal(shape), float(rng.choice([0.0, 1.0, 4.0])))
        return np.clip(0.5 + grain / np.abs(grain).max() / 2, 0, 1)
    y, x = np.mgrid[: shape[0], : shape[1]] - TILE_PX / 2
    turn = rng.uniform(0, np.pi)
    way = y * np.sin(turn) + x * np.cos(turn)
    if kind == "edges":
        return np.where(np.sin(2 * np.pi * way / rng.uniform(8, 60)) > 0, 1.0, ground)
    if kind == "field":  # bright on one side, dark on the other
        return np.where(way > rng.uniform(-20, 20), 1.0, 0.0)
    return np.where(rng.random(shape) < 5e-3, 1.0, ground)


def distances(tile: Tile) -> Floats:
    """Return by how many sigmas each sample of a tile, with everything on, differs from the reference, (n,)."""
    block = sweep_block(tile.scene, tile.rig, tile.sweep, range(1))
    light = expected_light(tile.scene, block, ALL)[0, tile.samples, 0].astype(np.float64)
    slopes = block.slopes[tile.samples]
    views = [exact_views(position_to_normal(held), 0.0, slopes) for held in block.positions[0]]
    normal = position_to_normal(block.middle[0])
    reference = np.mean([_seen(tile, one, normal) for one in views], axis=0)
    return np.abs(light - reference) / noise_electrons(reference.astype(np.float32), tile.rig)


def _seen(tile: Tile, views: RayViews, normal: Floats) -> Floats:
    """Return the light of the samples with these views, (n,), as a sum over all waves that the pupil passes. [e-]"""
    scene = tile.scene
    rig = tile.rig
    values = scene.planes[..., 0].astype(np.float64) * float(scene.electrons[0, 0])
    ground = values[0, 0]
    waves = scene.wavelength_nm[0] * 1e-9 / (rig.optics.aperture_mm * 1e-3) / rig.camera.ifov_rad
    most = int(np.ceil(1.02 / waves * PERIOD_PX))  # the pupil passes no finer wave along the line
    column, row = np.arange(most + 1), np.arange(-most, most + 1)
    passed = np.fft.fft2(values - ground, (PERIOD_PX, PERIOD_PX))[np.ix_(row % PERIOD_PX, column % PERIOD_PX)]
    x, y = column / PERIOD_PX, row[:, None] / PERIOD_PX
    passed *= (np.sinc(x) * np.sinc(y)) ** 2
    passed[:, 1:] *= 2  # and the waves of the other sign
    ifov = rig.camera.ifov_rad
    middle = (np.array(scene.shape) - 1) / 2
    found = []
    for n in range(len(views.along)):
        run = views.along_run[n] * x + views.scan_run[n] * y
        turn = views.along_turn[n] * x + views.scan_turn[n] * y
        own = passed * _transfer(run, turn, rig, scene.wavelength_nm, normal, waves)
        ahead = np.exp(2j * np.pi * (views.along[n] / ifov + middle[1]) * x)
        down = np.exp(2j * np.pi * (views.scan[n] / ifov + middle[0]) * y)[:, 0]
        found.append(float((down @ own @ ahead).real) / PERIOD_PX**2 + ground)
    return np.array(found)


def _transfer(run: Floats, turn: Floats, rig: Rig, nm: Floats, normal: Floats, waves: float) -> NDArray[np.complex128]:
    """Return the transfer of pixel, slit, lens, disc and pupil for waves along and across the line, in camera px."""
    n_x, n_y, n_z = normal
    steep = (n_y * run + n_x * turn) / n_z
    contrast = pupil_contrast(waves * np.sqrt(run**2 + turn**2 + steep**2))
    blur = np.exp(-2 * np.pi**2 * rig.optics.aberration_px**2 * (run**2 + turn**2))
    shift = np.exp(2j * np.pi * float(keystone_shift(rig, nm)[0]) * run)
    disc = 1.0
    if rig.air.distance_m is not None:
        apart = abs(1 / rig.air.distance_m - 1 / rig.optics.focus_m)
        wide = rig.optics.aperture_mm * 1e-3 * apart / rig.camera.ifov_rad
        v = np.pi * wide * np.sqrt(np.maximum(run**2 + turn**2 - (n_y * run + n_x * turn) ** 2, 0.0))
        disc = np.where(v > 1e-6, 2 * j1(np.maximum(v, 1e-6)) / np.maximum(v, 1e-6), 1.0)
    return np.sinc(run) * np.sinc(rig.camera.slit_px * turn) * contrast * blur * shift * disc

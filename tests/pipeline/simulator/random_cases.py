"""Random scenes and rigs: the change from leaving out an effect is checked against its bound.

Scenes are long along the scan, so that sweeps may lie far from the middle. They have edges, textures, points,
gradients and mixtures, one band to many, bright and dark. Rigs have random numbers within sensible ranges, and
about half of the optional parts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.probe import Probe
from spectralzoom.pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Relief, Rig, Sky
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_scene
from spectralzoom.pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.small_scenes import made_scene

Floats = NDArray[np.float64]
LONG_PX, WIDE_PX = 640, 160  # of a scene
BANDS = (1, 2, 3, 8, 30)
SAMPLES = (64, 96)
LINES = (5, 10)  # least and most of a sweep
LONGEST_S = 4 * 3600.0
_COMPONENTS = 3


@dataclass(frozen=True)
class Case:
    """A scene, a rig and its sweeps over the scene, the last of them at the survey's end."""

    scene: RasterScene
    rig: Rig
    sweeps: tuple[Sweep, ...]
    seconds: float | None  # from the first line to the last; None is that of the sweeps
    seed: int
    measured: range | None = None  # lines of every sweep that are measured; None is all

    def probe(self) -> Probe:
        """Return the probe of the scene, on which the decision is based."""
        probe = probe_scene(self.scene, self.rig, self.sweeps)
        return probe if self.seconds is None else replace(probe, seconds=max(self.seconds, probe.seconds))

    def blocks(self, probe: Probe) -> list[SweepBlock]:
        """Return the measured lines of every sweep: the first sweep starts the survey, the others end it."""
        ends = [0.0, *(probe.seconds - self.rig.camera.scan_seconds(sweep.lines) for sweep in self.sweeps[1:])]
        return [
            sweep_block(
                self.scene, self.rig, sweep, self.measured or range(sweep.lines), seed=self.seed, started_s=start
            )
            for sweep, start in zip(self.sweeps, ends, strict=True)
        ]


def random_case(number: int) -> Case:
    """Return the case of a number, always the same."""
    rng = np.random.default_rng([6, number])
    rig = random_rig(rng)
    upright = bool(rng.random() < 0.3)
    scene = _scene(rng, rig.camera, upright=upright)
    far = float(rng.choice([0.0, rng.uniform(-LONG_PX / 2 + 40, LONG_PX / 2 - 40)]))
    step = int(rng.choice([1, 1, 1, 4]))
    count = int(rng.integers(LINES[0], LINES[1] + 1))
    axis = "y" if upright else "x"
    kind = "fine" if step == 1 else "coarse"
    sweeps = tuple(
        Sweep(name, kind, axis, float(rng.uniform(-20, 20)), start - count * step / 2, count, step)
        for name, start in (("first", far), ("last", float(rng.uniform(-200, 200))))
    )
    seconds = float(np.exp(rng.uniform(np.log(60), np.log(LONGEST_S)))) if rng.random() < 0.5 else None
    return Case(scene, rig, sweeps, seconds, number)


def _scene(rng: np.random.Generator, camera: LineCamera, *, upright: bool) -> RasterScene:
    bands = int(rng.choice(BANDS))
    planes = np.stack([_plane(rng, (LONG_PX, WIDE_PX)) for _ in range(_COMPONENTS)], axis=-1)
    planes = np.swapaxes(planes, 0, 1) if upright else planes
    nm = np.linspace(400.0, 1000.0, bands) if bands > 2 else np.linspace(550.0, 600.0, bands)
    brightest = float(np.exp(rng.uniform(np.log(50), np.log(20_000))))
    spectra = np.stack([_spectrum(rng, nm) for _ in range(_COMPONENTS)])
    spectra *= brightest / np.einsum("yxc,cb->yxb", planes[::4, ::4], spectra).max()
    at_default = (DEFAULT_EXPOSURE_MS / camera.exposure_ms * spectra).astype(np.float32)
    white = at_default.sum(axis=0) * rng.uniform(0.5, 2)
    width = rng.choice([0.0, 2.0, 6.0])
    return made_scene(planes, at_default, nm, white, fwhm_nm=np.full(bands, width) if width else None)


def _plane(rng: np.random.Generator, shape: tuple[int, int]) -> Floats:
    """Return one component, 0 to 1: bars at any angle, noise of any coarseness, points, a ramp, or bars plus noise."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    turn = rng.uniform(0, np.pi)
    way = y * np.sin(turn) + x * np.cos(turn)
    kind = str(rng.choice(["edges", "texture", "points", "gradient", "both"]))
    bars = (np.sin(2 * np.pi * way / rng.uniform(4, 60)) > rng.uniform(-0.9, 0.9)).astype(np.float64)
    noise = gaussian_filter(rng.standard_normal(shape), float(rng.choice([0.0, 0.7, 2.0, 8.0])))
    noise = (noise - noise.min()) / np.ptp(noise)
    dots = (rng.random(shape) < 2e-3).astype(np.float64)
    base = rng.uniform(0.0, 0.5)
    contrast = rng.choice([1.0, 0.3, 0.05])
    ramp = (way - way.min()) / np.ptp(way)
    found = {"edges": bars, "texture": noise, "points": dots, "gradient": ramp, "both": bars / 2 + noise / 2}
    plane: Floats = base + contrast * (1 - base) * found[kind]
    return plane


def _spectrum(rng: np.random.Generator, nm: Floats) -> Floats:
    """Return a smooth slope and a bump, perhaps with a narrow absorption line."""
    bump = np.exp(-(((nm - rng.uniform(400, 1000)) / rng.uniform(30, 300)) ** 2))
    line = rng.choice([0.0, 0.6]) * np.exp(-(((nm - rng.uniform(400, 1000)) / rng.uniform(4, 20)) ** 2))
    spectrum: Floats = (0.2 + rng.uniform(0, 1) * (nm - 400) / 600 + bump) * (1 - line)
    return spectrum


def random_rig(rng: np.random.Generator) -> Rig:
    """Return a rig of random numbers within sensible ranges, with about half of the optional parts."""
    camera = LineCamera(
        samples=int(rng.choice(SAMPLES)),
        exposure_ms=float(np.exp(rng.uniform(np.log(3), np.log(100)))),
        slit_um=float(rng.choice([20.0, 7.4, 30.0])),
        read_noise_e=float(rng.uniform(5, 40)),
    )
    air = _air(rng)
    optics = _optics(rng, air.distance_m)
    mirror = _mirror(rng)
    detector = Detector(prnu_std=_some(rng, 1e-3, 0.03), striping_std=_some(rng, 1e-3, 0.02))
    return Rig(camera, optics, mirror, detector, air, _sky(rng))


def _some(rng: np.random.Generator, least: float, most: float, none: float = 0.0) -> float:
    """Return a number from a range, uniform in its logarithm, or ``none`` in half of the cases."""
    value = float(np.exp(rng.uniform(np.log(least), np.log(most))))
    return value if rng.random() < 0.5 else none


def _optics(rng: np.random.Generator, distance_m: float | None) -> Optics:
    near = (distance_m or 30.0) * float(rng.uniform(0.6, 1.6))
    return Optics(
        aperture_mm=float(rng.uniform(8, 25)),
        focus_m=float(rng.choice([near, np.inf])),
        aberration_px=_some(rng, 0.05, 0.6),
        keystone_px=_some(rng, 0.02, 0.6),
        smile_nm=_some(rng, 0.05, 2) * float(rng.choice([-1, 1])),
        fwhm_nm=float(rng.uniform(3, 10)),
        stray_fraction=_some(rng, 1e-4, 1e-2),
        stray_even=float(rng.uniform(0, 1)),
        stray_halo_px=float(rng.uniform(4, 100)),
    )


def _mirror(rng: np.random.Generator) -> MirrorMotion:
    rng.uniform()  # the cases stay those of their numbers
    return MirrorMotion(
        coating="aluminium" if rng.random() < 0.5 else "ideal",
        natural_hz=float(rng.uniform(5, 100)),
        damping=float(rng.choice([0.3, 0.7, 1.0, 2.0])),
        settled_s=float(rng.uniform(0.05, 0.5)),
        positions_per_line=float(rng.choice([1.0, 1.0, 0.5, 2.0, 1.7])),
        repeatability_urad=_some(rng, 1, 40),
        hysteresis_px=_some(rng, 0.05, 5),
        drift_px_per_min=_some(rng, 0.01, 1),
    )


def _air(rng: np.random.Generator) -> Air:
    if rng.random() < 0.4:
        return Air()
    distance = float(np.exp(rng.uniform(np.log(20), np.log(1000))))
    relief: Relief = rng.choice(["flat", "step", "plane"])
    return Air(
        distance_m=distance,
        relief=relief,
        nearest_m=distance * float(rng.uniform(0.5, 1)),
        farthest_m=distance * float(rng.uniform(1, 2)),
        visibility_km=float(rng.uniform(1, 50)),
        airlight_fraction=float(rng.uniform(0, 1)),
        vapour_g_per_m3=float(rng.uniform(0, 30)),
        turbulence_cn2=float(10 ** rng.uniform(-15, -12)),
        wind_amplitude_m=_some(rng, 1e-3, 0.05),
        wind_hz=float(rng.uniform(0.2, 3)),
    )


def _sky(rng: np.random.Generator) -> Sky:
    day = datetime(2026, 6, 21, 3, 30, tzinfo=UTC) + timedelta(hours=float(rng.uniform(0, 16)))
    return Sky(
        started=day if rng.random() < 0.5 else None,
        cloud_fraction=float(rng.choice([0.0, 0.0, rng.uniform(0.05, 0.9)])),
        cloud_size_px=float(rng.uniform(30, 600)),
        brdf_per_rad=_some(rng, 0.01, 0.5),
        hot_spot=float(rng.choice([0.0, rng.uniform(0.02, 0.5)])),
    )

"""Random scenes whose light few samples show: the change from leaving out an effect is checked against its bound.

Scenes are cubes with a plane for each band and detail in few of them, few pixels, or one bright line of many. Some
sweeps lie alone beside bright fields, edges and pixels. Rigs are those of the random cases.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from tests.pipeline.simulator.random_cases import Case, random_rig
from tests.pipeline.simulator.small_scenes import made_scene

Floats = NDArray[np.float64]
SHAPE = (150, 130)  # of a scene [px]
IN_BANDS = ("points in bands", "fields in bands", "texture in bands")
KINDS = (*IN_BANDS, "beside fields", "beside points", "bright line", "pixel")


def sparse_case(number: int) -> Case:
    """Return the case of a number, always the same; the kinds alternate."""
    rng = np.random.default_rng([11, number])
    kind = KINDS[number % len(KINDS)]
    rig = random_rig(rng)
    samples = rig.camera.samples
    if kind in IN_BANDS:
        values = _cube(rng, kind)
        start, lines = -SHAPE[0] / 2 - 4, SHAPE[0] + 8
        swaths = [0.0] if rng.random() < 0.5 else [-(SHAPE[1] - samples) / 2, (SHAPE[1] - samples) / 2]
        sweeps = tuple(Sweep(f"s{swath:g}", "fine", "x", swath, start, lines) for swath in swaths)
    else:
        lines = int(rng.integers(1, 6)) if kind != "bright line" else 120
        start = float(rng.uniform(-20, 20)) if kind != "bright line" else -60.0
        sweeps = (Sweep("lone", "fine", "x", float(rng.uniform(-10, 10)), start, lines),)
        made = {"beside fields": _beside, "beside points": _beside, "bright line": _line, "pixel": _pixel}[kind]
        values = made(rng, kind, sweeps[0])
    return Case(_scene(rng, values, rig), rig, sweeps, None, number)


def _scene(rng: np.random.Generator, values: Floats, rig: Rig) -> RasterScene:
    """Return a scene of values (y, x, band), with a plane for each band."""
    bands = values.shape[2]
    brightest = float(np.exp(rng.uniform(np.log(500), np.log(20_000)))) * DEFAULT_EXPOSURE_MS / rig.camera.exposure_ms
    light = np.full(bands, brightest / max(values.max(), 1e-9), np.float32)
    nm = np.linspace(400.0, 1000.0, bands) if bands > 1 else np.array([600.0])
    fwhm_nm = None if rng.random() < 0.5 else np.full(bands, 2.0)
    return made_scene(values, light, nm, light * np.float32(values.max()), fwhm_nm=fwhm_nm)


def _cube(rng: np.random.Generator, kind: str) -> Floats:
    bands = int(rng.choice([6, 13, 30]))
    values = np.full((*SHAPE, bands), rng.uniform(0, 0.6)) * rng.uniform(0.5, 1, bands)
    for _ in range(int(rng.integers(1, 6))):
        band, row, column = (int(rng.integers(0, size)) for size in (bands, *SHAPE))
        if kind == "points in bands":
            values[row, column, band] = rng.choice([0.0, 1.0])
        elif kind == "fields in bands":
            values[row : row + int(rng.integers(2, 60)), column:, band] = rng.choice([0.0, 1.0])
        else:
            grain = gaussian_filter(rng.standard_normal(SHAPE), float(rng.choice([0.0, 0.7, 2.0])))
            values[..., band] *= 1 + rng.uniform(0.02, 0.5) * grain / np.abs(grain).max()
    return values


def _beside(rng: np.random.Generator, kind: str, sweep: Sweep) -> Floats:
    """Return even light under a sweep, with fields or pixels some px beside it, in every band or in one."""
    values = np.full((*SHAPE, int(rng.choice([1, 3, 12]))), rng.choice([0.0, 0.1, 0.5]))
    edge = int(np.floor(sweep.start_px + (SHAPE[0] - 1) / 2 - float(np.exp(rng.uniform(np.log(1.5), np.log(40))))))
    some = slice(None) if rng.random() < 0.5 else slice(0, 1)
    if kind == "beside fields":
        values[: max(edge, 1), :, some] = 1.0
    else:
        for _ in range(int(rng.integers(1, 4))):
            values[max(edge - int(rng.integers(0, 4)), 0), int(rng.integers(40, 90)), some] = 1.0
    return values


def _line(rng: np.random.Generator, kind: str, sweep: Sweep) -> Floats:
    """Return dark land with one bright stripe across it, which has a dark gap."""
    values = np.full((*SHAPE, int(rng.choice([1, 3, 12]))), rng.uniform(0, 0.2))
    row = int(rng.integers(20, 120))
    high = int(rng.integers(3, 12))
    values[row : row + high] = 1.0
    column = int(rng.integers(40, 85))
    values[row : row + high, column : column + int(rng.integers(2, 12))] = 0.0
    return values


def _pixel(rng: np.random.Generator, kind: str, sweep: Sweep) -> Floats:
    """Return a scene of 1 x 1 to 3 x 3 pixels."""
    bands = int(rng.choice([1, 3, 12]))
    return rng.uniform(0.0, 1, (int(rng.integers(1, 4)), int(rng.integers(1, 4)), bands))

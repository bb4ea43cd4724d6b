"""Register sweeps: correct errors of their pointing, and of their light, by the overlaps of neighbours or a mosaic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.stage import Output, stage
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.rectify.placed import PlacedSweep
from spectralzoom.pipeline.rectify.registration.alignment import SweepShift
from spectralzoom.pipeline.rectify.registration.illumination import overlap_light, solve_lights
from spectralzoom.pipeline.rectify.registration.overlaps import BroadSweep
from spectralzoom.pipeline.rectify.registration.seams import Anchor, Registration, anchor_sweep, register_sweeps
from spectralzoom.pipeline.rectify.sweep_paths import SweepPath, sweep_paths
from spectralzoom.pipeline.signal.components import BROAD_BANDS
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.arrays.signal_cubes import open_signal_cubes
from spectralzoom.storage.store import Ref, read_table, write_table

REGISTRATION = "registration.json"
MADE_BY = ("pipeline/rectify/registration",)


def open_sweeps(signal: Ref, seams: Ref | None, camera: LineCamera) -> list[SweepPath]:
    """Open the compressed sweeps, by name, with the corrections of a registration."""
    found = None if seams is None else load_registration(seams)["sweeps"]
    return sweep_paths(open_signal_cubes(signal.path), camera, found)


@stage("registration of the sweeps", version=3, product="register", made_by=MADE_BY)
def register_coarse(
    out: Output, signal: Ref, *, camera: LineCamera, prior_px: float, wavelength_nm: NDArray[np.float64]
) -> None:
    """Estimate pointing and radiometric gain of the coarse sweeps from the overlaps of neighbours."""
    sweeps = open_sweeps(signal, None, camera)
    broad = [BroadSweep.read(one.lines, usable=one.usable) for one in sweeps]
    out.report(0.4)
    found = register_sweeps(broad, camera, prior_px=prior_px)
    out.report(0.8)
    placed = [replace(one, shift=found.of(one.lines.sweep.name)).placed(camera) for one in sweeps]
    gains = light_gains(found, placed, camera, wavelength_nm)
    names = [shift.name for shift in found.shifts]
    record = {
        "method": "seams",
        "reference": found.reference,
        "sweeps": {shift.name: _shift_record(shift) | {"gain": gains.get(shift.name)} for shift in found.shifts},
        "untied": list(found.untied),
        "narrow": [asdict(narrow) for narrow in found.narrow],
        "windows": [
            {
                "reference": names[seen.window.reference],
                "moving": names[seen.window.moving],
                "along_px": seen.window.along_px,
                "scan_px": seen.window.scan_px,
                "status": "too narrow" if seen.found is None else seen.found.status,
                "residual_px": seen.residual_px.tolist() if np.isfinite(seen.residual_px).all() else None,
            }
            for seen in found.windows
        ],
    }
    write_table(out.path / REGISTRATION, record)


@stage("registration to the mosaic", version=3, product="register", made_by=MADE_BY)
def register_fine(
    out: Output, signal: Ref, mosaic: Ref, *, camera: LineCamera, prior_px: float, grid: SceneGrid
) -> None:
    """Register each fine sweep on the mean of the coarse mosaic's bands, which has pointing errors itself."""
    sweeps = open_sweeps(signal, None, camera)
    anchors: list[Anchor] = []
    seen = open_mosaic(mosaic.path / "mosaic.zarr")
    under = seen.brightness(bands=BROAD_BANDS) if sweeps else np.empty((0, 0), np.float32)
    for number, one in enumerate(sweeps):
        broad = BroadSweep.read(one.lines, usable=one.usable)
        anchors.append(anchor_sweep(broad, camera, grid, under, prior_px=2 * prior_px))
        out.report((number + 1) / len(sweeps))
    record = {
        "method": "mosaic",
        "reference": "the coarse mosaic",
        "sweeps": {one.shift.name: _shift_record(one.shift) | {"gain": None} for one in anchors},
        "untied": [one.shift.name for one in anchors if one.found.status != "found"],
        "narrow": [],
        "windows": [{"moving": one.shift.name, "status": one.found.status} for one in anchors],
    }
    write_table(out.path / REGISTRATION, record)


def light_gains(
    found: Registration, placed: Sequence[PlacedSweep], camera: LineCamera, wavelength_nm: NDArray[np.float64]
) -> dict[str, list[float]]:
    """Return the gain of each sweep by band that makes neighbours agree."""
    windows = [seen.window for seen in found.windows if seen.measured is not None]
    if not windows:
        return {}
    lights = solve_lights(overlap_light(placed, camera, windows), len(placed), wavelength_nm)
    tied = [number for number in range(len(placed)) if number not in lights.untied]
    return {placed[number].lines.sweep.name: lights.gain(number).tolist() for number in tied}


def _shift_record(shift: SweepShift) -> dict[str, Any]:
    return {"offset_px": shift.offset.tolist(), "drift_px_per_line": shift.drift.tolist()}


def load_registration(registration: Ref) -> dict[str, Any]:
    """Read a registration: offset, drift and gain by sweep; reference, sweeps without overlap, and windows."""
    return read_table(registration.path / REGISTRATION)

"""The stage that finds where the mirror really looked: of a coarse pass from its seams, of a fine one on the mosaic.

Nothing runs where the settings believe the mirror (``pointing_px = 0``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from flows.survey.run import SurveyRun
from flows.survey.stage import Product, Wanted, stage
from flows.survey.stages.capture import captured
from pipeline.rectify.placed import Placed
from pipeline.rectify.registration.alignment import SweepShift
from pipeline.rectify.registration.illumination import overlap_light, solve_lights
from pipeline.rectify.registration.overlaps import BroadSweep, broad_bands
from pipeline.rectify.registration.seams import Anchor, Registration, SeamWindow, anchor_sweep, register_sweeps
from storage.archive.keys import StageRef
from storage.archive.manifests import read_table, write_table
from storage.arrays.mosaics import load_mosaic
from storage.arrays.tile_work import Sighted, sight_sweeps

POINTING = Product("register", version=2)
RECORD = "registration.json"


def sighted(run: SurveyRun, raw: StageRef, registration: StageRef | None) -> list[Sighted]:
    """Open the sweeps of a capture with what registration found of them."""
    return sight_sweeps(captured(raw), record_of(registration), run.camera)


def record_of(registration: StageRef | None) -> Path | None:
    """Where a registration wrote what it found."""
    return None if registration is None else registration.path / RECORD


@stage(
    "register_coarse", "seams of the coarse sweeps", POINTING, of=("capture_coarse",), inputs=1, unit="coarse values"
)
def register_coarse(run: SurveyRun, raw: StageRef) -> Wanted | None:
    """Find pointing and light of the coarse sweeps from what neighbours show twice."""
    prior = run.settings.pointing_px
    if not prior:
        return None

    def build(path: Path) -> None:
        sweeps = sighted(run, raw, None)
        broad = [BroadSweep.read(one.cube, run.camera, usable=one.usable) for one in sweeps]
        run.report(0.4)
        found = register_sweeps(broad, run.camera, prior_px=prior)
        run.report(0.8)
        placed = [replace(one, shift=found.of(one.cube.sweep.name)).placed(run.camera) for one in sweeps]
        write_table(path / RECORD, _seams_record(found, _gains(run, found, placed)))

    return Wanted(build, {"prior_px": prior, "pass": "coarse"}, [raw])


def _gains(run: SurveyRun, found: Registration, placed: Sequence[Placed]) -> dict[str, list[float]]:
    """What each sweep's values are to be multiplied by, band by band, so that neighbours agree."""
    windows = [seen.window for seen in found.windows if seen.measured is not None]
    if not windows:
        return {}
    lights = solve_lights(overlap_light(placed, run.camera, windows), len(placed), run.scene.wavelength_nm)
    tied = [number for number in range(len(placed)) if number not in lights.untied]
    return {placed[number].lines.sweep.name: lights.gain(number).tolist() for number in tied}


def _seams_record(found: Registration, gains: dict[str, list[float]]) -> dict[str, Any]:
    names = [shift.name for shift in found.shifts]
    return {
        "method": "seams",
        "reference": found.reference,
        "sweeps": {shift.name: _shift_record(shift) | {"gain": gains.get(shift.name)} for shift in found.shifts},
        "untied": list(found.untied),
        "narrow": [asdict(narrow) for narrow in found.narrow],
        "windows": [_window_record(seen, names) for seen in found.windows],
    }


def _shift_record(shift: SweepShift) -> dict[str, Any]:
    return {"offset_px": shift.offset.tolist(), "drift_px_per_line": shift.drift.tolist()}


def _window_record(seen: SeamWindow, names: Sequence[str]) -> dict[str, Any]:
    left = seen.residual_px.tolist() if np.isfinite(seen.residual_px).all() else None
    status = "too narrow" if seen.found is None else seen.found.status
    window = seen.window
    return {
        "reference": names[window.reference],
        "moving": names[window.moving],
        "along_px": window.along_px,
        "scan_px": window.scan_px,
        "status": status,
        "residual_px": left,
    }


@stage(
    "register_fine", "fine sweeps on the mosaic", POINTING, of=("capture_fine", "rectify"), inputs=2, unit="fine values"
)
def register_fine(run: SurveyRun, raw: StageRef, mosaic: StageRef) -> Wanted | None:
    """Find where each fine sweep lies on the coarse mosaic, which itself may be off by as much."""
    prior = run.settings.pointing_px
    if not prior:
        return None

    def build(path: Path) -> None:
        sweeps = sighted(run, raw, None)
        anchors: list[Anchor] = []
        values = load_mosaic(mosaic.path / "mosaic.zarr").values if sweeps else np.empty((0, 0, 0), np.float32)
        for number, one in enumerate(sweeps):
            under = np.asarray(values[..., broad_bands(one.cube.references)].mean(axis=-1), np.float32)
            broad = BroadSweep.read(one.cube, run.camera, usable=one.usable)
            anchors.append(anchor_sweep(broad, run.camera, run.grid, under, prior_px=2 * prior))
            run.report((number + 1) / len(sweeps))
        record = {
            "method": "mosaic",
            "reference": "the coarse mosaic",
            "sweeps": {one.shift.name: _shift_record(one.shift) | {"gain": None} for one in anchors},
            "untied": [one.shift.name for one in anchors if one.found.status != "found"],
            "narrow": [],
            "windows": [{"moving": one.shift.name, "status": one.found.status} for one in anchors],
        }
        write_table(path / RECORD, record)

    return Wanted(build, {"prior_px": prior, "pass": "fine", "grid": asdict(run.grid)}, [raw, mosaic])


def load_registration(registration: StageRef) -> dict[str, Any]:
    """Read what was found: by sweep the offset, drift and gain; the held sweep, those untied, and every window."""
    return read_table(registration.path / RECORD)

"""Mirror vignetting: the tilted mirror is the aperture stop, and the camera sees more or less of it."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.gain_range import GainRange
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
HELD, MIDDLE = "held", "middle"
# The share is sqrt(1 - eta / sqrt(1 + xi^2 + eta^2)) of tangents xi and eta. Its second derivative over eta is largest
# at xi = 0 and eta = -tan 20 deg or so.
MOST_BEND = 0.46


@dataclass(frozen=True)
class Vignetting:
    """Light goes with the mirror's area as the camera sees it: |n_z| over |n_z| at rest, one factor for each line.

    ``held`` averages over the positions of an exposure, ``middle`` takes the one at mid exposure. A single patch sees
    next to one factor, yet not that of rest; so it is the difference from rest that counts.
    """

    name = "vignetting"
    variants = (HELD, MIDDLE)
    cost_ns = MappingProxyType({HELD: 0.2, MIDDLE: 0.2})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by the greatest signal times the factor's greatest difference from 1 over all sweeps."""
        if variant == HELD:
            return Bound(0.0, "exact")
        if variant == MIDDLE:
            most = max((sweep.step for sweep in probe.sweeps), default=1)
            bend = MOST_BEND / 2 * rig.camera.ifov_rad**2 * (most**2 - 1) / 12
            return Bound(probe.scaled(bend), f"the factor bends by {bend:.1g} within the {most} px of an exposure")
        ends = sweep_ends(probe, rig.camera)
        if not ends.size:
            return Bound(0.0, "no line is taken")
        shares = np.sqrt(1 - ends)  # |n_z|^2 = (1 - o_z) / 2
        why = f"the mirror passes {shares.min():.3f} to {shares.max():.3f} of its light at rest"
        return Bound(probe.scaled(float(np.abs(shares - 1).max())), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the factors of all sweeps, each the same along a line."""
        shares = np.sqrt(1 - sweep_ends(probe, rig.camera))
        least, greatest = float(shares.min(initial=1.0)), float(shares.max(initial=1.0))
        return GainRange.between(least, greatest, len(probe.wavelength_nm))

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give the factor of each line, (line, 1, 1)."""
        sweep, camera = block.sweep, block.rig.camera
        scan_px = sweep.held_px() if variant == HELD else sweep.line_px()[:, None]
        share = np.sqrt(1 - ahead(sweep.strip_px, scan_px[block.numbers], camera)).mean(axis=1)
        factor: Light = share.astype(np.float32)[:, None, None]
        return factor


VIGNETTING = Vignetting()


def sweep_ends(probe: Probe, camera: LineCamera) -> Floats:
    """Give o_z at the first and the last position of every sweep, (2 sweep,); it never turns round in between."""
    ends = [sweep.held_px().ravel()[[0, -1]] for sweep in probe.sweeps]
    found = [ahead(sweep.strip_px, px, camera) for sweep, px in zip(probe.sweeps, ends, strict=True)]
    return np.concatenate(found) if found else np.zeros(0)


def ahead(along_px: float, scan_px: Floats, camera: LineCamera) -> Floats:
    """Give o_z, the part along the camera's axis, of the unit directions to points of the scene."""
    xi, eta = along_px * camera.ifov_rad, scan_px * camera.ifov_rad
    part: Floats = eta / np.sqrt(1 + xi**2 + eta**2)
    return part

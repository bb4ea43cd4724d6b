"""Shot noise: photons arrive by chance, so that counts spread by the root of what is expected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pipeline.simulator.effects.dark_current import dark_electrons
from pipeline.simulator.effects.defects import most_hot_electrons
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.effects.saturation import well_reached
from pipeline.simulator.noise import (
    CHIP_SAMPLES,
    LEAST_MERGED_READ_E,
    MOST_VARIATION,
    SERIES_FROM_E,
    chip_variation,
    least_expected,
    told_apart,
)
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

EXACT, GAUSSIAN = "exact", "gaussian"
DIM_NS = 80.0  # of an exact count below `SERIES_FROM_E`, in lines of any light


@dataclass(frozen=True)
class Shot:
    """Poisson counts. ``gaussian`` has their first three cumulants, and takes the read noise into the same draw.

    Where so few electrons are expected that a patch of its numbers could be told from exact ones, it is exact.
    Noise counts twice the total variation between the distributions of a sample with and without: see `told_apart`.
    """

    name = "shot"
    variants = (EXACT, GAUSSIAN)
    cost_ns = MappingProxyType({EXACT: 10.0, GAUSSIAN: 3.9})  # of light above `SERIES_FROM_E`

    def cost_at(self, probe: Probe, rig: Rig) -> Mapping[str, float]:
        """Give the cost at the light along the probe's lines: few electrons are counted one by one.

        Cheap draws pay for the exact ones that stand in for them where too few electrons are expected.
        """
        if probe.usual_e is None:
            return self.cost_ns
        expected = probe.usual_e + dark_electrons(rig)
        counted = self.cost_ns[EXACT] + (DIM_NS - self.cost_ns[EXACT]) * float((expected < SERIES_FROM_E).mean())
        read = rig.camera.read_noise_e
        merged = read >= LEAST_MERGED_READ_E and not well_reached(rig, read)
        dim = float((expected < least_expected(read if merged else 0.0)).mean())
        return {EXACT: counted, GAUSSIAN: self.cost_ns[GAUSSIAN] + dim * counted}

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it at the brightest sample, where it is the greatest share of all noise."""
        brightest = max(probe.brightest_e, 0.0) + dark_electrons(rig) + most_hot_electrons(rig)
        if rig.detector.noiseless:
            return Bound(0.0, "the sensor is ideal")
        if variant == EXACT or brightest == 0:
            return Bound(0.0, "exact" if variant == EXACT else "no electrons are expected")
        read = rig.camera.read_noise_e
        total = float(np.hypot(np.sqrt(brightest), read))
        if variant == GAUSSIAN:
            return self._of_gaussian(probe, rig, total)
        why = f"{total:.3g} e- of noise at {brightest:.3g} e-, {read:.3g} e- without"
        return Bound(in_unit(told_apart(total, read), total, probe, rig), why)

    def _of_gaussian(self, probe: Probe, rig: Rig, total: float) -> Bound:
        read = rig.camera.read_noise_e
        worst = max(chip_variation(0.0), chip_variation(read))
        apart = 2 * worst / np.sqrt(CHIP_SAMPLES)  # of one sample: 2 TV <= sqrt(divergence), which sums with samples
        apart *= np.sqrt(probe.binning)
        why = (
            f"{CHIP_SAMPLES:.0e} numbers have a total variation of at most {worst:.2g} from exact ones"
            f" (limit {MOST_VARIATION:.2g}); exact below {least_expected(read):.3g} e-, without read noise"
            f" {least_expected(0.0):.3g} e-"
        )
        return Bound(in_unit(apart, total, probe, rig), why)


SHOT = Shot()


def in_unit(deviations: float, sd_e: float, probe: Probe, rig: Rig) -> float:
    """Give deviations of a noise of ``sd_e`` in each sample [e-] in the unit of the probe."""
    if probe.unit == "sigma":
        return deviations
    return deviations * sd_e * float(np.sqrt(probe.binning)) / rig.camera.electrons_per_dn

"""From expected electrons to numbers: shot noise, read noise, saturation, quantisation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pipeline.simulator.effects.effect import Bound, Effect, Merged
from pipeline.simulator.effects.noise import (
    CHIP_SAMPLES,
    LEAST_MERGED_READ_E,
    MOST_VARIATION,
    SERIES_FROM_E,
    chip_variation,
    least_expected,
    told_apart,
)
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.effects.sensor import dark_electrons, most_hot_electrons
from pipeline.simulator.rig_model import Rig

REACH = 6.0  # deviations of the noise that the brightest sample may lie above its mean
EXACT, GAUSSIAN = "exact", "gaussian"
DIM_NS = 80.0  # of an exact count below `SERIES_FROM_E`, in lines of any light


@dataclass(frozen=True)
class Saturation(Effect):
    """What is above the well or the converter's full scale is lost. Off, the converter clips all the same.

    Raw lines are numbers of so many bits, so every line is clipped whatever a probe of a few lines found.
    """

    name = "saturation"
    cost_ns = MappingProxyType({"exact": 0.1})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by how far the brightest sample, 6 deviations up, reaches above the lower of both limits."""
        limit = min(rig.camera.full_well_e, rig.detector.well_e)
        camera, brightest = rig.camera, max(probe.brightest_e, 0.0)
        expected = brightest + dark_electrons(rig) + most_hot_electrons(rig)
        sd = 0.0 if rig.detector.noiseless else float(np.hypot(np.sqrt(expected), camera.read_noise_e))
        over = max(expected + REACH * sd - limit, 0.0)
        if over == 0:
            return Bound(0.0, f"{expected:.3g} e- and 6 x {sd:.3g} e- of noise stay below {limit:.3g} e-")
        why = f"{expected:.3g} e- and 6 x {sd:.3g} e- of noise reach {over:.3g} e- above the limit of {limit:.3g} e-"
        unit_dn = probe.unit_least_dn
        if probe.unit == "sigma" and sd > 0 and not rig.detector.hot_share:  # what is lost, is lost where it is bright
            of_sample = float(np.hypot(np.sqrt(brightest), camera.read_noise_e)) / camera.electrons_per_dn
            unit_dn = of_sample / np.sqrt(probe.binning)
        return Bound(over / camera.electrons_per_dn / unit_dn, why)


SATURATION = Saturation()


def well_reached(rig: Rig, read_noise_e: float) -> bool:
    """Whether a well overflows before the converter ends, 8 deviations of the read noise counted in."""
    camera = rig.camera
    end_e = (camera.full_scale_dn + 1 - camera.dark_dn) * camera.electrons_per_dn
    return rig.detector.well_e < end_e + 8 * read_noise_e


@dataclass(frozen=True)
class Shot(Effect):
    """Poisson counts. ``gaussian`` has their first three cumulants, and takes the read noise into the same draw.

    Where so few electrons are expected that a patch of its numbers could be told from exact ones, it is exact.
    Noise counts twice the total variation between the distributions of a sample with and without: see `told_apart`.
    """

    name = "shot"
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

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it at the brightest sample, where it is the greatest share of all noise."""
        brightest = max(probe.brightest_e, 0.0) + dark_electrons(rig) + most_hot_electrons(rig)
        if rig.detector.noiseless:
            return Bound(0.0, "the sensor is ideal")
        if brightest == 0:
            return Bound(0.0, "no electrons are expected")
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


@dataclass(frozen=True)
class ReadNoise(Effect):
    """Normal, with the camera's standard deviation. In one draw with the shot noise where that is not exact.

    Noise counts twice the total variation between the distributions of a sample with and without: see `told_apart`.
    """

    name = "read-noise"
    cost_ns = MappingProxyType({"exact": 3.2})

    def merged(self, rig: Rig) -> Merged | None:
        """Give what it costs in the shot noise's draw: nothing, where no well comes between them."""
        if rig.camera.read_noise_e < LEAST_MERGED_READ_E or well_reached(rig, rig.camera.read_noise_e):
            return None
        return Merged(SHOT.name, GAUSSIAN, 0.0)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it at the darkest sample, where it is the greatest share of all noise."""
        read = rig.camera.read_noise_e
        if rig.detector.noiseless:
            return Bound(0.0, "the sensor is ideal")
        if read == 0:
            return Bound(0.0, "the camera has none")
        shot = float(np.sqrt(max(probe.darkest_e, 0.0)))
        total = float(np.hypot(shot, read))
        why = f"{read:.3g} e- beside at least {shot:.3g} e- of shot noise make {total:.3g} e-"
        return Bound(in_unit(told_apart(total, shot), total, probe, rig), why)


READ_NOISE = ReadNoise()


@dataclass(frozen=True)
class Quantisation(Effect):
    """Rounding half to even. Raw lines are whole numbers, so it is never left out."""

    name = "quantisation"
    cost_ns = MappingProxyType({"exact": 0.4})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by half a DN."""
        value = probe.added(0.5 * rig.camera.electrons_per_dn, rig.camera.electrons_per_dn)
        return Bound(value, f"0.5 DN of {rig.camera.electrons_per_dn:g} e-")


QUANTISATION = Quantisation()

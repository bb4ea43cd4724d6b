"""Defects: elements of one sensor that do not respond, and elements that leak."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.dark_current import warmth
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.streams import unit_stream

Light = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Defects:
    """Dead elements gather no light; hot ones add electrons, with their shot noise. An element may be both."""

    name = "defects"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.3})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by the greatest signal of bands with dead elements, and the electrons of hot ones."""
        bands = len(probe.wavelength_nm)
        dead, hot = dead_elements(rig, bands), hot_electrons(rig, bands)
        if variant != OFF or not (dead.any() or hot.any()):
            return Bound(0.0, "exact" if variant != OFF else "no element is dead or hot")
        lost = probe.scaled(dead.any(axis=0).astype(np.float64))
        electrons = float(hot.max())
        gained = min(electrons, rig.camera.full_well_e)  # the converter's end
        why = f"{dead.sum()} dead and {(hot > 0).sum()} hot elements of {dead.size}, these with {electrons:.3g} e- more"
        added = probe.added(gained, rig.camera.electrons_per_dn) if gained else 0.0
        return Bound(max(lost, added), why)


DEFECTS = Defects()


def dead_elements(rig: Rig, bands: int) -> Mask:
    """Give the elements without response, (sample, band) of the whole camera."""
    return _mask(rig.detector.unit, "dead", rig.camera.samples, bands, share=rig.detector.dead_share)


def hot_electrons(rig: Rig, bands: int) -> Light:
    """Give what hot elements add in one exposure, (sample, band) of the whole camera. [e-]"""
    detector = rig.detector
    mask = _mask(detector.unit, "hot", rig.camera.samples, bands, share=detector.hot_share)
    return mask * np.float32(most_hot_electrons(rig))


def most_hot_electrons(rig: Rig) -> float:
    """Give what a hot element adds in one exposure; 0 where the sensor has none, or is ideal. [e-]"""
    detector = rig.detector
    if detector.noiseless or not detector.hot_share:
        return 0.0
    return detector.hot_e_per_s * rig.camera.exposure_ms * 1e-3 * warmth(detector.temperature_deg_c)


@lru_cache(maxsize=8)
def _mask(unit: int, kind: str, samples: int, bands: int, *, share: float) -> Mask:
    """Elements below a share of uniform draws, band by band: more bands or a larger share keep those there were."""
    below = unit_stream(unit, kind).random((bands, samples)) < share
    mask: Mask = np.ascontiguousarray(below.T)
    mask.setflags(write=False)
    return mask

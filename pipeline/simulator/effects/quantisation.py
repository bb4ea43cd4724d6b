"""Quantisation: the converter gives whole numbers."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig


@dataclass(frozen=True)
class Quantisation:
    """Rounding half to even. Raw lines are whole numbers, so it is never left out."""

    name = "quantisation"
    variants = ("exact",)
    cost_ns = MappingProxyType({"exact": 0.4})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by half a DN."""
        if variant != OFF:
            return Bound(0.0, "exact")
        value = probe.added(0.5 * rig.camera.electrons_per_dn, rig.camera.electrons_per_dn)
        return Bound(value, f"0.5 DN of {rig.camera.electrons_per_dn:g} e-")


QUANTISATION = Quantisation()

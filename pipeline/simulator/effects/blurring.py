"""What leaving out a blur changes, told in numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.effect import Bound, Moments
from pipeline.simulator.probe import Probe

Floats = NDArray[np.float64]
UNITS = {"sigma": "sigma", "dn": "DN"}


def blurred_bound(probe: Probe, variance: Floats, cause: str) -> Bound:
    """Bound what a kernel of mean 0 and (2, band) variance [px^2] changes; ``cause`` says where the blur comes from.

    The sentence names the band that changes most.
    """
    value = probe.blurred(variance)
    if not variance.any():
        return Bound(value, f"{cause}: none")
    along, scan = np.sqrt(variance)
    band = int(np.argmax((probe.curvature * variance).sum(axis=0)))
    nm, detail = probe.wavelength_nm[band], probe.curvature[:, band].max()
    return Bound(
        value,
        f"{cause}: {along[band]:.2g} px (sd) along the line, {scan[band]:.2g} px along the scan at {nm:.0f} nm,"
        f" on detail of at most {detail:.3g} {UNITS[probe.unit]}/px^2",
    )


def even(variance: Floats, bands: int) -> Moments:
    """Give the moments of a blur that is the same in all bands: no shift, and (2,) variance along line and scan."""
    return Moments(np.zeros((2, bands)), np.repeat(np.asarray(variance, np.float64)[:, None], bands, axis=1))

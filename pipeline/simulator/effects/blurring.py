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
    return mixture_bound(probe, np.ones(1), variance[None], cause)


def mixture_bound(probe: Probe, share: Floats, variance: Floats, cause: str) -> Bound:
    """Bound what a sum of Gaussians changes, of shares (kernel,) and (kernel, 2, band) variance [px^2]."""
    change = sum((part * probe.change_blurred(one) for part, one in zip(share, variance, strict=True)), np.zeros(1))
    value = float(change.max(initial=0.0))
    if not variance.any():
        return Bound(value, f"{cause}: none")
    band = int(np.argmax(change))
    nearest = np.sqrt(variance[int(np.argmax(share)), :, band])
    nm, detail = probe.wavelength_nm[band], probe.curvature[:, band].max()
    return Bound(
        value,
        f"{cause}: {nearest[0]:.2g} px (sd) along the line, {nearest[1]:.2g} px along the scan at {nm:.0f} nm,"
        f" on detail of at most {detail:.3g} {UNITS[probe.unit]}/px^2",
    )


def even(variance: Floats, bands: int) -> Moments:
    """Give the moments of a blur that is the same in all bands: no shift, and (2,) variance along line and scan."""
    return Moments(np.zeros((2, bands)), np.repeat(np.asarray(variance, np.float64)[:, None], bands, axis=1))

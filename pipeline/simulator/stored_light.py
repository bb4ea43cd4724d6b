"""Light as it is stored: a number of a raw line sums neighbouring samples, and has the noise of that sum.

All is counted per sample: light as the mean over the samples of a sum, noise as that of the mean. A change of the one
over the other is the change of the stored number in its own sigmas, whatever the binning: an error that all samples
share grows with their number n, the noise with its root.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.probe import Unit
from pipeline.simulator.rig_model import Rig

Light = NDArray[np.float32]


def stored_mean(light: NDArray[np.floating], binning: int) -> NDArray[np.floating]:
    """Give the mean of each ``binning`` neighbours, (..., sample, band) -> (..., sample // binning, band).

    A remainder is dropped, as in the raw lines.
    """
    if binning == 1:
        return light
    count = light.shape[-2] // binning
    whole = light[..., : count * binning, :].reshape(*light.shape[:-2], count, binning, light.shape[-1])
    mean: NDArray[np.floating] = whole.mean(axis=-2)
    return mean


def noise_electrons(signal: NDArray[np.floating], rig: Rig, binning: int = 1) -> Light:
    """Give one standard deviation of shot noise, read noise and quantisation at each signal; never 0. [e-]

    ``signal`` is the mean of ``binning`` samples, each with noise of its own, and the noise is that of the mean.
    """
    camera, quantised = rig.camera, rig.camera.electrons_per_dn**2 / 12
    if rig.detector.noiseless:
        return np.full_like(signal, np.sqrt(quantised / binning))
    noise: Light = np.sqrt(np.maximum(signal, 0) + np.float32(camera.read_noise_e**2 + quantised))
    return noise if binning == 1 else noise / np.float32(np.sqrt(binning))


def unit_at(signal: NDArray[np.floating], rig: Rig, unit: Unit, binning: int = 1) -> Light:
    """Give what a unit of the tolerance, of a number that sums ``binning`` samples, is of their mean signal. [e-]"""
    if unit == "sigma":
        return noise_electrons(signal, rig, binning)
    return np.full_like(signal, rig.camera.electrons_per_dn / binning)

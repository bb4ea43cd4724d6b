"""Units of a stored number: the noise of a sum of samples, or a DN of it, at any light.

A number of a raw line sums neighbouring samples, and has the noise of that sum. All is counted per sample: light as the
mean over the samples of a sum, noise as that of the mean. A change of the one over the other is the change of the
stored number in its own sigmas, whatever the binning: an error that all samples share grows with their number n, the
noise with its root.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.probe import Probe, Unit
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
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


def fixed_variance(rig: Rig) -> float:
    """Give the variance of read noise and quantisation, which light does not change. [e-^2]"""
    camera = rig.camera
    return camera.read_noise_e**2 + camera.electrons_per_dn**2 / 12


def unit_electrons(light_e: Floats, probe: Probe, rig: Rig) -> Floats:
    """Give the unit of the probe at some light [e-]; what does not follow the light is the smallest unit met."""
    if probe.unit == "sigma" and not rig.detector.noiseless:
        return np.sqrt((np.maximum(light_e, 0.0) + fixed_variance(rig)) / probe.binning)
    return np.full_like(light_e, probe.unit_least_dn * rig.camera.electrons_per_dn)


def lights_within(probe: Probe, rig: Rig) -> tuple[Floats, Floats]:
    """Give least and greatest light of every band, (band,) each [e-]: where level and span have their units from.

    With U(S)^2 = (S + n) / m for means of m samples, the greatest S has level S / U(S), and the least a difference of
    span U to it, or a smaller.
    """
    if probe.unit != "sigma" or rig.detector.noiseless:
        unit = unit_electrons(probe.level, probe, rig)
        high, way = probe.level * unit, probe.span * unit
    else:
        fixed, level, span = fixed_variance(rig), probe.level**2 / probe.binning, probe.span**2 / probe.binning
        high = (level + np.sqrt(level * (level + 4 * fixed))) / 2
        way = (np.sqrt(span * (span + 4 * (high + fixed))) - span) / 2
    return np.maximum(high - way, probe.darkest_e), high

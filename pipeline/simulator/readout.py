"""Readout of the samples' electrons: noise and the converter's numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.simulator.effects import counting
from spectralzoom.pipeline.simulator.effects.counting import DARK_CURRENT, DEFECTS, EXACT, READ_NOISE, SHOT
from spectralzoom.pipeline.simulator.effects.effect import OFF, Chosen, Effect, Radiance, SweepBlock


def read_out(light: Radiance, block: SweepBlock, chosen: Chosen) -> NDArray[np.uint16]:
    """Turn expected electrons into DN, with the readout's effects among those chosen.

    The converter always rounds (half to even) and never gives less than 0 or more than its full scale.

    ``light``: (line, sample, band) of the block; negative values count as 0. [e-]
    Returns (line, sample, band) uint16.
    Raises SceneError: a number is not finite; names the first.
    """
    readout = Readout(block, chosen)
    raw = np.empty(light.shape, np.uint16)
    for row, number in enumerate(block.numbers):
        raw[row] = readout.numbers(light[row], int(number))
    return raw


def dark_frame(block: SweepBlock, chosen: Chosen) -> Radiance:
    """Return what the chosen readout shows without light, on average, (sample, band) float32, before rounding. [DN]

    Numbers below 0 become 0, so that the mean is above a dark level that noise reaches down from.
    """
    readout = Readout(block, chosen)
    camera = block.rig.camera
    dark: Radiance = np.zeros((camera.samples, len(block.wavelength_nm)), np.float32) + readout.added
    dark = dark / np.float32(camera.electrons_per_dn) + np.float32(camera.dark_dn)
    if readout.read_noise_e:
        sd = np.sqrt(readout.read_noise_e**2 + readout.added) / camera.electrons_per_dn
        bell = np.exp(-((dark / sd) ** 2) / 2) / math.sqrt(math.tau)
        dark = (dark * scipy.special.ndtr(dark / sd) + sd * bell).astype(np.float32)
    return np.minimum(dark, np.float32(camera.full_scale_dn), out=dark)


@dataclass(frozen=True)
class Readout:
    """The readout of one block's samples under a choice of effects."""

    block: SweepBlock
    chosen: Chosen

    def numbers(self, light: Radiance, number: int) -> NDArray[np.uint16]:
        """Return the converter's numbers of one line's light, (sample, band) [e-]."""
        if self.shot in (OFF, EXACT) or self.read_noise_e < counting.LEAST_MERGED_READ_E:
            return self.converted(self.electrons(light, number))  # shot and read noise are draws of their own
        from spectralzoom.pipeline.simulator import compiled_loops

        seen = np.ascontiguousarray(light if self.dead is None else np.where(self.dead, 0, light), np.float32)
        deviate = self._deviates(SHOT, number)
        camera = self.block.rig.camera
        raw = np.empty(light.shape, np.uint16)
        finite = compiled_loops.read_merged(
            *(seen.reshape(-1), np.ravel(np.asarray(self.added, np.float32)), deviate.reshape(-1), self.read_noise_e),
            *(camera.electrons_per_dn, camera.dark_dn, camera.full_scale_dn, raw.reshape(-1)),
        )
        least = counting.least_expected(self.read_noise_e)
        if not finite or least:
            expected = self._expected(light, number)
            dim = np.flatnonzero(expected < np.float32(least))
            exact = counting.photon_counts(expected.take(dim), deviate.take(dim))
            exact += self._deviates(READ_NOISE, number).take(dim) * np.float32(self.read_noise_e)
            raw.reshape(-1)[dim] = self.converted(exact)
        return raw

    def electrons(self, light: Radiance, number: int) -> Radiance:
        """Return what leaves the amplifier for one line's light, (sample, band); each noise of its own draw. [e-]"""
        expected = self._expected(light, number)
        electrons = expected
        if self.shot != OFF:
            deviate = self._deviates(SHOT, number)
            counts = counting.photon_counts if self.shot == EXACT else counting.rounded_counts
            electrons = counts(expected, deviate)
            if self.shot != EXACT and (least := counting.least_expected(0.0)):
                dim = np.flatnonzero(expected < np.float32(least))
                electrons.reshape(-1)[dim] = counting.photon_counts(expected.take(dim), deviate.take(dim))
        if self.read_noise_e:
            electrons += self._deviates(READ_NOISE, number) * np.float32(self.read_noise_e)
        return electrons

    def converted(self, electrons: Radiance) -> NDArray[np.uint16]:
        """Return the converter's numbers, rounded half to even, within 0 and its full scale."""
        camera = self.block.rig.camera
        dn = electrons / np.float32(camera.electrons_per_dn)
        dn += np.float32(camera.dark_dn)
        np.clip(np.rint(dn, out=dn), 0, camera.full_scale_dn, out=dn)
        return dn.astype(np.uint16)

    @cached_property
    def added(self) -> Radiance | np.float32:
        """Return electrons that come without light: a number, or (sample, band) where there are hot elements."""
        dark = counting.dark_electrons(self.block.rig) if DARK_CURRENT in self.chosen else 0.0
        if DEFECTS not in self.chosen or not self.block.rig.detector.hot_fraction:
            return np.float32(dark)
        return counting.hot_electrons(self.block.rig, len(self.block.wavelength_nm)) + np.float32(dark)

    @cached_property
    def dead(self) -> NDArray[np.bool_] | None:
        """Return elements without response, (sample, band); None where there are none."""
        if DEFECTS not in self.chosen or not self.block.rig.detector.dead_fraction:
            return None
        return counting.dead_elements(self.block.rig, len(self.block.wavelength_nm))

    @property
    def shot(self) -> str:
        """Return the variant of shot noise; an ideal sensor has none."""
        return OFF if self.block.rig.detector.noiseless else self.chosen.get(SHOT, OFF)

    @property
    def read_noise_e(self) -> float:
        """Return standard deviation of the amplifier's noise; 0 where it is off. [e-]"""
        rig = self.block.rig
        return 0.0 if rig.detector.noiseless or READ_NOISE not in self.chosen else rig.camera.read_noise_e

    def _expected(self, light: Radiance, number: int) -> Radiance:
        """Return electrons that a line's elements expect, (sample, band) (SceneError: one is not finite)."""
        expected = np.maximum(light, 0)
        if self.dead is not None:
            expected[self.dead] = 0
        expected += self.added
        if not np.isfinite(expected.max(initial=0.0)):
            sample, band = np.argwhere(~np.isfinite(expected))[0]
            raise SceneError(
                f"sweep {self.block.sweep.name}: line {number}, sample {sample}, band {band}"
                f" expects {expected[sample, band]} electrons; give a scene and a rig of finite numbers"
            )
        return expected

    def _deviates(self, effect: Effect, number: int) -> Radiance:
        """Return standard normal deviates of one line, (sample, band)."""
        size = self.block.rig.camera.samples, len(self.block.wavelength_nm)
        return counting.normal_deviates(self.block.stream(effect.name, number), math.prod(size)).reshape(size)

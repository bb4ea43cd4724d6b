"""Lines of the built-in farm that trade-offs of the simulator work on, and how far other light is from exact light."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import full_sweeps
from pipeline.simulator.effects.effect import OFF, Effect, SweepBlock
from pipeline.simulator.effects.probe import Probe, noise_electrons
from pipeline.simulator.effects.registry import EFFECTS, FOOTPRINT, RAYS
from pipeline.simulator.render import Choice, expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.selection.choice import decide
from pipeline.simulator.selection.survey_probe import probe_scene
from pipeline.simulator.simulated import sweep_block

SHAPE = (512, 1280)
LINES = 8  # at each end of a sweep and in its middle
PATCH, FACTOR = 16, 4

Floats = NDArray[np.float64]
Light = NDArray[np.float32]


@dataclass(frozen=True)
class FarmLines:
    """Lines of an outer sweep over a farm, as the decision sees that farm. ``blocks`` are of the sweep's own lines."""

    scene: RasterScene
    rig: Rig
    probe: Probe
    blocks: tuple[SweepBlock, ...]
    exact: Mapping[Effect, str]  # everything that the rig has, in its exact variant

    @property
    def values(self) -> float:
        """Px times bands."""
        sizes = (len(block.lines) * len(block.columns) * len(block.wavelength_nm) for block in self.blocks)
        return float(sum(sizes))

    @property
    def footprint(self) -> dict[Effect, str]:
        """What the light of the scene passes on its way to the samples: rays, slit, smear and every blur, exact."""
        passed = {*RAYS, *FOOTPRINT}
        return {effect: variant for effect, variant in self.exact.items() if effect in passed}

    def light(self, chosen: Mapping[Any, str] | Choice) -> Light:
        """Expected electrons of all lines, (line, sample, band), with some effects on."""
        return np.concatenate([expected_light(self.scene, block, chosen) for block in self.blocks])


def look_at_lines(seed: int) -> FarmLines:
    """Draw a farm and plan its full scan; take the first, middle and last lines of the sweep that is planned first."""
    scene, rig = farm_scene(seed, SHAPE), Rig()
    sweeps = full_sweeps(SceneGrid(*SHAPE, PATCH, FACTOR), rig.camera, "x")
    probe = probe_scene(scene, rig, sweeps)
    count = sweeps[0].lines
    starts = (0, (count - LINES) // 2, count - LINES)
    blocks = tuple(sweep_block(scene, rig, sweeps[0], range(at, at + LINES), seed=seed) for at in starts)
    return FarmLines(scene, rig, probe, blocks, decide(probe, rig, EFFECTS, 0.0).exact)


def with_variant(chosen: Mapping[Effect, str], effect: Effect, variant: str) -> dict[Effect, str]:
    """Give the same effects with another variant of one of them, or without it."""
    changed = {one: variant if one is effect else its for one, its in chosen.items()}
    return {one: its for one, its in changed.items() if its != OFF}


@dataclass(frozen=True)
class Against:
    """Exact light, its noise, and how far other light is from it."""

    exact: Light  # [e-]
    noise: Light  # one sigma at each sample [e-]
    electrons_per_dn: float

    @staticmethod
    def of(exact: Light, rig: Rig) -> Against:
        """Take light as the reference."""
        return Against(exact, noise_electrons(exact, rig), rig.camera.electrons_per_dn)

    def greatest(self, light: Light) -> float:
        """Greatest change, in sigmas of the noise at the sample."""
        return max(float(np.abs(part).max()) for part in self._sigmas(light))

    def rms(self, light: Light) -> float:
        """Root of the mean square of the change, in the same sigmas."""
        squares = (float(np.square(part, dtype=np.float64).sum()) for part in self._sigmas(light))
        return float(np.sqrt(sum(squares) / light.size))

    def greatest_dn(self, light: Light) -> float:
        """Greatest change [DN]."""
        return float(np.abs(light - self.exact).max()) / self.electrons_per_dn

    def _sigmas(self, light: Light) -> Iterator[Light]:
        for changed, exact, noise in zip(light, self.exact, self.noise, strict=True):
            yield (changed - exact) / noise

    def levels(self) -> tuple[Level, ...]:
        """A tenth of the noise, and half a step of the converter at the darkest sample, where it is the largest."""
        return (
            Level("0.1 σ of noise", 0.1),  # noqa: RUF001
            Level("0.5 LSB at the darkest sample", 0.5 * self.electrons_per_dn / float(self.noise.min())),
        )


ERROR = "greatest change of a sample [σ of its noise]"  # noqa: RUF001
RMS, DN = "rms [σ]", "greatest [DN]"  # noqa: RUF001


def errors_beside(against: Callable[[Any], Against]) -> dict[str, Callable[[Any, Any, Light], float]]:
    """Give the further figures of light against the reference that a state holds."""
    return {
        RMS: lambda state, _setting, light: against(state).rms(light),
        DN: lambda state, _setting, light: against(state).greatest_dn(light),
    }

"""The choice of effects for permitted settings: it ends, and stored numbers keep the bounds of the effects left out.

Scenes are black to far beyond saturation, exposures shortest to longest, sums of 1 to 16 samples, bands at any
wavelengths, with noise and without.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.probe import Unit, unit_at
from spectralzoom.pipeline.simulator.render import EFFECTS, expected_light
from spectralzoom.pipeline.simulator.rig_model import Air, Detector, Rig
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene, raster_from_values
from spectralzoom.pipeline.simulator.selection.choice import decide
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_survey
from spectralzoom.pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.bound_trials import ROUNDING, misplaced_fraction
from tests.pipeline.simulator.small_scenes import looking_at_less

SHAPE = (40, 64)
PATTERNS = ("black", "even", "rows", "columns", "checkers", "pixel", "disc", "noise", "decades")


@dataclass(frozen=True)
class Asked:
    """Settings of a scan that a user may choose."""

    pattern: str = "rows"
    exposure_ms: float = 10_000.0
    wavelengths: tuple[float, ...] = (640.0, 550.0, 460.0)
    tolerance: float = 0.1
    unit: Unit = "sigma"
    read_noise_e: float = 20.0
    noiseless: bool = False
    distance_m: float | None = None
    seed: int = 0

    def rig(self) -> Rig:
        """Return a narrow rig, for speed."""
        camera = LineCamera(samples=32, exposure_ms=self.exposure_ms, read_noise_e=self.read_noise_e)
        return Rig(camera, detector=Detector(noiseless=self.noiseless), air=Air(distance_m=self.distance_m))

    def scene(self) -> RasterScene:
        """Return a pattern from 0 to 1 in every band, or over four decades."""
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
        rng = np.random.default_rng(self.seed)
        plane = {
            "black": np.zeros(SHAPE),
            "even": np.ones(SHAPE),
            "rows": y % 2,
            "columns": x % 2,
            "checkers": (x + y) % 2,
            "pixel": (y == 20) & (x == 30),
            "disc": np.hypot(y - 20, x - 30) < 4,
            "noise": rng.random(SHAPE),
            "decades": 10 ** rng.uniform(-2, 2, SHAPE),
        }[self.pattern]
        values = plane[..., None] * rng.uniform(0.3, 1, len(self.wavelengths))
        return raster_from_values(values, self.rig().camera, name="t", wavelength_nm=np.array(self.wavelengths))


ASKED = st.builds(
    Asked,
    pattern=st.sampled_from(PATTERNS),
    exposure_ms=st.one_of(st.sampled_from([0.5, 100.0, 10_000.0]), st.floats(0.5, 10_000.0)),
    wavelengths=st.lists(st.floats(300, 2500), min_size=1, max_size=4, unique=True).map(tuple),
    tolerance=st.sampled_from([0.0, 1e-3, 0.1, 1.0, np.inf]),
    unit=st.sampled_from(["sigma", "dn"]),
    read_noise_e=st.sampled_from([0.0, 20.0]),
    noiseless=st.booleans(),
    distance_m=st.sampled_from([None, 10.0, 300.0]),
    seed=st.integers(0, 20),
)


@settings(max_examples=1, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))  # a case takes seconds
@given(ASKED)
@example(Asked(pattern="columns", noiseless=True))
@example(Asked(exposure_ms=0.5, wavelengths=(300.0, 1760.0), tolerance=1e-3, read_noise_e=0.0))
@example(Asked(exposure_ms=9780.0, wavelengths=(529.3, 998.0), tolerance=1e-3, distance_m=10.0))
def test_decision_for_permitted_settings_keeps_its_bounds(asked: Asked) -> None:
    """No setting ends in a broken bound, a non-finite number or a warning."""
    scene = asked.scene()
    rig = asked.rig()
    sweeps = (
        Sweep("coarse-0", "coarse", "x", 0.0, -20.0, SHAPE[0] // 4, 4),
        Sweep("full-0", "fine", "x", 0.0, -20.0, SHAPE[0]),
    )
    with looking_at_less():
        probes = probe_survey(scene, rig, sweeps, asked.unit)
    decision = decide(probes, rig, EFFECTS, asked.tolerance)

    misplaced_e = max(one.brightest_e for one in probes) - min(one.darkest_e for one in probes)
    misplaced_e *= misplaced_fraction(decision.exact, decision.chosen)
    for sweep in sweeps:
        block = sweep_block(scene, rig, sweep, range(0, sweep.lines, 7))
        light, full = (expected_light(scene, block, one) for one in (decision.chosen, decision.exact))
        unit = unit_at(full, rig, asked.unit)
        assert ((np.abs(light - full) - misplaced_e - ROUNDING * full.max()) / unit).max() <= decision.error

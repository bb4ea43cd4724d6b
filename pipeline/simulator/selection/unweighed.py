"""Small scenes: where choosing takes longer than it can save, everything is on and exact, and nothing is looked at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.geometry.scan import CostModel, Sweep
from pipeline.simulator.effects.effect import Effect
from pipeline.simulator.effects.probe import Probe, Unit
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.selection.choice import Decision, Reason, Treatment
from pipeline.simulator.selection.options import ALWAYS_ON, unbounded_menu

CHOOSING_S = 0.9  # CPU seconds of a choice beside those of libraries, measured on scenes of any size
FEWEST_BANDS = 200  # a sample of fewer takes as long: most of it goes into the weights of its pixels


def everything(
    scene: RasterScene, rig: Rig, sweeps: Sequence[Sweep], effects: Sequence[Effect], tolerance: float, unit: Unit
) -> Decision:
    """Take all that the rig has, exact, without a look at the scene: nothing has a bound, and nothing needs one."""
    probe, taken = _unseen(scene, rig, sweeps, unit), []
    for effect in effects:
        menu = unbounded_menu(effect, probe, rig)
        reason: Reason = "absent" if not menu.present else "always" if menu.name in ALWAYS_ON else "unweighed"
        taken.append(Treatment(menu, menu.exact if menu.present else menu.off, reason))
    px_bands = sum(sweep.lines for sweep in sweeps) * rig.camera.samples * len(scene.wavelength_nm)
    return Decision(tuple(taken), tolerance, unit, "auto", px_bands)


def pays(decision: Decision, bands: int) -> bool:
    """Whether choosing may save more than it takes, given everything: by what effects cost with `FEWEST_BANDS`."""
    return decision.exact_cost_ns * 1e-9 * decision.px_bands * max(FEWEST_BANDS / bands, 1.0) > CHOOSING_S


def _unseen(scene: RasterScene, rig: Rig, sweeps: Sequence[Sweep], unit: Unit) -> Probe:
    """The probe of a scene that may be anything: every effect that the rig has shows in it."""
    nm, camera = scene.wavelength_nm, rig.camera
    one, both = np.ones(len(nm)), np.ones((2, len(nm)))
    return Probe(
        unit=unit,
        sweeps=tuple(sweeps),
        wavelength_nm=nm,
        fwhm_nm=scene.fwhm_nm,
        level=one,
        spread=one,
        span=one,
        slope=both,
        curvature=both,
        spectral_slope=one,
        spectral_curvature=one,
        brightest_e=camera.full_well_e,
        darkest_e=0.0,
        unit_least_dn=1.0,
        lines=sum(sweep.lines for sweep in sweeps),
        seconds=CostModel().seconds(list(sweeps), camera),
    )

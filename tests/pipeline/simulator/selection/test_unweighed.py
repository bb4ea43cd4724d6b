"""Small scenes, of which nothing is looked at: all that the rig has, exact, as if it had been asked for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.registry import EFFECTS
from pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Rig, Sky
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.selection.choice import Decision, decide, everything, list_effects, pays, sum_up
from pipeline.simulator.selection.survey_probe import probe_survey
from tests.pipeline.simulator.outdoors import NOON
from tests.pipeline.simulator.small_scenes import image_scene

CAMERA = LineCamera(samples=48)
SWEEP = Sweep("fine", "fine", "x", 0.0, -11.5, 24)
RIGS = {
    "usual": Rig(camera=CAMERA),
    "outdoors": Rig(
        camera=CAMERA,
        optics=Optics(focus_m=50.0),
        mirror=MirrorMotion(repeatability_urad=40.0, hysteresis_px=2.0, drift_px_per_min=1.0, coating="silver"),
        detector=Detector(dead_fraction=0.01, hot_fraction=0.01),
        air=Air(distance_m=40.0, relief="plane", nearest_m=30.0, farthest_m=60.0, wind_amplitude_m=0.02),
        sky=Sky(started=NOON, cloud_fraction=0.3),
    ),
    "ideal": Rig(
        camera=replace(CAMERA, read_noise_e=0.0),
        optics=Optics(aberration_px=0.0, keystone_px=0.0, smile_nm=0.0, stray_fraction=0.0),
        mirror=MirrorMotion(coating="ideal"),
        detector=Detector(noiseless=True, prnu_std=0.0, striping_std=0.0),
    ),
}


def scene_of(bands: int = 8) -> RasterScene:
    """Noise of many bands."""
    values = np.random.default_rng(0).uniform(0.05, 1, (24, 48, bands)).astype(np.float32)
    return image_scene(values, CAMERA, np.linspace(420, 980, bands))


def all_of(rig: Rig, sweeps: tuple[Sweep, ...], bands: int = 8) -> Decision:
    """Everything, without a look."""
    return everything(scene_of(bands), rig, sweeps, EFFECTS, 0.1, "sigma")


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("step", [1, 4])
def test_it_is_what_all_takes(name: str, step: int) -> None:
    """The effects are those of ``all``, in the same variants, whatever the rig has; nothing is left out."""
    sweeps, rig = (replace(SWEEP, step=step, lines=SWEEP.lines // step),), RIGS[name]
    found = all_of(rig, sweeps)
    asked = decide(probe_survey(scene_of(), rig, sweeps), rig, EFFECTS, 0.1, "all")
    assert found.chosen == asked.chosen == found.exact
    assert (found.error, found.px_bands) == (0, asked.px_bands)
    assert found.exact_cost_ns == pytest.approx(asked.exact_cost_ns, rel=0.5)


def test_choosing_pays_where_there_is_much_to_save() -> None:
    """Of thousands of lines, not of tens; and samples of few bands count as those of many."""
    rig = replace(RIGS["usual"], camera=LineCamera())
    few, many = (all_of(rig, (replace(SWEEP, lines=lines),)) for lines in (24, 2000))
    assert [pays(one, 8) for one in (few, many)] == [False, True]
    assert pays(many, 8) == pays(all_of(rig, (replace(SWEEP, lines=2000),), 200), 200)
    assert not pays(all_of(RIGS["ideal"], (replace(SWEEP, lines=2000),)), 200)


def test_the_manifest_says_that_nothing_was_weighed() -> None:
    """What leaving an effect out would change is not known, and its words say why it is on."""
    found = all_of(RIGS["usual"], (SWEEP,))
    rows = {row["name"]: row for row in list_effects(found)}
    assert (rows["slit"]["state"], rows["slit"]["reason"], rows["slit"]["bound"]) == ("on", "unweighed", 0)
    assert rows["slit"]["left_out"] is None
    assert math.isinf(next(one for one in found.taken if one.name == "slit").menu.off.error)
    assert "choosing takes longer than it can save" in rows["slit"]["why"]
    assert (rows["wind"]["state"], rows["wind"]["reason"], rows["wind"]["left_out"]) == ("off", "absent", 0)
    assert rows["quantisation"]["reason"] == "always"
    assert sum_up(found)["unweighed"]
    assert sum_up(found)["saved_s"] == 0

"""Laws of light over hard scenes, wherever they are seen from: never negative, never brighter than the scene, kept."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.effect import OFF, Effect, SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Air, Optics, Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.scenes.scene import RasterScene, SceneRaster
from tests.pipeline.simulator.bound_trials import IN_THE_LIGHT

SIZE = 96
NM = np.array([400.0, 550.0, 700.0, 1000.0])
RIG = Rig(camera=LineCamera(samples=48), optics=Optics(keystone_px=0.4), air=Air(distance_m=120.0))
SMALL = replace(RIG, camera=LineCamera(samples=16))
BLURS: tuple[Effect, ...] = (DIFFRACTION, DEFOCUS, ABERRATION, KEYSTONE)
Y, X = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
PICTURES = {
    "pixel": (np.abs(Y) < 1) & (np.abs(X) < 1) & (Y > 0) & (X > 0),
    "disc": np.hypot(Y, X) < 5,
    "edge": 0.8 * X + 0.6 * Y > 0,
    "checkerboard": (np.indices((SIZE, SIZE)).sum(axis=0) % 2 == 0),
}
CHOICES = st.fixed_dictionaries(
    {
        SLIT: st.sampled_from((*SLIT.variants, OFF)),
        SMEAR: st.sampled_from((*SMEAR.variants, OFF)),
        ROTATION: st.sampled_from(("rays", OFF)),
    }
    | {blur: st.sampled_from((*blur.variants, OFF)) for blur in BLURS}
)


def scene_of(picture: str, dark: float = 0.0) -> RasterScene:
    """The picture in all bands: 1 on ``dark``."""
    values = np.where(PICTURES[picture], 1.0, dark)
    return raster_from_values(np.repeat(values[..., None], len(NM), axis=2), RIG.camera, name=picture, wavelength_nm=NM)


def seen(scene: RasterScene, sweep: Sweep, chosen: dict[Any, str], rig: Rig = RIG) -> NDArray[np.float64]:
    """Light of all lines over that of the scene's brightest pixel."""
    block = SweepBlock(rig, sweep, range(sweep.lines), NM, scene.shape)
    light = expected_light(scene, block, {effect: variant for effect, variant in chosen.items() if variant != OFF})
    return light / scene.electrons.astype(np.float64)


@settings(max_examples=12, deadline=None)
@given(
    picture=st.sampled_from(sorted(PICTURES)),
    dark=st.sampled_from((0.0, 0.3)),
    chosen=CHOICES,
    strip=st.floats(-1.0, 1.0),
    start=st.floats(-13.0, -11.0),
    along=st.sampled_from("xy"),
    step=st.sampled_from((1, 4)),
    turned=st.booleans(),
)
def test_light_is_within_that_of_the_scene(
    picture: str, dark: float, chosen: dict[Any, str], strip: float, start: float, along: Any, step: int, turned: bool
) -> None:
    """At any place and turn of the lines and through any variants light lies between the scene's least and most."""
    far = 60.0 if turned else 0.0  # the scene's edge is repeated, its lines lie turned
    rows = 24 // step
    sweep = Sweep("s", "fine" if step == 1 else "coarse", along, strip + far, start + far, rows, step)
    light = seen(scene_of(picture, dark), sweep, chosen)
    assert light.min() >= dark * (1 - 1e-5)
    assert light.max() <= 1 + 1e-5


@settings(max_examples=8, deadline=None)
@given(
    picture=st.sampled_from(("pixel", "disc")),
    chosen=CHOICES,
    strip=st.floats(-1.0, 1.0),
    start=st.floats(-20.0, -18.0),
    along=st.sampled_from("xy"),
)
def test_light_of_what_is_swept_is_kept(
    picture: str, chosen: dict[Any, str], strip: float, start: float, along: Any
) -> None:
    """Where lines lie straight, samples 1 px apart sum to the light of a spot on black, wherever among them it lies.

    Of the tails of diffraction a part falls beside what is swept: they have a law of their own.
    """
    straight = chosen | {ROTATION: OFF, DIFFRACTION: "gaussian"}
    light = seen(scene_of(picture), Sweep("s", "fine", along, strip, start, 40), straight)
    np.testing.assert_allclose(light.sum(axis=(0, 1)), PICTURES[picture].sum(), rtol=2e-5)


@pytest.mark.parametrize("level", [2, 4, 16, 64])
def test_thinned_scenes_keep_their_light(level: int) -> None:
    """What the far tails look at: a spot anywhere between the pixels that are left has as much light as before."""
    rng = np.random.default_rng(level)
    planes = np.zeros((700, 600, 3), np.float32)
    planes[rng.integers(250, 400, 3), rng.integers(250, 350, 3), range(3)] = 1.0
    found = SceneRaster.of(planes).thinned(level)
    assert found.min() >= 0
    np.testing.assert_allclose(found.sum(axis=(0, 1)) * level**2, 1, rtol=1e-5)


def test_tails_of_diffraction_reach_as_far_as_the_pupil_says() -> None:
    """Beside an edge, 10 to 50 px in the dark, lies 2 / pi^3 lambda / (D x) of the bright side.

    Few wide Gaussians stand for the tail: within a quarter of it, 0.0002 of the bright side at most.
    """
    rig = Rig(camera=LineCamera(samples=16))
    values = np.repeat((np.arange(801) > 400)[None, :, None] * np.ones((400, 1, 4)), 1, axis=2)
    scene = raster_from_values(values, rig.camera, name="edge", wavelength_nm=NM)
    px = np.array([10, 20, 35, 50])
    sweeps = [Sweep("s", "fine", "x", strip_px=-float(x), start_px=0.0, lines=1) for x in px]
    light = np.concatenate([seen(scene, sweep, {SLIT: "1x1", DIFFRACTION: "airy"}, rig)[:, 8] for sweep in sweeps])
    waves = NM * 1e-9 / 15e-3 / rig.camera.ifov_rad
    np.testing.assert_allclose(light, 2 / np.pi**3 * waves / (px[:, None]), rtol=0.25)


@pytest.mark.parametrize(
    ("effect", "variant"),
    [(one, variant) for one in IN_THE_LIGHT for variant in one.variants],
    ids=lambda one: getattr(one, "name", one),
)
def test_no_variant_makes_light_negative(effect: Effect, variant: str) -> None:
    """A bright pixel on black through every variant of every effect, beside slit, turned lines and blurs."""
    chosen = {ROTATION: "rays", SLIT: "3x1"} | {blur: blur.variants[0] for blur in BLURS} | {effect: variant}
    ordered = {one: chosen[one] for one in IN_THE_LIGHT if one in chosen}
    light = seen(scene_of("pixel"), Sweep("s", "fine", "x", 0.4, -5.3, 12), ordered, SMALL)
    assert np.isfinite(light).all()
    assert light.min() >= 0

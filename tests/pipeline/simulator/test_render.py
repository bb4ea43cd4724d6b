"""Laws of light over hard scenes, and the renderer's combination of aims, displacements, blurs, gains and changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera, expose, footprint
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from spectralzoom.pipeline.simulator.effects.effect import OFF, Effect, SweepBlock
from spectralzoom.pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR
from spectralzoom.pipeline.simulator.optics.kernel_fit import Moments
from spectralzoom.pipeline.simulator.render import expected_light
from spectralzoom.pipeline.simulator.rig_model import Air, Optics, Rig
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene, SceneRadiance, SceneRaster
from spectralzoom.pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.small_scenes import effects_on, image_scene, made_scene

SIZE = 96
NM = np.array([400.0, 550.0, 700.0, 1000.0])
RIG = Rig(camera=LineCamera(samples=48), optics=Optics(keystone_px=0.4), air=Air(distance_m=120.0))
CAMERA = LineCamera()
OPTICS = effects_on("rotation", "slit", "smear")
SWEEP = Sweep("s", "fine", "x", swath_px=0.0, start_px=-19.5, lines=40)
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
    """Return the picture in all bands: 1 on ``dark``."""
    values = np.where(PICTURES[picture], 1.0, dark)
    return image_scene(np.repeat(values[..., None], len(NM), axis=2), RIG.camera, NM)


def seen(scene: RasterScene, sweep: Sweep, chosen: dict[Any, str], rig: Rig = RIG) -> NDArray[np.float64]:
    """Return the light of all lines over that of the scene's brightest pixel."""
    block = SweepBlock(rig, sweep, range(sweep.lines), NM, scene.shape)
    light = expected_light(scene, block, {effect: variant for effect, variant in chosen.items() if variant != OFF})
    return light / scene.electrons.astype(np.float64)


@settings(max_examples=12, deadline=None)
@given(
    picture=st.sampled_from(sorted(PICTURES)),
    dark=st.sampled_from((0.0, 0.3)),
    chosen=CHOICES,
    swath=st.floats(-1.0, 1.0),
    start=st.floats(-13.0, -11.0),
    along=st.sampled_from("xy"),
    step=st.sampled_from((1, 4)),
    turned=st.booleans(),
)
def test_light_stays_within_the_range_of_the_scene(
    picture: str, dark: float, chosen: dict[Any, str], swath: float, start: float, along: Any, step: int, turned: bool
) -> None:
    """At any place and rotation of the lines, with any variants, light lies between the scene's minimum and maximum."""
    far = 60.0 if turned else 0.0  # on the scene's repeated edge, where lines are rotated
    rows = 24 // step
    sweep = Sweep("s", "fine" if step == 1 else "coarse", along, swath + far, start + far, rows, step)
    light = seen(scene_of(picture, dark), sweep, chosen)
    assert light.min() >= dark * (1 - 1e-5)
    assert light.max() <= 1 + 1e-5


@settings(max_examples=8, deadline=None)
@given(
    picture=st.sampled_from(("pixel", "disc")),
    chosen=CHOICES,
    swath=st.floats(-1.0, 1.0),
    start=st.floats(-20.0, -18.0),
    along=st.sampled_from("xy"),
)
def test_sweep_conserves_light(picture: str, chosen: dict[Any, str], swath: float, start: float, along: Any) -> None:
    """Samples 1 px apart on straight lines sum to the light of a spot on black, at any place among them.

    Diffraction is off: a part of its tails falls outside of the sweep, and another test covers them.
    """
    straight = chosen | {ROTATION: OFF, DIFFRACTION: OFF}
    light = seen(scene_of(picture), Sweep("s", "fine", along, swath, start, 40), straight)
    np.testing.assert_allclose(light.sum(axis=(0, 1)), PICTURES[picture].sum(), rtol=2e-5)


@pytest.mark.parametrize("level", [2, 4, 16, 64])
def test_thinned_scenes_keep_their_light(level: int) -> None:
    """A spot anywhere between the remaining pixels, which the far tails use, keeps its light."""
    rng = np.random.default_rng(level)
    planes = np.zeros((700, 600, 3), np.float32)
    planes[rng.integers(250, 400, 3), rng.integers(250, 350, 3), range(3)] = 1.0
    found = SceneRaster.of(planes).thinned(level)
    assert found.min() >= 0
    np.testing.assert_allclose(found.sum(axis=(0, 1)) * level**2, 1, rtol=1e-5)


@pytest.mark.parametrize("pattern", ["rows", "columns", "noise"])
def test_edge_of_the_scene_is_repeated_outside(pattern: str) -> None:
    """A scene has the same light as one padded with 320 px of its edge, also through the far tails."""
    y, x = np.mgrid[:41, :52]
    plane = {"rows": y % 2, "columns": x // 3 % 2, "noise": np.random.default_rng(3).random((41, 52))}[pattern]
    values = np.repeat(plane[..., None] + 0.0, len(NM), axis=2)
    wide = np.pad(values, ((320, 320), (320, 320), (0, 0)), mode="edge")
    sweep = Sweep("s", "fine", "x", 0.0, -24.0, 49)
    chosen = {SLIT: "3x1", DIFFRACTION: "airy", ABERRATION: "gaussian", KEYSTONE: "linear"}
    light, same = (seen(image_scene(one, RIG.camera, NM), sweep, chosen) for one in (values, wide))
    np.testing.assert_allclose(light / light.max(), same / same.max(), atol=3e-5)


def test_tails_of_diffraction_match_the_pupil() -> None:
    """In the dark, 10 to 50 px from an edge, light is 2 / pi^3 lambda / (D x) of the bright side.

    Few wide Gaussians model the tail to within a quarter of it, 0.0002 of the bright side at most.
    """
    rig = Rig(camera=LineCamera(samples=16))
    values = np.repeat((np.arange(801) > 400)[None, :, None] * np.ones((400, 1, 4)), 1, axis=2)
    scene = image_scene(values, rig.camera, NM)
    px = np.array([10, 20, 35, 50])
    sweeps = [Sweep("s", "fine", "x", swath_px=-float(x), start_px=0.0, lines=1) for x in px]
    light = np.concatenate([seen(scene, sweep, {SLIT: "1x1", DIFFRACTION: "airy"}, rig)[:, 8] for sweep in sweeps])
    waves = NM * 1e-9 / 15e-3 / rig.camera.ifov_rad
    np.testing.assert_allclose(light, 2 / np.pi**3 * waves / (px[:, None]), rtol=0.25)


FINE = Sweep("fine", "fine", "x", swath_px=900.0, start_px=-700.0, lines=20)
PLAIN = {ROTATION: "rays", SMEAR: "positions", SLIT: "3x1"}


def grainy() -> RasterScene:
    """Return a raster of 3 components, different at every pixel, mixed to 5 bands."""
    rng = np.random.default_rng(0)
    planes = rng.uniform(0, 1, (90, 110, 3)).astype(np.float32)
    return made_scene(planes, rng.uniform(1e3, 9e3, (3, 5)).astype(np.float32), np.linspace(400, 1000, 5))


def block_of(scene: RasterScene, sweep: Sweep, lines: range, **more: object) -> SweepBlock:
    """Return lines of a sweep by the default rig as a block."""
    return SweepBlock(Rig(), sweep, lines, scene.wavelength_nm, scene.shape, **more)


NEAR = replace(FINE, swath_px=20.0, start_px=-40.0)


def test_line_without_effects_shows_pixel_values() -> None:
    """Without effects a sample at a pixel's centre shows the pixel's value."""
    scene = grainy()
    sweep = Sweep("s", "fine", "x", swath_px=0.0, start_px=-20.5, lines=30)  # places are pixel centres
    light = expected_light(scene, block_of(scene, sweep, range(30)), {})[:, 300:340]
    np.testing.assert_allclose(light, scene.planes[24:54, 35:75] @ scene.electrons, rtol=1e-5)


def test_scene_with_a_plane_per_band_equals_its_diagonal_matrix() -> None:
    """The same planes with a full but diagonal matrix of electrons give the same light."""
    diagonal = image_scene(np.random.default_rng(1).uniform(0, 1, (60, 50, 4)), CAMERA, np.linspace(400, 1000, 4))
    light = SceneRadiance(np.diag(diagonal.electrons), diagonal.white_reference_electrons)
    full = replace(diagonal, light=Once.of(light))
    chosen = {**PLAIN, Widening(): "only"}
    one, other = (expected_light(s, block_of(s, NEAR, range(12, 16)), chosen) for s in (diagonal, full))
    np.testing.assert_allclose(one, other, rtol=1e-5, atol=0.05)


@dataclass(frozen=True)
class Widening:
    """A blur and shift that grow with the wavelength."""

    name = "widening"
    variants = ("only",)

    def moments(self, rig: Rig, wavelength_nm: np.ndarray, variant: str, normal: np.ndarray | None = None) -> Moments:
        """Return moments that grow linearly with the band, from 0."""
        grown = np.arange(len(wavelength_nm)) / len(wavelength_nm)
        return Moments(np.stack([0.3 * grown, -0.2 * grown]), np.stack([0.2 * grown, 0.5 * grown]))


def test_blurs_widen_and_shift_each_band_by_its_moments() -> None:
    """On a wave every band has the contrast of its Gaussian and is seen from the shifted place."""
    wave = 1 + 0.5 * np.sin(2 * np.pi * np.arange(160) / 20)
    scene = image_scene(np.broadcast_to(wave[None, :, None], (40, 160, 6)), CAMERA, np.linspace(400, 1000, 6))
    block = block_of(scene, Sweep("s", "fine", "x", swath_px=0.0, start_px=-0.5, lines=1), range(1))
    light = expected_light(scene, block, {SLIT: "3x1", Widening(): "only"})[0, 280:360] / scene.electrons
    grown = np.arange(6) / 6
    passed = np.exp(-2 * np.pi**2 * 0.2 * grown / 400) * np.sinc(1 / 20) ** 3  # pixel, and linear interpolation
    place = (np.arange(280, 360) - 240)[:, None] + 0.3 * grown
    np.testing.assert_allclose(light, 1 + 0.5 * passed * np.sin(2 * np.pi * place / 20), atol=2e-3)


@dataclass(frozen=True)
class Nudge:
    """An effect that aims or displaces by (3, -2) px, or applies a gain or a change of light."""

    name = "nudge"
    variants = ("only",)
    do: str = "aim"

    def __getattr__(self, action: str) -> object:
        if action != self.do:
            raise AttributeError(action)
        ways = {
            "aim": lambda block, variant: np.full((len(block.lines), 1, 2), (3.0, -2.0)),
            "displaced": lambda block, along, scan, variant: (np.full_like(along, 3.0), np.full_like(scan, -2.0)),
            "gain": lambda block, variant: np.float32([1.0, 2.0, 3.0, 4.0, 5.0]),
            "change": lambda light, block, variant: light + np.float32(7),
        }
        return ways[action]


def test_aims_and_displacements_move_the_view() -> None:
    """Close to rest an aim and a displacement by whole px show the samples of neighbouring lines."""
    scene = grainy()
    sweep = replace(NEAR, swath_px=0.0, start_px=-20.0)
    plain = expected_light(scene, block_of(scene, sweep, range(16)), {SLIT: "3x1"})[:, 310:330]
    for do in ("aim", "displaced"):
        moved = expected_light(scene, block_of(scene, sweep, range(2, 16)), {Nudge(do): "only", SLIT: "3x1"})
        np.testing.assert_allclose(moved[:, 307:327], plain[:14], rtol=1e-3)


def test_gains_and_changes_are_applied_in_order() -> None:
    """Light that is added before a gain differs from light that is added after it."""
    scene = grainy()
    block = block_of(scene, NEAR, range(3))
    plain = expected_light(scene, block, {})
    gain = np.arange(1, 6, dtype=np.float32)
    first = expected_light(scene, block, {Nudge("gain"): "only", Nudge("change"): "only"})
    last = expected_light(scene, block, {Nudge("change"): "only", Nudge("gain"): "only"})
    np.testing.assert_allclose(first, plain * gain + 7, rtol=1e-6)
    np.testing.assert_allclose(last, (plain + 7) * gain, rtol=1e-6)


def test_flat_scene_gives_flat_lines() -> None:
    """Far from rest all samples have the same electrons, in proportion to exposure; the mirror's throughput is off."""
    scene = image_scene(np.full((30, 30, 2), 4.0), CAMERA, [400.0, 900.0])
    far = Sweep("far", "coarse", "y", swath_px=2000.0, start_px=-3000.0, lines=5, step=4)
    expected = np.broadcast_to(4 * scene.electrons, (5, 640, 2))
    for camera, times in ((CAMERA, 1), (replace(CAMERA, exposure_ms=250.0), 2.5)):
        light = expected_light(scene, sweep_block(scene, Rig(camera), far, range(5)), OPTICS)
        np.testing.assert_allclose(light, times * expected, rtol=1e-5)


@pytest.mark.parametrize("step", [1, 4])
def test_undeflected_sweep_equals_the_operator_of_training(step: int) -> None:
    """Around the undeflected direction lines match the closed-form operator that training uses, with slit and smear."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:40, :640]
    values = np.ones((40, 640, 1))
    for _ in range(12):  # waves of 6 to 60 px
        fy, fx = rng.normal(size=2) / rng.uniform(6, 60)
        values += 0.03 * np.cos(2 * np.pi * (fy * y + fx * x) + rng.uniform(0, 6))[..., None]
    scene = image_scene(values, CAMERA, [400.0])
    sweep = replace(SWEEP, lines=40 // step, step=step)
    lines = expected_light(scene, sweep_block(scene, Rig(CAMERA), sweep, range(sweep.lines)), OPTICS)
    exact = replace(CAMERA, electrons_per_dn=1.0, bits=16)
    blurred = footprint(values.astype(np.float32) * scene.electrons, exact)
    viewed = expose(blurred.reshape(sweep.lines, step, 640, 1).mean(axis=1), exact, rng=None)
    assert np.abs(lines.reshape(viewed.shape) - viewed).max() < 0.02 * viewed.std()

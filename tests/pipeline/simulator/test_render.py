"""The light of a block: laws of blocks and samples, blurs by band, aims, displacements, gains and changes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.lazy import Once
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR
from pipeline.simulator.effects.sensor import STRAY_LIGHT
from pipeline.simulator.optics.kernel_fit import Moments
from pipeline.simulator.render import Choice, expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, SceneRaster

CAMERA = LineCamera()
FINE = Sweep("fine", "fine", "x", strip_px=900.0, start_px=-700.0, lines=20)
COARSE = Sweep("coarse", "coarse", "y", strip_px=-500.0, start_px=200.0, lines=9, step=4, binning=4)
PLAIN = {ROTATION: "rays", SMEAR: "positions", SLIT: "3x1"}


def grainy(bands: int = 5, seed: int = 0) -> RasterScene:
    """A raster of 3 components, different at every pixel, mixed to ``bands``."""
    rng = np.random.default_rng(seed)
    planes = rng.uniform(0, 1, (90, 110, 3)).astype(np.float32)
    wavelength = np.linspace(400, 1000, bands)
    electrons = rng.uniform(1e3, 9e3, (3, bands)).astype(np.float32)
    return RasterScene(
        "grain",
        "grain",
        SceneRaster.of(planes),
        Once.of(SceneLight(electrons, electrons[0])),
        np.ones(bands, np.float32),
        wavelength,
    )


def block_of(scene: RasterScene, sweep: Sweep, lines: range, **more: object) -> SweepBlock:
    """Lines of a sweep by a rig as it is."""
    return SweepBlock(Rig(), sweep, lines, scene.wavelength_nm, scene.shape, **more)


NEAR = replace(FINE, strip_px=20.0, start_px=-40.0)


def test_whole_lines_are_made_where_an_effect_needs_them() -> None:
    """With stray light some of a line's samples are those of the whole line, to the bit."""
    scene, chosen = grainy(), {**PLAIN, STRAY_LIGHT: "halo"}
    whole = expected_light(scene, block_of(scene, NEAR, range(3)), chosen)
    some = expected_light(scene, block_of(scene, NEAR, range(3), samples=range(300, 310, 2)), chosen)
    np.testing.assert_array_equal(some, whole[:, 300:310:2])


def test_nothing_chosen_is_a_straight_line_of_points() -> None:
    """Without effects a sample at a pixel's centre sees the pixel's value."""
    scene = grainy()
    sweep = Sweep("s", "fine", "x", strip_px=0.0, start_px=-20.5, lines=30)  # places are pixel centres
    light = expected_light(scene, block_of(scene, sweep, range(30), samples=range(300, 340)), {})
    wanted = scene.planes[24:54, 35:75] @ scene.electrons
    np.testing.assert_allclose(light, wanted, rtol=1e-5)


@pytest.mark.parametrize("chosen", [{}, PLAIN, {SLIT: "1x1"}, {ROTATION: "rays", SMEAR: "folded", SLIT: "3x1"}])
@pytest.mark.parametrize("sweep", [NEAR, COARSE])
def test_lines_and_samples_do_not_depend_on_their_block(chosen: dict, sweep: Sweep) -> None:
    """Blocks of 1, 7 and all lines, and a part of the samples, give the same light."""
    scene = grainy()
    whole = expected_light(scene, block_of(scene, sweep, range(sweep.lines)), chosen)
    for size in (1, 7):
        starts = range(0, sweep.lines, size)
        parts = [range(start, min(start + size, sweep.lines)) for start in starts]
        blocks = np.concatenate([expected_light(scene, block_of(scene, sweep, lines), chosen) for lines in parts])
        np.testing.assert_allclose(blocks, whole, rtol=1e-6)
    some = expected_light(scene, block_of(scene, sweep, range(2, 5), samples=range(311, 330, 3)), chosen)
    np.testing.assert_allclose(some, whole[2:5, 311:330:3], rtol=1e-6)


def test_diagonal_scene_is_that_of_its_matrix() -> None:
    """A scene with a plane of its own in each band gives what its diagonal matrix of electrons gives."""
    diagonal = raster_from_values(
        np.random.default_rng(1).uniform(0, 1, (60, 50, 4)), CAMERA, name="d", wavelength_nm=np.linspace(400, 1000, 4)
    )
    light = SceneLight(np.diag(diagonal.electrons), diagonal.panel_electrons)
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
        """The second band has twice the first's."""
        grown = np.arange(len(wavelength_nm)) / len(wavelength_nm)
        return Moments(np.stack([0.3 * grown, -0.2 * grown]), np.stack([0.2 * grown, 0.5 * grown]))


def test_blurs_widen_and_shift_each_band_by_its_moments() -> None:
    """On a wave every band keeps the contrast of its Gaussian, and is seen from the shifted place."""
    x = np.arange(160)
    wave = 1 + 0.5 * np.sin(2 * np.pi * x / 20)
    scene = raster_from_values(
        np.broadcast_to(wave[None, :, None], (40, 160, 6)), CAMERA, name="w", wavelength_nm=np.linspace(400, 1000, 6)
    )
    sweep = Sweep("s", "fine", "x", strip_px=0.0, start_px=-0.5, lines=1)
    block = block_of(scene, sweep, range(1), samples=range(280, 360))
    light = expected_light(scene, block, {SLIT: "3x1", Widening(): "only"})[0] / scene.electrons
    grown = np.arange(6) / 6
    passed = np.exp(-2 * np.pi**2 * 0.2 * grown / 400) * np.sinc(1 / 20) ** 3  # pixel, and linear interpolation
    place = (np.arange(280, 360) - 240)[:, None] + 0.3 * grown
    np.testing.assert_allclose(light, 1 + 0.5 * passed * np.sin(2 * np.pi * place / 20), atol=2e-3)


@dataclass(frozen=True)
class Nudge:
    """Looks or meets the scene beside its place, and changes light."""

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
    """Near rest an aim and a displacement by whole px show the neighbouring lines' samples."""
    scene = grainy()
    sweep = replace(NEAR, strip_px=0.0, start_px=-20.0)
    plain = expected_light(scene, block_of(scene, sweep, range(16), samples=range(310, 330)), {SLIT: "3x1"})
    for do in ("aim", "displaced"):
        moved = expected_light(
            scene, block_of(scene, sweep, range(2, 16), samples=range(307, 327)), {Nudge(do): "only", SLIT: "3x1"}
        )
        np.testing.assert_allclose(moved, plain[:14], rtol=1e-3)


def test_gains_and_changes_run_in_the_order_given() -> None:
    """Adding light before a gain is not adding it after."""
    scene = grainy()
    block = block_of(scene, NEAR, range(3), samples=range(300, 310))
    plain, gain = expected_light(scene, block, {}), np.arange(1, 6, dtype=np.float32)
    first = expected_light(scene, block, {Nudge("gain"): "only", Nudge("change"): "only"})
    last = expected_light(scene, block, {Nudge("change"): "only", Nudge("gain"): "only"})
    np.testing.assert_allclose(first, plain * gain + 7, rtol=1e-6)
    np.testing.assert_allclose(last, (plain + 7) * gain, rtol=1e-6)


def test_unknown_variant_is_refused() -> None:
    """A variant that an effect does not have is refused with those it has."""
    with pytest.raises(SettingsError, match=r"effect slit has no variant 'airy'; choose from \('9x3'"):
        Choice.of({SLIT: "airy"})


def test_choice_leaves_out_what_is_off() -> None:
    """Effects that are off are not part of a choice, and their variant is off."""
    choice = Choice.of({SLIT: "off", SMEAR: "positions"})
    assert (choice.variant("slit"), choice.variant("smear"), len(choice.effects)) == ("off", "positions", 1)

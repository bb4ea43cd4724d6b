"""Dark and white frames: what calibration sees of the effects that are on, it takes out again; the rest stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.lazy import Once
from pipeline.rectify.calibration.calibrate import calibrate
from pipeline.simulator.effects.counting import dark_electrons, dead_elements, hot_electrons
from pipeline.simulator.effects.registry import BY_NAME, EFFECTS, USUAL, effects_on
from pipeline.simulator.effects.sensor import response_gain, stripe_gain
from pipeline.simulator.rig_model import Detector, Rig
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, SceneRaster
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import References

CAMERA = LineCamera(samples=64, bits=16, electrons_per_dn=1.0)  # fine steps: rounding is no part of the figures
RIG = Rig(CAMERA, detector=Detector(response_share=0.05, stripe_share=0.02, temperature_deg_c=45.0))
SWEEP = Sweep("s", "fine", "x", strip_px=900.0, start_px=-1500.0, lines=6)
BANDS = 12


def even_scene(fwhm_nm: float = 2.0) -> RasterScene:
    """An even scene under light with a deep absorption, 40 % as bright as the panel; values are reflectances."""
    nm = np.linspace(740, 784, BANDS)
    panel_electrons = (30_000 * (1 - 0.6 * np.exp(-(((nm - 762) / 5) ** 2)))).astype(np.float32)
    return RasterScene(
        "even",
        "even",
        SceneRaster.of(np.full((20, 20, 1), 0.4, np.float32)),
        Once.of(SceneLight(panel_electrons[None], panel_electrons)),
        np.ones(BANDS, np.float32),
        nm,
        np.full(BANDS, fwhm_nm),
    )


def source_of(*names: str, rig: Rig = RIG) -> SimulatedSource:
    """A source over the even scene with some effects."""
    return SimulatedSource(even_scene(), rig, chosen=effects_on("rotation", *names))


def values_of(source: SimulatedSource, sweep: Sweep = SWEEP) -> np.ndarray:
    """Calibrated lines."""
    raw = source.render(sweep, range(sweep.lines))
    values, _ = calibrate(
        raw, source.references(sweep), saturated_dn=65535 * sweep.binning, position=line_positions(sweep, CAMERA)
    )
    return values


def test_plain_frames_are_the_panel_over_the_dark_level() -> None:
    """Without effects the dark frame is the camera's level, and the white one the panel's light above it."""
    found = source_of().references(SWEEP)
    np.testing.assert_array_equal(found.dark, np.full((64, BANDS), 64, np.float32))
    np.testing.assert_allclose(found.white - 64, np.tile(even_scene().panel_electrons, (64, 1)), rtol=1e-6)
    assert (found.bad, found.flat, found.by_mirror) == (None, None, False)
    assert (found.dark.dtype, found.white.dtype, found.panel.dtype) == (np.float32,) * 3


@pytest.mark.parametrize(
    "names",
    [
        ("dark-current",),
        ("prnu",),
        ("striping",),
        ("response",),
        ("smile",),
        ("vignetting",),
        ("response", "smile"),
        ("dark-current", "prnu", "striping", "response", "smile", "vignetting", "smear", "slit"),
    ],
)
def test_calibration_takes_out_what_it_sees(names: tuple[str, ...]) -> None:
    """An even scene comes back as its reflectance to a rounding, far from rest, whatever spectrograph and detector do.

    The names, then the raw numbers with none of them, are not the same: there was something to take out.
    """
    source = source_of(*names)
    np.testing.assert_allclose(values_of(source), 0.4, atol=2e-4)
    plain = source_of().render(SWEEP, range(6)).astype(int)
    assert np.abs(source.render(SWEEP, range(6)).astype(int) - plain).max() > 20


def test_binned_frames_are_sums() -> None:
    """Frames of n samples are the sums of theirs, and what is left over of the line is dropped."""
    source = source_of("prnu", "smile", "dark-current")
    one, three = source.references(SWEEP), source.references(replace(SWEEP, binning=3))
    for name in ("dark", "white"):
        sums = getattr(one, name)[:63].reshape(21, 3, BANDS).sum(axis=1)
        np.testing.assert_allclose(getattr(three, name), sums, rtol=1e-6)


def test_frames_show_dark_current_and_gains() -> None:
    """The dark frame has the mean dark current, the white frame both gains of every element."""
    found = source_of("dark-current", "prnu", "striping").references(SWEEP)
    np.testing.assert_allclose(found.dark, 64 + dark_electrons(RIG), rtol=1e-6)
    gains = response_gain(RIG, BANDS) * stripe_gain(RIG)
    np.testing.assert_allclose(found.white - found.dark, gains * even_scene().panel_electrons, rtol=1e-4)


def test_defects_are_told_as_bad() -> None:
    """Dead elements show no panel, hot ones are bright in the dark; a sum with one of either is bad."""
    rig = replace(RIG, detector=Detector(dead_share=0.02, hot_share=0.02, hot_e_per_s=2e4))
    found = source_of("defects", rig=rig).references(SWEEP)
    dead, hot = dead_elements(rig, BANDS), hot_electrons(rig, BANDS) > 0
    assert dead.any()
    assert hot.any()
    assert found.bad is not None
    np.testing.assert_array_equal(found.bad, dead | hot)
    np.testing.assert_array_equal(found.dark > 1000, hot)
    np.testing.assert_array_equal(found.white == found.dark, dead)
    binned = source_of("defects", rig=rig).references(replace(SWEEP, binning=4)).bad
    np.testing.assert_array_equal(binned, (dead | hot).reshape(16, 4, BANDS).any(axis=1))
    assert source_of(rig=rig).references(SWEEP).bad is None


def test_a_sound_sensor_has_no_bad_elements() -> None:
    """With defects on and none there, nothing is told as bad."""
    assert source_of("defects").references(SWEEP).bad is None


def test_bad_elements_are_filled_by_calibration() -> None:
    """An even scene seen with dead and hot elements comes back even."""
    rig = replace(RIG, detector=Detector(dead_share=0.02, hot_share=0.02, hot_e_per_s=2e4))
    np.testing.assert_allclose(values_of(source_of("defects", rig=rig)), 0.4, atol=2e-4)


def test_panel_is_stated_in_the_rigs_bands() -> None:
    """Where the panel's values have detail in the spectrum, the response rounds it as it does the light."""
    scene = even_scene()
    scene = replace(scene, panel=(1 - 0.5 * np.exp(-(((scene.wavelength_nm - 762) / 4) ** 2))).astype(np.float32))
    plain, wide = (
        SimulatedSource(scene, RIG, chosen=effects_on(*names)).references(SWEEP).panel for names in ((), ("response",))
    )
    np.testing.assert_array_equal(plain, scene.panel)
    assert wide.min() > plain.min() + 0.05
    np.testing.assert_allclose(wide.mean(), plain.mean(), atol=0.02)


def test_calibration_does_not_know_the_rest() -> None:
    """Effects that it cannot see change no frame."""
    seen = {"dark-current", "defects", "prnu", "striping", "response", "smile", "vignetting"}
    plain = source_of().references(SWEEP)
    for effect in EFFECTS:
        if effect.name in seen:
            continue
        found = source_of(effect.name).references(SWEEP)
        assert isinstance(found, References)
        np.testing.assert_array_equal(found.white, plain.white, err_msg=effect.name)
        np.testing.assert_array_equal(found.dark, plain.dark, err_msg=effect.name)


def test_usual_effects_are_those_of_any_camera_behind_a_mirror() -> None:
    """By default rays, footprint, vignetting and noise are on; names and mapping say the same."""
    assert [effect.name for effect, _ in USUAL.effects] == [
        "rotation",
        "slit",
        "smear",
        "vignetting",
        "shot",
        "read-noise",
    ]
    assert effects_on("shot", "slit").effects == effects_on("slit", "shot").effects
    assert effects_on().effects == ()
    assert {effect for effect, _ in USUAL.effects} <= set(BY_NAME.values())

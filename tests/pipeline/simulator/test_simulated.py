"""The simulated source: lines, noise, saturation, calibration frames, start times of sweeps, and finite settings."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep, line_positions
from spectralzoom.pipeline.signal.calibrate import calibrate
from spectralzoom.pipeline.simulator.effects.counting import SHOT, dark_electrons, dead_elements, hot_electrons
from spectralzoom.pipeline.simulator.effects.spectrometer import PRNU, STRIPING
from spectralzoom.pipeline.simulator.rig_model import Detector, Rig, Sky
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep, sweep_starts
from spectralzoom.pipeline.source import Source
from tests.pipeline.simulator.small_scenes import effects_on, image_scene, made_scene

CAMERA = LineCamera()
SWEEP = Sweep("s", "fine", "x", swath_px=0.0, start_px=-19.5, lines=40)
QUIET = ("rotation", "slit", "smear")


def source_of(values: np.ndarray, camera: LineCamera = CAMERA, **options: object) -> SimulatedSource:
    """Return a source over given values (y, x, band)."""
    scene = image_scene(values, CAMERA, np.linspace(400, 900, values.shape[2]))
    return SimulatedSource(scene, Rig(camera), **options)


def raw_of(source: Source, sweep: Sweep = SWEEP) -> np.ndarray:
    """Return all lines of a sweep, (line, sample, band)."""
    return np.stack([line.data for line in source.lines(sweep)])


def test_lines_do_not_depend_on_the_first_line_read() -> None:
    """Resuming at any line gives the data, numbers and positions of an uninterrupted run."""
    source = source_of(np.random.default_rng(1).random((40, 100, 3)), seed=5)
    whole = list(source.lines(SWEEP))
    for first in (1, 16, 23, 39):
        for line, same in zip(source.lines(SWEEP, first), whole[first:], strict=True):
            np.testing.assert_array_equal(line.data, same.data)
            assert replace(line, data=same.data) == same
    assert list(source.lines(SWEEP, 40)) == []


@pytest.mark.parametrize("exposure_ms", [3.0, 250.0])
def test_sweep_with_its_own_exposure_equals_a_camera_with_it(exposure_ms: float) -> None:
    """Data, times, exposures and references agree, with mirror lag, shot noise and dark current on."""
    values = np.random.default_rng(2).random((40, 100, 3))
    other = replace(CAMERA, exposure_ms=exposure_ms)
    chosen = effects_on(*QUIET, "lag", "shot", "dark-current")
    options: dict[str, Any] = {"seed": 5, "chosen": chosen, "clock": {"s": 7.0}}
    source, told = source_of(values, **options), source_of(values, other, **options)
    own = replace(SWEEP, exposure_ms=exposure_ms)
    for line, same in zip(source.lines(own), told.lines(SWEEP), strict=True):
        np.testing.assert_array_equal(line.data, same.data)
        assert replace(line, data=same.data) == same
        assert line.exposure_ms == exposure_ms
    found, wanted = source.references(own), told.references(SWEEP)
    np.testing.assert_array_equal([found.dark, found.white], [wanted.dark, wanted.white])
    np.testing.assert_array_equal(SimulatedSweep(source, own).time_s, SimulatedSweep(told, SWEEP).time_s)


def test_line_has_its_time_and_position() -> None:
    """Times are mid-exposure, one frame apart; positions are those of the scan, as float32."""
    lines = list(source_of(np.ones((40, 40, 1))).lines(SWEEP))
    np.testing.assert_allclose([line.time_s for line in lines], 0.05 + 0.1 * np.arange(40))
    positions = [(line.mirror_x, line.mirror_y) for line in lines]
    np.testing.assert_array_equal(positions, line_positions(SWEEP, CAMERA).astype(np.float32))
    assert {line.exposure_ms for line in lines} == {100.0}


@pytest.mark.parametrize("step", [1, 4])
@pytest.mark.parametrize("exposure_ms", [50.0, 140.0, 400.0])
def test_calibration_recovers_scene_values(step: int, exposure_ms: float) -> None:
    """Calibrated lines are scene values at any exposure and spacing; saturated samples are marked, not wrong."""
    values = np.random.default_rng(2).uniform(0.2, 1.0, (1, 1, 6)) * np.ones((40, 40, 1))
    source = source_of(values, replace(CAMERA, exposure_ms=exposure_ms), chosen=effects_on(*QUIET))
    sweep = replace(SWEEP, lines=10, step=step)
    out, valid = calibrate(raw_of(source, sweep), source.references(sweep), saturated_dn=4095)
    per_electron = source.scene.white_reference[0] / source.scene.white_reference_electrons[0]
    number = per_electron * CAMERA.electrons_per_dn * 100 / exposure_ms
    if valid.any():
        np.testing.assert_allclose(out[valid], np.broadcast_to(values[0, 0], out.shape)[valid], atol=0.51 * number)
    assert valid.all() == (values.max() * source.scene.electrons[0] * exposure_ms / 100 < CAMERA.full_scale_e)


def test_impossible_settings_are_refused() -> None:
    """The error names the unknown variant."""
    with pytest.raises(SettingsError, match=r"shot has no variant 'rough'"):
        source_of(np.ones((8, 8, 1)), chosen={SHOT: "rough"})


COST = CostModel()


def sweeps_of(*sizes: int, step: int = 1) -> list[Sweep]:
    """Return sweeps with these numbers of lines."""
    return [Sweep(f"sweep {k}", "fine", "x", 0.0, -10.0, lines, step) for k, lines in enumerate(sizes)]


def test_start_times_of_sweeps_match_hand_calculation() -> None:
    """Set-ups take .45 s, one load of up to 1500 positions 1.6 s, and a line 100 ms."""
    starts = sweep_starts(sweeps_of(10, 20, 5), CAMERA, COST)
    assert starts == pytest.approx({"sweep 0": 2.05, "sweep 1": 3.5, "sweep 2": 5.95})
    starts = sweep_starts(sweeps_of(1000, 1000, 5), CAMERA, COST)  # the second begins in the first load
    assert starts == pytest.approx({"sweep 0": 2.05, "sweep 1": 102.5, "sweep 2": 204.55})


@given(st.lists(st.integers(0, 2000), max_size=12), st.integers(1, 4))
def test_sweep_ends_before_the_next_starts(sizes: list[int], step: int) -> None:
    """No sweep starts before the previous one has ended, and the last ends within the plan's seconds."""
    sweeps = sweeps_of(*sizes, step=step)
    starts = [*sweep_starts(sweeps, CAMERA, COST).values(), COST.seconds(sweeps, CAMERA) + 1e-9]
    for sweep, start, following in zip(sweeps, starts, starts[1:], strict=False):
        assert start + CAMERA.scan_seconds(sweep.lines) <= following


def test_light_follows_the_clock() -> None:
    """A sweep that starts an hour later in the morning is brighter; references are those of the survey's start."""
    scene = image_scene(np.full((8, 8, 3), 0.1), CAMERA, [500.0, 600.0, 700.0])
    rig = Rig(CAMERA, sky=Sky(started=datetime(2025, 6, 21, 5, tzinfo=UTC)))
    sweep = Sweep("a", "fine", "x", 0.0, 0.0, 2)
    now = SimulatedSource(scene, rig, chosen=effects_on("rotation", "drift"))
    later = replace(now, clock={"a": 3600.0, "b": 0.0})
    assert (later.started_s(sweep), later.started_s(replace(sweep, name="c")), now.started_s(sweep)) == (3600, 0, 0)
    brighter = later.render(sweep, range(2)).astype(int) - 64
    assert (brighter > 1.1 * (now.render(sweep, range(2)).astype(int) - 64)).all()
    np.testing.assert_array_equal(later.references(sweep).white, now.references(sweep).white)
    assert [line.time_s for line in later.lines(sweep)] == [line.time_s for line in now.lines(sweep)]


# fine steps: rounding does not matter
WHITE_REFERENCE_CAMERA = LineCamera(samples=64, bits=16, electrons_per_dn=1.0)
RIG = Rig(WHITE_REFERENCE_CAMERA, detector=Detector(prnu_std=0.05, striping_std=0.02, dark_e_per_s=1000.0))
WHITE_REFERENCE_SWEEP = Sweep("s", "fine", "x", swath_px=900.0, start_px=-1500.0, lines=6)
BANDS = 12


def even_scene() -> RasterScene:
    """Return an even scene under light with a deep absorption, 40 % of the white reference; values are reflectances."""
    nm = np.linspace(740, 784, BANDS)
    white_reference_electrons = (30_000 * (1 - 0.6 * np.exp(-(((nm - 762) / 5) ** 2)))).astype(np.float32)
    return made_scene(np.full((20, 20, 1), 0.4), white_reference_electrons[None], nm, fwhm_nm=np.full(BANDS, 2.0))


def white_reference_source_of(*names: str, rig: Rig = RIG) -> SimulatedSource:
    """Return a source over the even scene with some effects."""
    return SimulatedSource(even_scene(), rig, chosen=effects_on("rotation", *names))


SEEN = ("dark-current", "prnu", "striping", "response", "smile", "vignetting")  # effects that the frames show


@pytest.mark.parametrize("names", [*((one,) for one in SEEN), ("response", "smile"), (*SEEN, "smear", "slit")])
def test_calibration_removes_effects_that_the_frames_show(names: tuple[str, ...]) -> None:
    """Far from rest an even scene comes back as its reflectance to 2e-4, whatever spectrograph and detector do.

    The raw numbers differ from those without the effects: there was something to remove.
    """
    source = white_reference_source_of(*names)
    raw = source.render(WHITE_REFERENCE_SWEEP, range(6))
    position = line_positions(WHITE_REFERENCE_SWEEP, WHITE_REFERENCE_CAMERA)
    values, _ = calibrate(raw, source.references(WHITE_REFERENCE_SWEEP), saturated_dn=65535, position=position)
    np.testing.assert_allclose(values, 0.4, atol=2e-4)
    plain = white_reference_source_of().render(WHITE_REFERENCE_SWEEP, range(6)).astype(int)
    assert np.abs(raw.astype(int) - plain).max() > 20


def test_frames_show_dark_current_and_gains() -> None:
    """The dark frame has the mean dark current, the white frame both gains of every element, in 32nds of a DN."""
    found = white_reference_source_of("dark-current", "prnu", "striping").references(WHITE_REFERENCE_SWEEP)
    np.testing.assert_allclose(found.dark, 64 + dark_electrons(RIG), rtol=0, atol=1 / 64)
    np.testing.assert_array_equal(found.white * 32 % 1, 0)
    gains = PRNU.gains(RIG, BANDS) * STRIPING.gains(RIG, BANDS)
    np.testing.assert_allclose(found.white - found.dark, gains * even_scene().white_reference_electrons, rtol=1e-4)


def test_defective_elements_are_marked_bad() -> None:
    """Dead elements have white equal to dark, hot ones are bright in the dark."""
    rig = replace(RIG, detector=Detector(dead_fraction=0.02, hot_fraction=0.02, hot_e_per_s=2e4))
    found = white_reference_source_of("defects", rig=rig).references(WHITE_REFERENCE_SWEEP)
    dead, hot = dead_elements(rig, BANDS), hot_electrons(rig, BANDS) > 0
    assert dead.any()
    assert hot.any()
    np.testing.assert_array_equal(found.bad, dead | hot)
    np.testing.assert_array_equal(found.dark > 1000, hot)
    np.testing.assert_array_equal(found.white == found.dark, dead)
    assert white_reference_source_of(rig=rig).references(WHITE_REFERENCE_SWEEP).bad is None


def test_band_response_smooths_the_white_reference() -> None:
    """The response smooths spectral detail of the white reference's values as it does that of the light."""
    scene = even_scene()
    detailed = 1 - 0.5 * np.exp(-(((scene.wavelength_nm - 762) / 4) ** 2))
    scene = replace(scene, white_reference=detailed.astype(np.float32))
    sources = [SimulatedSource(scene, RIG, chosen=effects_on(*names)) for names in ((), ("response",))]
    plain, wide = (source.references(WHITE_REFERENCE_SWEEP).white_reference for source in sources)
    np.testing.assert_array_equal(plain, scene.white_reference)
    assert wide.min() > plain.min() + 0.05
    np.testing.assert_allclose(wide.mean(), plain.mean(), atol=0.02)


class Counted(SimulatedSource):
    """A source whose work is counted in place of time: of a line 1 for each effect that is on, times its step."""

    work: ClassVar = [0.0]

    def render(self, sweep: Sweep, lines: range) -> Any:
        """Count the work of some lines."""
        assert lines.stop <= sweep.lines
        self.work[0] += len(lines) * len(self.chosen) * sweep.step
        return np.zeros(0)


FEW, MANY = effects_on("slit"), effects_on("slit", "shot", "dark-current", "prnu")


@pytest.mark.parametrize(
    ("lines", "steps", "saved"),
    [
        ((40,), (1,), 3 * 40),
        ((400,), (1,), 3 * 400),
        ((100, 3, 1), (1, 1, 1), 3 * 104),
        ((1,), (2,), 3 * 2),
        ((1200, 600), (2, 1), 3 * (1200 * 2 + 600 * 1)),
        ((600, 600, 600), (4, 2, 1), 3 * 600 * 7),
        ((), (), 0),
        ((0, 12), (1, 1), 3 * 12),
    ],
)
def test_saved_time_is_that_of_all_lines(lines: tuple[int, ...], steps: tuple[int, ...], saved: float) -> None:
    """It grows with lines and effects; sweeps with dearer lines count by how many they have."""
    sweeps = [replace(SWEEP, name=str(n), lines=n, step=step) for n, step in zip(lines, steps, strict=True)]
    source = Counted(image_scene(np.ones((4, 4, 1)), CAMERA, np.array([500.0])), Rig(CAMERA), chosen=FEW)
    assert source.saved_seconds(MANY, sweeps, lambda: source.work[0]) == pytest.approx(saved)
    assert source.saved_seconds(FEW, sweeps, lambda: source.work[0]) == 0

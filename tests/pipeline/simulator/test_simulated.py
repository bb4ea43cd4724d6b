"""The simulated source: noise that lines own, its statistics, saturation, references."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from pipeline.errors import SettingsError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.rectify.calibration.calibrate import calibrate
from pipeline.simulator.effects.counting import SHOT
from pipeline.simulator.effects.registry import effects_on
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import Source

CAMERA = LineCamera()
SWEEP = Sweep("s", "fine", "x", strip_px=0.0, start_px=-19.5, lines=40)
QUIET = ("rotation", "slit", "smear")


def source_of(values: np.ndarray, camera: LineCamera = CAMERA, **options: object) -> SimulatedSource:
    """A source that looks at given values (y, x, band)."""
    scene = raster_from_values(values, CAMERA, name="t", wavelength_nm=np.linspace(400, 900, values.shape[2]))
    return SimulatedSource(scene, Rig(camera), **options)  # type: ignore[arg-type]


def raw_of(source: Source, sweep: Sweep = SWEEP, first: int = 0) -> np.ndarray:
    """All lines of a sweep, (line, sample, band)."""
    return np.stack([line.data for line in source.lines(sweep, first)])


def test_lines_do_not_depend_on_where_one_starts() -> None:
    """Resuming at any line gives the lines that an uninterrupted run gives, with numbers and positions."""
    source = source_of(np.random.default_rng(1).random((40, 100, 3)), seed=5)
    whole = list(source.lines(SWEEP))
    for first in (1, 16, 23, 39):
        for line, same in zip(source.lines(SWEEP, first), whole[first:], strict=True):
            np.testing.assert_array_equal(line.data, same.data)
            assert replace(line, data=same.data) == same
    assert list(source.lines(SWEEP, 40)) == []


def test_line_says_when_and_where() -> None:
    """Times are of mid exposure, a frame apart, and positions those of the scan."""
    lines = list(source_of(np.ones((40, 40, 1))).lines(SWEEP))
    np.testing.assert_allclose([line.time_s for line in lines], 0.05 + 0.1 * np.arange(40))
    positions = [(line.mirror_x, line.mirror_y) for line in lines]
    np.testing.assert_array_equal(positions, line_positions(SWEEP, CAMERA))
    assert {line.exposure_ms for line in lines} == {100.0}


def test_noise_is_keyed_by_seed_sweep_and_line() -> None:
    """Another seed, another sweep's name and another line have other noise; the same key has the same."""
    flat = np.ones((40, 40, 1))
    raws = [
        raw_of(source_of(flat, seed=seed), replace(SWEEP, name=name)) for seed, name in ((0, "a"), (1, "a"), (0, "b"))
    ]
    np.testing.assert_array_equal(raws[0], raw_of(source_of(flat), replace(SWEEP, name="a")))
    noise = np.stack([*raws, np.roll(raws[0], 1, axis=0)]).reshape(4, -1).astype(float)
    correlation = np.corrcoef(noise)[0, 1:]
    assert np.abs(correlation).max() < 5 / np.sqrt(noise.shape[1])


@pytest.mark.parametrize("effects", [("shot", "read-noise"), ("shot",), ("read-noise",), ()])
@pytest.mark.parametrize("level", [0.02, 1.0])
def test_noise_has_the_stated_variance(effects: tuple[str, ...], level: float) -> None:
    """Mean and variance of a flat scene are those of shot, read and rounding noise, each only when on."""
    values = np.full((40, 40, 8), level)
    values[0, :4] = 1.0  # sets the scale and lies off the lines used
    source = source_of(values, chosen=effects_on(*QUIET, *effects))
    dn = raw_of(source)[5:].astype(float)
    electrons = level * float(source.scene.electrons[0])
    variance = electrons * ("shot" in effects) + CAMERA.read_noise_e**2 * ("read-noise" in effects)
    expected = variance / CAMERA.electrons_per_dn**2 + (1 / 12 if effects else 0)
    assert dn.mean() == pytest.approx(64 + electrons / 5, abs=5 * np.sqrt(expected / dn.size) if effects else 0.5)
    assert dn.var() == pytest.approx(expected, rel=0.02, abs=1e-9)


def test_binned_lines_are_sums_and_saturate_without_wrapping() -> None:
    """Twice the light that fills the well gives sums at full scale, and dark stays dark beside it."""
    values = np.zeros((40, 640, 2))
    values[:, :320] = 1.0
    source = source_of(values, replace(CAMERA, exposure_ms=400.0), chosen=effects_on(*QUIET))
    raw = raw_of(source, replace(SWEEP, lines=10, step=4, binning=4))
    assert raw.shape == (10, 160, 2)
    assert (raw[:, :79] == 4 * 4095).all()
    assert (raw[:, 81:] == 4 * 64).all()
    assert raw[:, 79:81].min() >= 4 * 64


@pytest.mark.parametrize("binning", [1, 4])
@pytest.mark.parametrize("exposure_ms", [50.0, 140.0, 400.0])
def test_references_give_back_scene_values(binning: int, exposure_ms: float) -> None:
    """Calibrated lines are scene values at any exposure and binning; what saturates is marked, not wrong."""
    values = np.random.default_rng(2).uniform(0.2, 1.0, (1, 1, 6)) * np.ones((40, 40, 1))
    source = source_of(values, replace(CAMERA, exposure_ms=exposure_ms), chosen=effects_on(*QUIET))
    sweep = replace(SWEEP, lines=10, step=binning, binning=binning)
    out, valid = calibrate(raw_of(source, sweep), source.references(sweep), saturated_dn=4095 * binning)
    step = source.scene.panel[0] / source.scene.panel_electrons[0] * CAMERA.electrons_per_dn * 100 / exposure_ms
    if valid.any():
        np.testing.assert_allclose(out[valid], np.broadcast_to(values[0, 0], out.shape)[valid], atol=0.51 * step)
    assert valid.all() == (values.max() * source.scene.electrons[0] * exposure_ms / 100 < CAMERA.full_well_e)


def test_calibration_takes_the_mirror_out() -> None:
    """Far from rest the light falls off and the references say so; calibrated lines are scene values again."""
    values = np.random.default_rng(4).uniform(0.2, 0.6, (1, 1, 6)) * np.ones((40, 40, 1))
    sweep = replace(SWEEP, strip_px=2500.0, start_px=-3000.0, lines=20)
    for effects in (QUIET, (*QUIET, "vignetting")):
        source = source_of(values, chosen=effects_on(*effects))
        references, position = source.references(sweep), line_positions(sweep, CAMERA)
        assert references.by_mirror == ("vignetting" in effects)
        out, valid = calibrate(raw_of(source, sweep), references, saturated_dn=4095, position=position)
        assert valid.all()
        step = source.scene.panel[0] / source.scene.panel_electrons[0] * CAMERA.electrons_per_dn
        np.testing.assert_allclose(out, np.broadcast_to(values[0, 0], out.shape), atol=0.6 * step)


def test_black_scene_reads_dark() -> None:
    """An all-black scene gives the dark level, zeros after calibration, and read noise alone."""
    source = source_of(np.zeros((20, 20, 2)))
    raw = raw_of(source)
    assert raw.mean() == pytest.approx(64, abs=0.1)
    position = line_positions(SWEEP, CAMERA)
    out, valid = calibrate(raw, source.references(SWEEP), saturated_dn=4095, position=position)
    assert valid.all()
    assert abs(out.mean()) < 1e-3 * source.scene.panel[0]


def test_edges_never_wrap() -> None:
    """At a black and white edge light reads the dark level at least, and where the well is full its end."""
    values = np.zeros((40, 640, 1))
    values[:, ::7] = values[::5] = 1.0
    source = source_of(values, replace(CAMERA, exposure_ms=170.0), chosen=effects_on("rotation"))
    raw = raw_of(source)
    assert raw.min() == 64
    assert raw.max() == 4095


def test_lines_come_one_by_one() -> None:
    """The first lines of an endless sweep are there without rendering the rest."""
    endless = replace(SWEEP, lines=2_000)
    assert [line.number for line in islice(source_of(np.ones((8, 8, 1))).lines(endless, 3), 2)] == [3, 4]


def test_source_tells_its_field_and_bands() -> None:
    """The simulated source is a source like the rig."""
    source: Source = source_of(np.ones((8, 9, 3)))
    assert (source.name, source.field_shape, len(source.wavelength_nm)) == ("sim", (8, 9), 3)


def test_impossible_settings_are_refused() -> None:
    """Unknown effects and variants, and sums that overflow uint16 are named."""
    with pytest.raises(SettingsError, match=r"'fog'.*choose from.*slit"):
        effects_on("slit", "fog")
    with pytest.raises(SettingsError, match=r"shot has no variant 'rough'"):
        source_of(np.ones((8, 8, 1)), chosen={SHOT: "rough"})
    with pytest.raises(ShapeError, match="bin at most 16"):
        next(source_of(np.ones((8, 8, 1))).lines(replace(SWEEP, binning=20)))

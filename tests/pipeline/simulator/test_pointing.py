"""Pointing errors of the simulated mirror: drawn once, owned by sweeps and lines, and seen in the light alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.simulator.effects.pointing import PointingErrors
from pipeline.simulator.effects.registry import effects_on
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

CAMERA = LineCamera()
SWEEP = Sweep("s", "fine", "x", strip_px=0.0, start_px=-19.5, lines=40)


def source_of(pointing: PointingErrors | None) -> SimulatedSource:
    """A source without noise over a smooth scene."""
    y, x = np.mgrid[:120, :760]
    values = (1 + 0.3 * np.cos(y / 7) * np.cos(x / 11))[..., None]
    scene = raster_from_values(values, CAMERA, name="t", wavelength_nm=np.array([500.0]))
    return SimulatedSource(scene, Rig(CAMERA), chosen=effects_on("rotation", "slit"), pointing=pointing)


def test_errors_do_not_depend_on_what_else_is_asked():
    """A line's error is its own: any range of lines gives the same, and sweeps and seeds give others."""
    errors = PointingErrors(50, 0.8, seed=3)
    whole = errors.of_lines("a", range(40))
    np.testing.assert_array_equal(errors.of_lines("a", range(17, 23)), whole[17:23])
    assert not np.allclose(errors.of_lines("b", range(40)), whole)
    assert not np.allclose(replace(errors, seed=4).of_lines("a", range(40)), whole)


def test_errors_have_the_stated_size():
    """Offsets are even within their bound in both axes, jitter has its rms about them."""
    errors = PointingErrors(50, 0.8)
    offsets = np.array([errors.offset(f"sweep-{number}") for number in range(400)])
    assert np.abs(offsets).max() <= 50
    assert offsets.std(axis=0) == pytest.approx([50 / np.sqrt(3)] * 2, rel=0.1)
    jitter = errors.of_lines("a", range(2000)) - errors.offset("a")
    assert jitter.std(axis=0) == pytest.approx([0.8, 0.8], rel=0.05)
    assert errors.of_lines("a", range(0)).shape == (0, 2)


def test_mirror_looks_beside_and_reports_the_plan():
    """An offset shows the scene moved by as much, while the lines and the sweep report planned positions."""
    errors = PointingErrors(offset_px=20.0, jitter_px=0.0, seed=1)
    along, scan = errors.offset("s")
    moved = replace(SWEEP, strip_px=float(along), start_px=float(SWEEP.start_px + scan), name="moved")
    seen = SimulatedSweep(source_of(errors), SWEEP)
    np.testing.assert_allclose(seen.read(0, 40), SimulatedSweep(source_of(None), moved).read(0, 40), atol=1)
    np.testing.assert_array_equal(seen.position, line_positions(SWEEP, CAMERA))
    assert next(source_of(errors).lines(SWEEP)).mirror_x == line_positions(SWEEP, CAMERA)[0, 0]


def test_no_errors_change_nothing():
    """Errors of size 0 give the very lines of a source without any, up to rounding."""
    plain, aimed = (
        SimulatedSweep(source_of(pointing), SWEEP).read(0, 40) for pointing in (None, PointingErrors(0.0, 0.0))
    )
    np.testing.assert_allclose(aimed.astype(int), plain.astype(int), atol=1)
    assert (aimed == plain).mean() > 0.999


def test_jitter_moves_lines_one_by_one():
    """With jitter alone every line sees another place, and any one read by itself is the same."""
    source = source_of(PointingErrors(0.0, 0.8, seed=5))
    whole = SimulatedSweep(source, SWEEP).read(0, 40)
    assert not np.array_equal(whole, SimulatedSweep(source_of(None), SWEEP).read(0, 40))
    np.testing.assert_array_equal(SimulatedSweep(source, SWEEP).read(23, 24)[0], whole[23])


@pytest.mark.parametrize("sizes", [(-1.0, 0.8), (50.0, np.nan)])
def test_impossible_errors_are_refused(sizes: tuple[float, float]):
    """Negative and unknown sizes are named."""
    with pytest.raises(SettingsError, match="must be finite and not negative"):
        PointingErrors(*sizes)

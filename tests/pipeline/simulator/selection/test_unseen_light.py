"""Light that few samples show: bounds hold for single bands, beside single sweeps and for every line."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.rig_model import Optics, Rig
from spectralzoom.pipeline.simulator.selection import extrema
from spectralzoom.pipeline.simulator.selection.extrema import find_extrema
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_scene
from tests.pipeline.simulator.bound_trials import OTHERS, trials
from tests.pipeline.simulator.random_cases import Case
from tests.pipeline.simulator.small_scenes import image_scene, leave_slit_unmeasured
from tests.pipeline.simulator.sparse_cases import sparse_case

CAMERA = LineCamera(samples=96)
SHARP = Rig(camera=CAMERA, optics=Optics(stray_fraction=0.0, keystone_px=0.0, smile_nm=0.0, aberration_px=0.0))


def off(case: Case, effect: str) -> list[tuple[float, float, bool]]:
    """Return bound, change, and whether the bound is broken, for an effect that is left out or approximated."""
    return [(one.bound, one.measured, one.is_broken) for one in trials(case, [effect])]


def test_bright_pixel_in_one_band_of_thirty_is_bounded() -> None:
    """One bright pixel in band 5 of 642 x 402 x 30 even ones: diffraction changes over 4 sigma, within its bound."""
    values = np.full((642, 402, 30), 1.0)
    values[321, 200, 5] = 3.0
    rig = replace(SHARP, camera=LineCamera(samples=380))
    scene = image_scene(values, rig.camera, np.linspace(400, 1000, 30))
    found = off(Case(scene, rig, (Sweep("s", "fine", "x", 0.0, -300.0, 600),), None, 0, range(298, 303)), "diffraction")
    assert found[0][1] > 4
    assert not any(broken for _, _, broken in found)


def test_bright_pixels_beside_a_single_sweep_are_bounded() -> None:
    """One line over dark land has bright pixels 6 px beside it: diffraction adds over 0.5 sigma, within its bound."""
    values = np.full((120, 200, 3), 1.0)
    values[50, 60:140] = 40.0
    scene = image_scene(values, CAMERA, np.linspace(400, 1000, 3))
    found = off(Case(scene, SHARP, (Sweep("s", "fine", "x", 0.0, -4.0, 1),), None, 0), "diffraction")
    assert found[0][1] > 0.5
    assert not any(broken for _, _, broken in found)


def test_stray_light_of_few_bright_lines_is_bounded() -> None:
    """Twenty bright lines among 600 dark ones scatter into a dark patch within them, which few sampled lines miss."""
    values = np.full((700, 160, 3), 0.05)
    values[150:170] = 1.0
    values[156:165, 70:74] = 0.0
    rig = replace(SHARP, optics=replace(SHARP.optics, stray_fraction=1e-2, stray_even=1.0))
    scene = image_scene(values, CAMERA, np.linspace(400, 1000, 3))
    case = Case(scene, rig, (Sweep("s", "fine", "x", 0.0, -300.0, 600),), None, 0, range(108, 113))
    ((bound, change, _), *_) = off(case, "stray-light")
    assert change > 3
    assert change <= bound


@pytest.mark.parametrize(
    ("number", "effects", "lines"),
    [
        *((number, OTHERS, None) for number in (17, 27)),  # a single sweep beside a field, and one of few pixels
        (25, (), None),  # a single sweep beside bright pixels
        (54, (), range(0, 120, 4)),  # one bright stripe
        (134, ["path-radiance"], range(156, 158)),  # a dark band among bright ones, under a bright sky
        (164, ["response"], None),  # a field in one band of twelve, beside a single sweep
    ],
)
def test_bounds_hold_for_sparse_light(number: int, effects: Collection[str], lines: range | None) -> None:
    """No bound is broken: a band counts by its own least light, and by its neighbour bands' light beside the sweep.

    Each change is that of one effect, with all others on.
    """
    found = list(trials(replace(sparse_case(number), measured=lines), effects))
    assert found
    assert [one for one in found if one.is_broken] == []


@pytest.mark.parametrize("bands", [3, 12])
def test_extrema_lie_within_the_scene(bands: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The brightest pixel is the last one; tiles end beyond it, where the scene's edge is repeated.

    Strips of one tile, as those of a large scene, give the same places.
    """
    values = np.ones((45, 43, bands))
    values[-1, -1] = 5.0
    scene = image_scene(values, CAMERA, np.linspace(400, 1000, bands))
    places = find_extrema(scene, CAMERA, [Sweep("s", "fine", "x", 0.0, -22.0, 45)], 200)
    assert [44.0, 42.0] in places.tolist()
    assert (places >= 0).all()
    assert (places < scene.shape).all()
    monkeypatch.setattr(extrema, "_STRIP_PX", 1)
    np.testing.assert_array_equal(find_extrema(scene, CAMERA, [Sweep("s", "fine", "x", 0.0, -22.0, 45)], 200), places)


def test_short_sweep_is_bounded_by_the_whole_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three lines have level, span, slope and curvature of sweeps over the whole scene, to 15 %."""
    leave_slit_unmeasured(monkeypatch)
    scene = image_scene(np.random.default_rng(1).uniform(0, 1, (60, 80, 2)), CAMERA, [500.0, 600.0])
    whole = probe_scene(scene, SHARP, [Sweep("s", "fine", "x", 0.0, -32.0, 64)])
    lone = probe_scene(scene, SHARP, [Sweep("s", "fine", "x", 0.0, -2.0, 3)])
    for name in ("level", "span", "slope", "curvature"):
        np.testing.assert_allclose(getattr(lone, name), getattr(whole, name), rtol=0.15)

"""Light that a few looks do not show: bounds hold for bands of their own, beside lone sweeps and for every line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, scene_to_sweep
from pipeline.simulator.effects.probe import (
    Detail,
    Probe,
    lights_within,
    second_difference,
    spectral_differences_between,
    steepest_difference,
)
from pipeline.simulator.rig_model import Optics, Rig
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, to_bands
from pipeline.simulator.selection.adjacency import reached_cells, seen_widely
from pipeline.simulator.selection.sample_views import line_means
from pipeline.simulator.selection.survey_probe import probe_scene
from tests.pipeline.simulator.bound_trials import trials
from tests.pipeline.simulator.made_up_effects import steep_probe
from tests.pipeline.simulator.random_cases import Case
from tests.pipeline.simulator.small_scenes import image_scene, made_scene
from tests.pipeline.simulator.sparse_cases import sparse_case

CAMERA = LineCamera(samples=96)
SHARP = Rig(camera=CAMERA, optics=Optics(stray_fraction=0.0, keystone_px=0.0, smile_nm=0.0, aberration_px=0.0))


def off(case: Case, effect: str) -> list[tuple[float, float, bool]]:
    """Bound and change of an effect that is left out or made cheaper, and whether the bound is broken."""
    return [(one.bound, one.measured, one.is_broken) for one in trials(case, (1,), effect)]


def test_a_pixel_in_one_band_of_thirty_counts() -> None:
    """Of 642 x 402 x 30 even pixels with one bright one, in band 5, diffraction changes sigmas, and is said to."""
    values = np.full((642, 402, 30), 1.0)
    values[321, 200, 5] = 3.0
    rig = replace(SHARP, camera=LineCamera(samples=380))
    scene = image_scene(values, rig.camera, np.linspace(400, 1000, 30))
    found = off(Case(scene, rig, (Sweep("s", "fine", "x", 0.0, -300.0, 600),), None, 0, range(298, 303)), "diffraction")
    assert found[0][1] > 4
    assert not any(broken for _, _, broken in found)


def test_bright_pixels_beside_a_lone_sweep_count() -> None:
    """Of one line over even dark land, bright pixels 6 px beside it, diffraction brings light that is seen."""
    values = np.full((120, 200, 3), 1.0)
    values[50, 60:140] = 40.0
    scene = image_scene(values, CAMERA, np.linspace(400, 1000, 3))
    found = off(Case(scene, SHARP, (Sweep("s", "fine", "x", 0.0, -4.0, 1),), None, 0), "diffraction")
    assert found[0][1] > 0.5
    assert not any(broken for _, _, broken in found)


def test_stray_light_of_few_bright_lines_counts() -> None:
    """Twenty bright lines among 600 dark ones scatter into a dark patch within them: no look at a few lines sees it."""
    values = np.full((700, 160, 3), 0.05)
    values[150:170] = 1.0
    values[156:165, 70:74] = 0.0
    rig = replace(SHARP, optics=replace(SHARP.optics, stray_fraction=1e-2, stray_even=1.0))
    scene = image_scene(values, CAMERA, np.linspace(400, 1000, 3))
    case = Case(scene, rig, (Sweep("s", "fine", "x", 0.0, -300.0, 600),), None, 0, range(108, 113))
    ((bound, change, _), *_) = off(case, "stray-light")
    assert change > 3
    assert change <= bound


@pytest.mark.parametrize("number", [17, 25, 27, 31, 54])
def test_bounds_hold_where_little_is_seen(number: int) -> None:
    """Lone sweeps beside fields and pixels, one bright stripe, scenes of few pixels: no bound of any effect is broken.

    The sizes of the changes are the effects'; the others are on.
    """
    broken = [one for one in trials(sparse_case(number), (1, 2 + number % 7)) if one.is_broken]
    assert broken == []


@pytest.mark.parametrize(
    ("number", "effect", "lines"),
    [
        (134, "path-radiance", range(156, 158)),  # a dark band among bright ones, under a bright sky
        (164, "response", None),  # a field in one band of twelve, beside a lone sweep
    ],
)
def test_bounds_hold_where_bands_differ(number: int, effect: str, lines: range | None) -> None:
    """Each band counts with its own least light, and by what its neighbours bring from beside that it does not."""
    found = list(trials(replace(sparse_case(number), measured=lines), (1, 2 + number % 7), effect))
    assert found
    assert [one for one in found if one.is_broken] == []


def test_least_light_of_a_dark_band_is_that_of_its_group() -> None:
    """Of thirteen even bands, every second of them dark, the dark ones are not taken to be as bright as the others."""
    values = np.ones((60, 80, 13))
    values[..., ::2] = 0.1
    scene = image_scene(values, CAMERA, np.linspace(400, 1000, 13))
    probe = probe_scene(scene, SHARP, [Sweep("s", "fine", "x", 0.0, -32.0, 64)])
    low, high = lights_within(probe, SHARP)
    light = (scene.planes * scene.electrons)[0, 0]
    assert (low <= 1.001 * light).all()
    assert (high >= 0.999 * light).all()


@given(st.integers(2, 6), st.integers(0, 2**32 - 1))
def test_no_spectrum_between_two_is_steeper_than_said(bands: int, seed: int) -> None:
    """Of light that is not looked at only its ends are known: differences over wavelength are within theirs."""
    rng = np.random.default_rng(seed)
    nm = 400 + np.cumsum(rng.uniform(0.1, 20, bands))
    ends = np.sort(rng.uniform(0, 100, (2, bands)), axis=0)
    spectra = np.concatenate([rng.uniform(*ends, (50, bands)), np.where(rng.random((50, bands)) < 0.5, *ends)])
    steep, bent = spectral_differences_between(ends, nm)
    assert (steepest_difference(spectra, nm) <= steep + 1e-9).all()
    assert (np.abs(second_difference(spectra, nm)) <= bent + 1e-9).all()


@pytest.mark.parametrize("components", [None, 2])
def test_wide_spectra_are_those_of_means(components: int | None) -> None:
    """Of planes of bands, or of components: the greatest of means of 8 x 8 px, a block apart, the edge repeated."""
    rng, nm = np.random.default_rng(3), np.array([400.0, 410.0, 440.0, 500.0])
    planes = rng.uniform(0, 1, (24, 16, components or 4)).astype(np.float32)
    scene = made_scene(planes, rng.uniform(100, 900, (components, 4) if components else 4), nm)
    found = seen_widely(scene, DEFAULT_EXPOSURE_MS)
    blocks = to_bands(planes, scene.electrons).reshape(6, 4, 4, 4, 4).mean(axis=(1, 3))
    blocks = np.pad(blocks, [(4, 4), (4, 4), (0, 0)], mode="edge")
    means = (blocks[1:, 1:] + blocks[1:, :-1] + blocks[:-1, 1:] + blocks[:-1, :-1]) / 4
    expected = steepest_difference(means, nm), np.abs(second_difference(means, nm))
    np.testing.assert_allclose(found.spectral, [one.max(axis=(0, 1)) for one in expected], rtol=1e-4)


@given(
    st.integers(20, 300),
    st.integers(20, 300),
    st.floats(-200, 200),
    st.floats(-200, 200),
    st.integers(1, 60),
    st.sampled_from(["x", "y"]),
)
def test_no_pixel_is_nearer_to_a_sweep_than_its_cell(
    rows: int, columns: int, swath: float, start: float, lines: int, along: str
) -> None:
    """What a sweep sees is in cells that are reached; a pixel so many px beside it is in a cell no farther."""
    sweep = Sweep("s", "fine", along, swath, start, lines)
    cells = reached_cells((rows, columns), CAMERA, [sweep])
    y, x = np.mgrid[:rows, :columns] - (np.array([rows, columns])[:, None, None] - 1) / 2
    line, sample = np.moveaxis(scene_to_sweep(sweep, CAMERA, *((y, x) if along == "y" else (x, y))), -1, 0)
    ends = [(line, lines), (sample, CAMERA.samples)]
    apart = np.hypot(*(np.maximum(np.abs(one - (count - 1) / 2) - count / 2, 0) for one, count in ends))
    said = np.repeat(np.repeat(cells.apart_px, cells.cell_px, axis=0), cells.cell_px, axis=1)[:rows, :columns]
    assert (said <= apart * 1.01 + 1)[np.isfinite(said)].all()
    assert not said[apart == 0].any()


def test_means_of_lines_are_those_of_their_pixels() -> None:
    """Of a scene whose rows differ, every row that the sweep's lines meet has its mean among those that are given."""
    values = np.random.default_rng(0).uniform(0, 1, (60, 200, 4))
    scene = image_scene(values, CAMERA, np.linspace(400, 1000, 4))
    sweep = Sweep("s", "fine", "x", 0.0, -9.5, 20)
    found = line_means(scene, CAMERA, [sweep])
    rows = (scene.planes * scene.electrons)[20:40, 52:148].mean(axis=(1, 2))
    assert np.abs(found[:, None] - rows).min(axis=0).max() < 0.01 * rows.mean()


def test_covered_scene_has_nothing_beside() -> None:
    """Sweeps that see all of a scene have the probe of what they see; a lone one is told what lies beside it."""
    scene = image_scene(np.random.default_rng(1).uniform(0, 1, (60, 80, 2)), CAMERA, [500.0, 600.0])
    whole = probe_scene(scene, SHARP, [Sweep("s", "fine", "x", 0.0, -32.0, 64)])
    lone = probe_scene(scene, SHARP, [Sweep("s", "fine", "x", 0.0, -2.0, 3)])
    assert whole.anywhere is None
    assert lone.anywhere is not None
    assert (lone.anywhere >= lone.span).all()


def beside_probe(far: float) -> Probe:
    """An even scene, and detail from 2 px beside the sweeps on."""
    none, some, both = np.zeros(1), np.full(1, far), np.full((2, 1), far)
    details = (Detail(2.0, none, *[np.zeros((2, 1))] * 3), Detail(24.0, some, both, both, both))
    afar = Detail(np.inf, some, both / 8, both / 64, both)
    return replace(steep_probe((0.0, 0.0), span=0.0), beside=details, afar=afar, anywhere=some)


@given(st.floats(0.1, 100.0), st.floats(0.1, 100.0))
def test_a_wider_blur_and_a_longer_way_bring_no_less(first: float, second: float) -> None:
    """What lies beside counts more, the farther a shift or a blur reaches; never more than the greatest difference."""
    least, most = sorted((first, second))
    probe = beside_probe(100.0)
    shifts = [probe.moved(0.0, way) for way in (least, most)]
    assert shifts[0] <= shifts[1] <= 100.0
    assert (shifts[1] > 0) == (most > 2)
    blurs = [probe.blurred(np.full((2, 1), sd**2)) for sd in (least, most)]
    assert blurs[0] <= blurs[1] * 1.6 <= 160.0
    assert blurs[1] > 0 or most < 0.5

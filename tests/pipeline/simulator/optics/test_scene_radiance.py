"""Light of a scene at samples: the same bits for any other samples, reads within the scene's memory, correct mixing."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spectralzoom.pipeline.simulator.optics.kernel_fit import Footprint, Moments, fold
from spectralzoom.pipeline.simulator.optics.rays import RayViews
from spectralzoom.pipeline.simulator.optics.scene_radiance import SceneSampler, _Mixing
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from tests.pipeline.simulator.small_scenes import made_scene
from tests.source_paths import PYTHON_PATH

ROOT = Path(__file__).parents[4]
SHAPE = (23, 37)
COUNT = 100  # samples: some blocks, and a part of one
KINDS = {"one": 1, "few": 3, "materials": 27, "own plane": 2, "own planes": 40}


def scene_of(kind: str, bands: int = 40) -> RasterScene:
    """Return independent random pixels, mixed to bands or with a plane for each band."""
    rng = np.random.default_rng(5)
    components = KINDS[kind]
    planes = rng.uniform(0, 1, (*SHAPE, components))
    if kind == "materials":  # a pixel has few of many materials
        planes *= rng.random((6, 7, components)).repeat(4, axis=0).repeat(6, axis=1)[: SHAPE[0], : SHAPE[1]] < 0.15
    if kind.startswith("own"):
        return made_scene(planes, rng.uniform(1e3, 9e3, components), np.linspace(400, 1000, components))
    return made_scene(planes, rng.uniform(1e3, 9e3, (components, bands)), np.linspace(400, 1000, bands))


def footprint_of(scene: RasterScene) -> Footprint:
    """Return slit and pixel in three boxes, with diffraction whose tails read thinned pixels."""
    waves = np.linspace(0.4, 1.0, len(scene.wavelength_nm)) * np.ones((2, 1))
    shift = np.linspace(-0.2, 0.2, waves.shape[1]) * np.ones((2, 1))
    return fold((2.7, 1.0), (3, 1), 1, Moments(shift, np.full(waves.shape, 0.04), waves))


def views_of(count: int, far: float = 6.0) -> RayViews:
    """Return samples all over the scene and around it, with rotated footprints."""
    rng = np.random.default_rng(8)
    along, scan = rng.uniform(-far, max(SHAPE) + far, (2, count))
    turn = rng.uniform(-0.1, 0.1, count)
    return RayViews(along, scan, np.ones(count), turn, -turn, np.ones(count))


def scan_pass(scene: RasterScene, views: RayViews, *, along_y: bool = False) -> np.ndarray:
    """Return the light (n, band) of one exposure."""
    sampler = SceneSampler(footprint_of(scene), views_of(COUNT))
    return sampler.scan_pass(scene, [views], along_y=along_y, exposure_ratio=1.0)


@pytest.mark.parametrize(("kind", "along_y"), [(kind, bool(number % 2)) for number, kind in enumerate(KINDS)])
def test_light_of_a_sample_does_not_depend_on_the_others(kind: str, along_y: bool) -> None:
    """Each sample has the same bits in any order and any division among calls and threads."""
    scene = scene_of(kind)
    views = views_of(COUNT)
    whole = scan_pass(scene, views, along_y=along_y)
    order = np.random.default_rng(1).permutation(COUNT)
    np.testing.assert_array_equal(scan_pass(scene, views[order], along_y=along_y), whole[order])
    parts = [slice(first, first + 37) for first in range(0, COUNT, 37)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda part: scan_pass(scene, views[part], along_y=along_y), parts))
    np.testing.assert_array_equal(np.concatenate(found), whole)


@pytest.mark.parametrize("kind", KINDS)
def test_lines_along_y_see_the_transposed_scene(kind: str) -> None:
    """A line along y over a scene equals one along x over its transpose."""
    scene = scene_of(kind)
    views = views_of(COUNT)
    turned = made_scene(scene.planes.swapaxes(0, 1), scene.electrons, scene.wavelength_nm)
    np.testing.assert_allclose(scan_pass(scene, views, along_y=True), scan_pass(turned, views), rtol=2e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_memory_behind_the_last_pixel_adds_nothing(kind: str) -> None:
    """A scene that is padded with its edge has the same bits at the last pixels."""
    scene = scene_of(kind)
    wide = np.pad(scene.planes, ((0, 9), (0, 9), (0, 0)), mode="edge")
    corner = views_of(COUNT, 0.0)
    corner = replace(corner, along=SHAPE[1] - 2 + corner.along / 40, scan=SHAPE[0] - 2 + corner.scan / 40)
    sharp = fold((2.7, 1.0), (3, 1), 1, Moments(np.zeros((2, 1)), np.zeros((2, 1))))
    sharp = replace(sharp, between=np.ones((1, len(scene.wavelength_nm))))
    one, other = (
        SceneSampler(sharp, corner).scan_pass(some, [corner], along_y=False, exposure_ratio=1.0)
        for some in (scene, made_scene(wide, scene.electrons, scene.wavelength_nm))
    )
    np.testing.assert_array_equal(one, other)


def far_and_near() -> np.ndarray:
    """Return the light of samples in small scenes, far beside them and at NaN: a block of 64 and a partial one."""
    views = views_of(66, 60.0)
    views = replace(views, scan=np.where(np.arange(66) % 5, views.scan, np.nan))
    found = [scan_pass(scene_of(kind, 3), views, along_y=bool(number % 2)) for number, kind in enumerate(CHECKED_KINDS)]
    return np.concatenate([light.ravel() for light in found])


CHECKED_KINDS = ("few", "materials", "own plane")
CHECKED = """
import sys
import numpy
from tests.pipeline.simulator.optics.test_scene_radiance import far_and_near
numpy.save(sys.argv[1], far_and_near())
"""


def test_loops_stay_within_their_arrays(tmp_path: Path) -> None:
    """Without compilation Python checks every index: the loops end, and give the compiled results."""
    command = [sys.executable, "-c", CHECKED, str(tmp_path / "light.npy")]
    python = {**os.environ, "PYTHONPATH": PYTHON_PATH, "NUMBA_DISABLE_JIT": "1"}
    subprocess.run(command, env=python, cwd=ROOT, check=True)
    np.testing.assert_allclose(np.load(tmp_path / "light.npy"), far_and_near(), rtol=1e-5)


@pytest.mark.parametrize("place", [-1e300, 1e300, np.inf, -np.inf])
@pytest.mark.parametrize("kind", ["few", "materials", "own planes"])
def test_places_far_outside_read_the_edge_of_the_scene(kind: str, place: float) -> None:
    """A sample at any distance from the scene reads no other memory."""
    scene = scene_of(kind)
    views = views_of(4)
    far = scan_pass(scene, replace(views, along=np.full(4, place), scan=np.full(4, 3.0)))
    near = scan_pass(scene, replace(views, along=np.full(4, np.copysign(1e6, place)), scan=np.full(4, 3.0)))
    seen = np.isfinite(far)  # an infinite place has no finite offset from its pixel
    assert seen.all() or np.isinf(place)
    np.testing.assert_allclose(far[seen], near[seen], rtol=1e-6)


@pytest.mark.parametrize(("nodes", "bands"), [(1, 2), (1, 270), (3, 17), (5, 70), (5, 270), (9, 33)])
def test_mixing_does_not_depend_on_the_row(nodes: int, bands: int) -> None:
    """The same components give the same bits in any row, and match the product of the matrices."""
    rng = np.random.default_rng(bands)
    kernels = nodes + 2
    components = 6
    place = np.linspace(0, nodes - 1, bands)
    between = np.stack([np.interp(place, np.arange(nodes), one) for one in np.eye(nodes)])
    fractions = rng.uniform(0, 1, (nodes, kernels)).astype(np.float32)
    spectra = rng.uniform(0, 1, (components, bands)).astype(np.float32)
    one = rng.uniform(0, 1, (kernels, 1, components)).astype(np.float32)
    light = np.full((1031, bands), np.nan, np.float32)
    _Mixing.of(fractions, between, spectra).write(np.repeat(one, len(light), axis=1), light)
    np.testing.assert_array_equal(light, np.broadcast_to(light[:1], light.shape))
    wanted = np.einsum("jk,kc,jb,cb->b", fractions, one[:, 0], between, spectra)
    np.testing.assert_allclose(light[0], wanted, rtol=1e-5)

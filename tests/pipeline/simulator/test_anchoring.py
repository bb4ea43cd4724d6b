"""Anchoring: a fine sweep of any place and length is found on the coarse mosaic, or left unchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Axis, Sweep
from spectralzoom.pipeline.rectify.registration.seams import Anchor, anchor_sweep
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from tests.pipeline.rectify.made_views import broad_sweep
from tests.pipeline.simulator.small_scenes import CommonOffset, effects_on, image_scene, seen_at

CAMERA = LineCamera(samples=96)
GRID = SceneGrid(240, 300, 16)


def textured(seed: int = 0) -> RasterScene:
    """Return a scene of the grid's size with texture of 4 px and more."""
    values = gaussian_filter(np.random.default_rng(seed).normal(size=(GRID.height, GRID.width)), 4.0)
    cube = np.repeat((1 + 0.3 * values / values.std())[..., None], 2, axis=2)
    return image_scene(cube, CAMERA, [600.0, 700.0])


def brightness(scene: RasterScene) -> np.ndarray:
    """Return the image of a coarse pass, without its blur."""
    return np.asarray(seen_at(scene, *np.mgrid[: GRID.height, : GRID.width]).mean(axis=-1))


def anchored(sweep: Sweep, offset: tuple[float, float], *, prior_px: float = 16) -> Anchor:
    """Return the anchor of a sweep whose mirror has an offset, on the mosaic of one without."""
    seen = textured()
    effects = effects_on("rotation", "read-noise")
    source = SimulatedSource(seen, Rig(CAMERA), 0, effects, pointing=CommonOffset(way_px=offset))
    broad = broad_sweep(SimulatedSweep(source, sweep), CAMERA)
    return anchor_sweep(broad, CAMERA, GRID, brightness(seen), prior_px=prior_px)


def sweep_of(along: Axis = "x", *, swath: float = -20.0, start: float = -70.0, lines: int = 140) -> Sweep:
    """Return a fine sweep in the middle of the field."""
    return Sweep("fine", "fine", along, swath, start, lines)


@pytest.mark.parametrize("along", ["x", "y"])
def test_sweep_is_found_on_the_mosaic(along: Axis) -> None:
    """The mirror's offset is found to 0.1 px, with sign and axis, for either orientation."""
    found = anchored(sweep_of(along), (9.3, -6.6))
    assert found.found.status == "found"
    np.testing.assert_allclose(found.shift.offset, [9.3, -6.6], atol=0.1)
    assert (found.shift.drift == 0).all()


@pytest.mark.parametrize("start", [-119.0, 80.0])
def test_short_sweep_at_the_end_of_the_field_is_found(start: float) -> None:
    """The offset is found although the middle of the area that the sweep may have seen lies outside of the sweep."""
    found = anchored(sweep_of(start=start, lines=40), (-8.0, 2.5), prior_px=40)
    assert found.found.status == "found"
    np.testing.assert_allclose(found.shift.offset, [-8.0, 2.5], atol=0.15)


@pytest.mark.parametrize("offset", [(-3.0, 24.0), (3.0, -24.0)], ids=["forward", "backward"])
def test_sweep_without_overlap_with_its_planned_place_is_found(offset: tuple[float, float]) -> None:
    """A sweep of 24 lines with an offset of 24 px is found within the prior of 30 px."""
    found = anchored(sweep_of(start=-10.0, lines=24), offset, prior_px=30)
    np.testing.assert_allclose(found.shift.offset, offset, atol=0.2)


def test_sweep_with_an_offset_beyond_the_prior_is_not_moved() -> None:
    """An offset of 14 px is undecidable with a prior of 6 px."""
    found = anchored(sweep_of(), (14.0, 0.0), prior_px=6)
    assert found.found.status == "undecidable"
    assert (found.shift.offset == 0).all()


def test_sweep_without_common_pixels_with_the_mosaic_is_empty() -> None:
    """Without a usable line, beside the field, or on a mosaic of NaN, there is nothing to compare."""
    source = SimulatedSource(textured(), Rig(CAMERA), 0, effects_on("rotation"))
    broad = broad_sweep(SimulatedSweep(source, sweep_of()), CAMERA)
    blind = replace(broad, usable=np.zeros(140, bool))
    mosaic = brightness(textured())
    assert anchor_sweep(blind, CAMERA, GRID, mosaic, prior_px=8).found.status == "empty"
    assert anchor_sweep(broad, CAMERA, GRID, np.full_like(mosaic, np.nan), prior_px=8).found.status == "empty"
    beside = broad_sweep(SimulatedSweep(source, sweep_of(swath=400.0)), CAMERA)
    assert anchor_sweep(beside, CAMERA, GRID, mosaic, prior_px=8).found.status == "empty"

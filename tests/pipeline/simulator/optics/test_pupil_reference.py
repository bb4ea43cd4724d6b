"""The reference of everything on: its pupil is the closed form's, its light that of the renderer's kernels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pipeline.simulator.optics.rays import pupil_contrast
from tests.pipeline.simulator.pupil_reference import Tile, autocorrelation, distances, random_tile


def few(tile: Tile) -> Tile:
    """Return the tile with one sample to compare: the integral over all waves takes seconds each."""
    return replace(tile, samples=tile.samples[:1])


def test_quadrature_over_chords_is_the_closed_form() -> None:
    """What a round pupil passes of a wave, integrated, is Goodman's formula."""
    u, passed = autocorrelation()
    np.testing.assert_allclose(passed, pupil_contrast(u), atol=1e-6)


def test_kernels_show_what_the_pupil_does() -> None:
    """Of noise, edges, points and beside wide bright fields light is within 0.1 sigma of the integral."""
    assert distances(few(random_tile(23))).max() < 0.1


def test_kernels_show_the_disc_too() -> None:
    """Out of focus as well, 40 m away when focused at infinity."""
    assert distances(few(random_tile(32, math.inf))).max() < 0.1

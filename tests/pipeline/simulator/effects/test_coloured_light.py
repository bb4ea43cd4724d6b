"""What blurs of each band's own make of spectra: edges that are coloured though the scene is grey, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.simulator.effects.blurs import DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.probe import second_difference, steepest_difference
from pipeline.simulator.optics.rays import pupil_contrast
from pipeline.simulator.rig_model import Optics, Rig
from pipeline.simulator.selection.options import light_through
from tests.pipeline.simulator.made_up_effects import even_probe

NM = np.linspace(400.0, 1000.0, 61)
RIG = Rig(optics=Optics(keystone_px=0.6))
BLURS = [DIFFRACTION, KEYSTONE]


def grey_probe(slope: float, curvature: float):
    """A scene alike in all bands, as steep and curved as this along both axes."""
    bands = np.ones(len(NM))
    both = np.ones((2, len(NM)))
    return even_probe(
        unit="dn",
        wavelength_nm=NM,
        level=bands,
        spread=bands,
        span=bands,
        spectral_slope=0 * bands,
        spectral_curvature=0 * bands,
        slope=slope * both,
        curvature=curvature * both,
    )


@pytest.mark.parametrize("px", [3.0, 8.0, 30.0])
def test_waves_are_no_more_coloured_than_said(px: float):
    """A grey wave through a pupil and shifts that differ from band to band, in closed form; within 6 times."""
    k, x = 2 * np.pi / px, np.linspace(0, px, 200)
    blurs = [blur.moments(RIG, NM, blur.variants[0]) for blur in BLURS]
    shift, waves = sum(one.shift[0] for one in blurs), blurs[0].waves[0]
    light = np.sin(k * (x[:, None] + shift)) * pupil_contrast(waves / px)
    said = light_through(grey_probe(k, k**2), RIG, BLURS)
    slope, bend = steepest_difference(light, NM).max(axis=0), np.abs(second_difference(light, NM)).max(axis=0)
    assert (slope <= said.spectral_slope * (1 + 1e-9)).all()
    assert (bend <= said.spectral_curvature * (1 + 1e-9)).all()
    assert said.spectral_slope.max() <= 6 * slope.max()


def test_flat_scenes_and_even_blurs_colour_nothing():
    """Without a slope there is no edge, without blurs no colour; one band has no spectrum."""
    assert not light_through(grey_probe(0.0, 0.0), RIG, BLURS).spectral_slope.any()
    probe = grey_probe(1.0, 1.0)
    assert light_through(probe, RIG, []) is probe
    assert light_through(even_probe(), RIG, BLURS).spectral_slope.max() == even_probe().spectral_slope.max()

"""The trade-offs of segmenting: what their errors are on a small farm with weights that nothing was learned by."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from flows.tradeoff import farm as tradeoff_farm
from flows.tradeoff.entries import find_tradeoffs
from flows.tradeoff.farm import AGREEMENT, BAND_COUNT, BANDS, PRECISION, PRECISIONS, SEATS, SHARES, Farm
from models.network.segmenter import Segmenter, SegmenterConfig
from models.network.spectral import Normalisation, SpectralBasis
from models.weights.files import Weights
from pipeline.simulator.scenes.farm.farm_scene import farm_scene

SHAPE = (128, 192)


@pytest.fixture(scope="module")
def farm() -> Farm:
    """A small farm, looked at coarsely and finely."""
    scene = farm_scene(0, shape=SHAPE)
    sizes = {"patch": 16, "factor": 4, "width": 8, "coarse_width": 8, "dim": 16, "layers": 1, "heads": 2}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = Segmenter(SegmenterConfig(len(scene.class_names), **sizes)).eval()
        for parameter in model.parameters():
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.3)
    flat = Normalisation(np.full(24, 0.3, np.float32), np.full(24, 0.1, np.float32), np.eye(24, dtype=np.float32))
    basis = SpectralBasis.spanning(scene.wavelength_nm)
    weights = Weights(model, basis, flat, scene.class_names, np.asarray(scene.class_colours))
    kept: list[bool] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tradeoff_farm, "keep_freed_memory", lambda: kept.append(True))
        patch.setattr(tradeoff_farm, "load_weights", lambda path: weights)
        patch.setattr(tradeoff_farm, "SEGMENT_SHAPE", SHAPE)
        prepared: Farm = SEATS.prepare(0)
    assert kept == [True]  # as surveys do
    return prepared


def errors(farm: Farm, number: int) -> dict[object, float]:
    """Disagreement of every setting of one knob with the map of everything."""
    entry = AGREEMENT[number]
    return {setting: entry.judge(farm, setting, entry.run(farm, setting)) for setting in entry.settings}


def test_the_stage_has_its_knobs_against_labels_and_against_everything():
    """Seats, precision and bands are registered with both errors, the reference's setting first."""
    assert find_tradeoffs("segment") == (SEATS, PRECISION, BAND_COUNT, *AGREEMENT)
    assert (SHARES[0], PRECISIONS[0], BANDS[0]) == (1.0, "float32", 270.0)


def test_every_seat_is_the_reference_and_fewer_are_not(farm: Farm):
    """Nothing differs with all seats; with none the map differs most."""
    found = errors(farm, 0)
    assert found[1.0] == 0
    assert 0 < found[0.35] < found[0.0] == max(found.values())


def test_half_precision_agrees_nearly_everywhere(farm: Farm):
    """At most half a percent of the classes change."""
    found = errors(farm, 1)
    assert found["float32"] == 0
    assert 0 <= found["bfloat16"] <= 0.005


def test_all_bands_are_the_reference_and_few_differ_most(farm: Farm):
    """The same pixels in fewer bands change more of the map."""
    found = errors(farm, 2)
    assert found[270.0] == 0
    assert found[90.0] < found[4.0]


def test_levels_are_those_of_the_reference_and_of_noise(farm: Farm):
    """The map of everything captured again differs, and both errs against the labels as they are."""
    (noise,) = AGREEMENT[0].levels(farm)
    everything, again = SEATS.levels(farm)
    assert 0 < noise.error < 0.5
    assert everything.error == SEATS.judge(farm, 1.0, SEATS.run(farm, 1.0))
    assert 0 < again.error < 1

"""The entries of the trade-offs: their errors are those known of rectification, planning, segmenting and storing."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from flows.tradeoff import farm as tradeoff_farm
from flows.tradeoff.entries import find_tradeoffs, measure_tradeoff
from flows.tradeoff.farm import (
    AGREEMENT,
    BAND_COUNT,
    BANDS,
    BITS,
    BUDGET,
    CODEC,
    PRECISION,
    PRECISIONS,
    SEATS,
    SHARES,
    SIZE,
    Farm,
)
from flows.tradeoff.rectify import (
    LINE_MODEL,
    OVERLAP,
    PERIODS_PX,
    RESAMPLE,
    SCAN_STEP,
    TIE_SPACING,
    Seams,
    draw_waves,
    noise_levels,
)
from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig
from models.network.spectral import Normalisation, SpectralBasis
from models.weights.files import Weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import cheapest_full
from pipeline.rectify.registration.shifts import PairShift
from pipeline.simulator.scenes.farm.farm_scene import farm_scene


def test_waves_and_noise_levels_are_what_they_claim():
    """Periods of 4 to 40 px, the same for a seed; a tenth of shot and read noise, and half a step."""
    waves = draw_waves(3, 64, PERIODS_PX)
    period = 1 / np.hypot(*waves.frequency.T)
    assert period.min() >= 4
    assert period.max() <= 40
    np.testing.assert_array_equal(waves.at(np.ones((1, 2))), draw_waves(3, 64, PERIODS_PX).at(np.ones((1, 2))))
    camera = LineCamera()
    electrons = camera.full_well_e / 2
    noise, step = (level.error * 0.2 * electrons for level in noise_levels(camera))
    assert 10 * noise == pytest.approx(math.sqrt(electrons + 20**2))
    assert step == pytest.approx(2.5)


def test_errors_of_rectification_are_those_known():
    """Kernels by their taps (erratum E10), line models of a large field, ties with the square of their distance."""
    result = measure_tradeoff(RESAMPLE, repeats=1)
    nearest, bilinear, cubic = (point.error for point in result.points)
    assert (nearest, bilinear, cubic) == pytest.approx((0.24, 0.093, 0.029), rel=0.03)
    errors = [point.error for point in measure_tradeoff(LINE_MODEL, repeats=1).points]
    assert errors[:4] == pytest.approx([307, 185, 183, 12.2], rel=0.01)
    assert errors[4] == 0
    errors = {point.setting: point.error for point in measure_tradeoff(TIE_SPACING, repeats=1).points}
    assert errors[1] < 1e-9
    assert errors[16] == pytest.approx(1.61e-3, rel=0.02)
    assert errors[64] / errors[16] == pytest.approx(16, rel=0.1)


def test_wider_overlaps_find_shifts_better():
    """All find them to 0.1 px, the widest three times better; where most are not decided there is no error."""
    errors = [point.error for point in measure_tradeoff(OVERLAP, repeats=1).points]
    assert max(errors) < 0.1
    assert errors[-1] < errors[0] / 3
    state = Seams([], np.zeros((3, 2)))
    unknown = np.full(2, np.nan)
    undecided, decided = PairShift("undecidable", unknown, unknown), PairShift("found", np.array([0.0, 0.3]), unknown)
    assert OVERLAP.judge(state, 16, [undecided, decided, undecided]) == np.inf
    assert OVERLAP.judge(state, 16, [decided, decided, undecided]) == pytest.approx(0.3)


def test_fewer_lines_take_less_time_and_show_less():
    """Beyond the slit's width the error grows with the scan's step, while the modelled seconds shrink."""
    result = measure_tradeoff(SCAN_STEP, repeats=1)
    seconds, errors = [point.price_s for point in result.points], [point.error for point in result.points]
    assert seconds == sorted(seconds, reverse=True)
    assert errors[1:] == sorted(errors[1:])
    noise, tenth = (level.error for level in result.levels)
    assert (errors[0], 10 * tenth) == pytest.approx((noise, noise), rel=0.1)
    assert noise == pytest.approx(0.045, rel=0.1)


def test_a_larger_budget_takes_more_seconds_and_draws_a_better_map(monkeypatch):
    """Coarse and fine seconds together keep the budget and nearly use it up; the error is that of the class map."""
    monkeypatch.setattr(tradeoff_farm, "BUDGET_SHAPE", (256, 640))
    half, whole = measure_tradeoff(replace(BUDGET, settings=(0.6, 1.0)), repeats=1).points
    *_, full_s = cheapest_full(SceneGrid(256, 640, 16, 4), LineCamera(), CostModel())
    assert 0.55 < half.price_s / full_s <= 0.6
    assert 0.95 < whole.price_s / full_s <= 1.0
    assert 0 < whole.error < half.error < 0.5


def test_fewer_bits_and_codecs_are_smaller(monkeypatch):
    """At eleven kept bits hardly a class changes, at three many; every codec stores a sample in under two bytes."""
    monkeypatch.setattr(tradeoff_farm, "STORE_SHAPE", (128, 192))
    state = BITS.prepare(0)
    judged = {kept: BITS.judge(state, kept, BITS.run(state, kept)) for kept in (23.0, 11.0, 3.0)}
    sizes = {kept: SIZE.judge(state, kept, SIZE.run(state, kept)) for kept in judged}
    assert judged[23.0] == 0
    assert judged[11.0] < 2e-3 < judged[3.0]
    assert sizes[3.0] < sizes[11.0] < sizes[23.0]
    monkeypatch.setattr(tradeoff_farm, "STORE_SHAPE", (128, 192))
    state = CODEC.prepare(0)
    sizes = {codec: CODEC.judge(state, codec, CODEC.run(state, codec)) for codec in CODEC.settings}
    assert all(size < 2 for codec, size in sizes.items() if codec != "none")
    assert sizes["zstd-3"] < sizes["lz4-5"] < sizes["none"]


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


def test_knobs_and_levels_of_segmenting(farm: Farm):
    """Seats, precision and bands with both errors; the map of everything captured again differs."""
    assert find_tradeoffs("segment") == (SEATS, PRECISION, BAND_COUNT, *AGREEMENT)
    assert (SHARES[0], PRECISIONS[0], BANDS[0]) == (1.0, "float32", 270.0)
    (noise,) = AGREEMENT[0].levels(farm)
    everything, again = SEATS.levels(farm)
    assert 0 < noise.error < 0.5
    assert everything.error == SEATS.judge(farm, 1.0, SEATS.run(farm, 1.0))
    assert 0 < again.error < 1


def test_the_first_setting_is_the_reference_and_less_differs(farm: Farm):
    """Nothing differs with all seats, floats or bands; with no seat most does, by half precision 0.5 % at most."""
    seats, precision, bands = (errors(farm, number) for number in range(3))
    assert seats[1.0] == precision["float32"] == bands[270.0] == 0
    assert 0 < seats[0.35] < seats[0.0] == max(seats.values())
    assert 0 <= precision["bfloat16"] <= 0.005
    assert bands[90.0] < bands[4.0]

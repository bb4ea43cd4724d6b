"""The trade-offs of the simulator: errors keep their bounds, rank as they must and agree with rays and laws."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from flows.tradeoff import simulate as tradeoff_simulate
from flows.tradeoff import simulate_light as tradeoff_simulate_light
from flows.tradeoff.command import print_tradeoff, tradeoff_figure
from flows.tradeoff.entries import Level, Point, Tradeoff, find_tradeoffs, mark_pareto, measure_tradeoff
from flows.tradeoff.simulate import (
    ALL_CHEAP,
    DIM_NOISE,
    EXACT,
    FOOTPRINT,
    NOISE,
    TOLERANCE,
    TOLERANCES,
    Against,
    FarmLines,
    Seen,
    law_of_numbers,
    look_at_lines,
    with_variant,
)
from flows.tradeoff.simulate_light import BAND_COUNT, EACH, GROUP_COUNT, SUPERSAMPLING, InBands, Shared, some_bands
from pipeline.geometry.camera import LineCamera
from pipeline.simulator.effects.blurs import KEYSTONE
from pipeline.simulator.effects.counting import SHOT
from pipeline.simulator.effects.effect import OFF
from pipeline.simulator.effects.line import SLIT
from pipeline.simulator.rig_model import Rig


@pytest.fixture(scope="module")
def lines() -> FarmLines:
    """A line at each end and in the middle of a small farm's sweep."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tradeoff_simulate, "SHAPE", (96, 640))
        patch.setattr(tradeoff_simulate, "LINES", 1)
        return look_at_lines(0)


def seen_by(lines: FarmLines) -> Against:
    """The exact light of the footprint."""
    return Against.of(lines.light(lines.footprint), lines.rig)


def errors(entry: Tradeoff, state: object) -> dict[object, float]:
    """Error of every setting."""
    return {setting: entry.judge(state, setting, entry.run(state, setting)) for setting in entry.settings}


def test_the_stage_has_its_knobs_the_exact_setting_first():
    """Tolerance, slit, groups, bands, supersampling and noise; a variant that an effect gains is measured unasked."""
    found = find_tradeoffs("simulate")
    assert set(found) == {TOLERANCE, FOOTPRINT, GROUP_COUNT, BAND_COUNT, SUPERSAMPLING, NOISE, DIM_NOISE}
    assert [entry.settings[0] for entry in (TOLERANCE, FOOTPRINT, GROUP_COUNT)] == [EXACT, SLIT.variants[0], EACH]
    assert FOOTPRINT.settings == (*SLIT.variants, OFF)
    assert NOISE.settings == (*SHOT.variants, OFF)
    assert set(SLIT.variants) < set(SUPERSAMPLING.settings)


def test_what_is_chosen_keeps_its_bound_and_the_bound_its_tolerance(lines: FarmLines, monkeypatch):
    """Exact errs by nothing, and every tolerance by no more than it says."""
    monkeypatch.setattr(tradeoff_simulate, "look_at_lines", lambda seed: lines)
    state = TOLERANCE.prepare(0)
    found = errors(TOLERANCE, state)
    bounds = {setting: state.chosen[setting].bound for setting in TOLERANCE.settings}
    assert found[EXACT] == bounds[EXACT] == 0
    assert all(found[one] <= bounds[one] <= one for one in TOLERANCES)
    assert found[ALL_CHEAP] <= bounds[ALL_CHEAP]
    assert found[TOLERANCES[-1]] > 0


def test_figures_by_hand():
    """Of a change of 30 electrons, and of keystone shared by two, one, or as many groups as bands."""
    against = Against(np.array([[[400.0, 1e4]]], np.float32), np.array([[[30.0, 100.0]]], np.float32), 5.0)
    light = against.exact + np.array([30.0, 0.0], np.float32)
    assert (against.greatest(light), against.greatest_dn(light)) == pytest.approx((1.0, 6.0))
    assert against.rms(light) == pytest.approx(math.sqrt(0.5))
    assert [level.error for level in against.levels()] == pytest.approx([0.1, 2.5 / 30])
    rig, nm = Rig(), np.linspace(400, 1000, 270)
    k = rig.optics.keystone_px
    two = Shared(KEYSTONE, 2).moments(rig, nm, "linear").shift[0]
    assert (two[0], two[-1]) == pytest.approx((-k / 4, k / 4), rel=0.01)
    assert len(np.unique(two)) == 2
    assert Shared(KEYSTONE, 1).moments(rig, nm, "linear").shift == pytest.approx(0)
    own = KEYSTONE.moments(rig, nm, "linear").shift
    np.testing.assert_allclose(Shared(KEYSTONE, 270).moments(rig, nm, "linear").shift, own)


def test_finer_boxes_are_nearer_to_the_footprint(lines: FarmLines):
    """The finest is the reference, a mere ray errs most; an effect changed or left out leaves the others' order."""
    assert list(with_variant(lines.footprint, SLIT, "1x1")) == list(lines.footprint)
    assert SLIT not in with_variant(lines.footprint, SLIT, OFF)
    found = errors(FOOTPRINT, Seen(lines, seen_by(lines)))
    assert found[SLIT.variants[0]] == 0
    assert found[OFF] == max(found.values()) > 10 * found[SLIT.variants[1]]


def test_more_bands_and_more_groups_err_less(lines: FarmLines):
    """All are the reference itself; bands taken come out as they went in, ends among them."""
    fewer = some_bands(lines, 30)
    assert fewer.bands[[0, -1]].tolist() == [0, 269]
    np.testing.assert_array_equal(fewer.scene.electrons, lines.scene.electrons[:, fewer.bands])
    np.testing.assert_allclose(fewer.spline[:, fewer.bands], np.eye(30), atol=1e-6)
    against = seen_by(lines)
    groups, bands = (
        errors(GROUP_COUNT, Seen(lines, against)),
        errors(BAND_COUNT, InBands(lines, against, {one: some_bands(lines, one) for one in BAND_COUNT.settings})),
    )
    assert groups[EACH] == bands[270] == 0
    assert 0 < groups[6] < groups[1]
    assert 0 < bands[135] < bands[60] < bands[15]


def test_rays_come_to_the_boxes_as_they_get_more(lines: FarmLines, monkeypatch):
    """The finest boxes are where sums of rays go to: nine times nearer at least with eight times as many per px."""
    monkeypatch.setattr(tradeoff_simulate_light, "look_at_lines", lambda seed: lines)
    state = SUPERSAMPLING.prepare(0)
    few, many = (
        SUPERSAMPLING.judge(state, words, SUPERSAMPLING.run(state, words)) for words in ("1 ray/px", "8 rays/px")
    )
    assert few > 9 * many > 0


@pytest.mark.parametrize("electrons", [0.5, 30.0, 9000.0])
def test_the_law_of_numbers_has_the_moments_of_its_parts(electrons: float):
    """It sums to 1, its mean is the light's and its variance that of counts, amplifier and rounding."""
    camera = LineCamera()
    law, dn = law_of_numbers(electrons, Rig(camera)), np.arange(camera.full_scale_dn + 1)
    mean = law @ dn
    assert law.sum() == pytest.approx(1)
    assert mean == pytest.approx(camera.dark_dn + electrons / camera.electrons_per_dn)
    wanted = (electrons + camera.read_noise_e**2) / camera.electrons_per_dn**2 + 1 / 12
    assert law @ (dn - mean) ** 2 == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("entry", [NOISE, DIM_NOISE])
def test_cheap_noise_is_told_from_exact_noise_by_no_test_and_none_at_all_by_every_one(entry, lines, monkeypatch):
    """Variants of the shot noise vary from the law as chance does, keep mean and variance; no noise keeps the mean."""
    monkeypatch.setattr(tradeoff_simulate, "look_at_lines", lambda seed: lines)
    monkeypatch.setattr(tradeoff_simulate, "DRAWN_LINES", 100)
    state = entry.prepare(0)
    (chance,) = entry.levels(state)
    for variant in SHOT.variants:
        made = entry.run(state, variant)
        assert entry.judge(state, variant, made) < chance.error
        assert entry.beside["p of χ²"](state, variant, made) > 1e-3
        assert entry.beside["variance"](state, variant, made) < 0.03
        assert entry.beside["bound"](state, variant, made) < chance.error
    none = entry.run(state, OFF)
    assert 2 * chance.error < entry.judge(state, OFF, none) < entry.beside["bound"](state, OFF, none) + chance.error
    assert entry.beside["p of χ²"](state, OFF, none) < 1e-6
    assert entry.beside["mean [σ]"](state, OFF, none) < 0.03  # noqa: RUF001


SERIES: Tradeoff[None, float] = Tradeoff(
    stage="series",
    knob="terms",
    error="remainder",
    unit="sum",
    reference="0",
    settings=(0.5, 0.25),
    prepare=lambda seed: None,
    run=lambda state, setting: float(setting),
    judge=lambda state, setting, out: out,
    work=lambda state, setting: 1.0,
    beside={"squared": lambda state, setting, out: out**2, "none": lambda state, setting, out: math.nan},
)


def test_further_figures_are_in_json_and_in_the_table():
    """They stand beside the error, whole on a narrow terminal; what is no number becomes null."""
    result = measure_tradeoff(SERIES, repeats=1)
    found = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert [point["beside"] for point in found["points"]] == [
        {"squared": 0.25, "none": None},
        {"squared": 0.0625, "none": None},
    ]
    console = Console(file=io.StringIO(), width=80)
    print_tradeoff(replace(result, points=result.points[1:]), console)
    words = console.file.getvalue()  # type: ignore[attr-defined]
    assert "squared" in words
    assert "0.062" in words


def test_settings_that_hide_each_other_share_a_name_and_near_levels_have_names_apart():
    """Two tolerances that choose the same are one mark; a tenth of the noise and half a step lie close."""
    told = ((0.01, 1e-3, 4e-8), (0.03, 1e-3, 4e-8), (1.0, 0.3, 1e-8))
    points = mark_pareto([Point(one, error, 1.0, cpu, cpu, cpu, cpu, 1.0, None) for one, error, cpu in told])
    levels = (Level("a tenth", 0.1), Level("half a step", 0.095))
    figure = tradeoff_figure([replace(measure_tradeoff(SERIES, repeats=1), points=points, levels=levels)])
    figure.draw_without_rendering()
    texts = {text.get_text(): text for text in figure.axes[0].texts}
    assert set(texts) == {"0.01, 0.03", "1.0", "a tenth", "half a step"}
    upper, lower = (texts[level.name].get_window_extent() for level in levels)
    assert not upper.overlaps(lower)

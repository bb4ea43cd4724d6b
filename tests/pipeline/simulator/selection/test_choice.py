"""The choice of effects to compute: laws, cases worked by hand, selection by name, and the manifest."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.simulator.effects.counting import READ_NOISE
from spectralzoom.pipeline.simulator.effects.lighting import CLOUD
from spectralzoom.pipeline.simulator.rig_model import Rig, Sky
from spectralzoom.pipeline.simulator.selection.choice import Decision, decide, list_effects, named_effects, sum_up
from spectralzoom.pipeline.simulator.selection.options import SAFETY, list_options
from tests.pipeline.simulator.made_up_effects import RIG, Brightening, MadeUp, Shift, even_probe

PROBE = even_probe()
TOLERANCES = st.floats(0, 5) | st.just(math.inf)
_BOUNDS = st.sampled_from((0.0, 1e-9, 0.01, 0.1, 0.3, 1.0, math.inf)) | st.floats(1e-4, 3)
_COSTS = st.sampled_from((0.0, 0.3, 1.0, 7.7, 24.7)) | st.floats(0, 30)


@st.composite
def made_up(draw: st.DrawFn, most: int = 6) -> list[MadeUp]:
    """Draw some effects, perhaps with quantisation, each with up to three variants."""
    names = draw(st.lists(st.sampled_from([*"abcdefgh", "quantisation"]), unique=True, max_size=most))
    effects = []
    for name in names:
        cheap = [(f"v{i}", draw(_BOUNDS), draw(_COSTS)) for i in range(draw(st.integers(0, 2)))]
        effects.append(MadeUp(name, draw(_BOUNDS), (("exact", 0.0, draw(_COSTS)), *cheap)))
    return effects


def variants(decision: Decision) -> dict[str, str]:
    """Return the chosen option of every effect by name."""
    return {one.name: one.option.variant for one in decision.taken}


def cost_of(decision: Decision) -> float:
    """Return cost per px and band of what is on [ns]."""
    return math.fsum(one.option.cost_ns for one in decision.taken)


@given(made_up(), TOLERANCES)
def test_errors_never_exceed_the_tolerance(effects: list[MadeUp], tolerance: float):
    """The bounds of effects that are left out, with safety, sum to at most the tolerance."""
    decision = decide(PROBE, RIG, effects, tolerance)
    assert decision.error <= tolerance
    assert decision.error == math.fsum(one.option.error for one in decision.taken)


@given(made_up(), TOLERANCES, TOLERANCES)
def test_larger_tolerance_never_costs_more(effects: list[MadeUp], one: float, other: float):
    """The cost at a larger tolerance is at most that at a smaller one, which is at most that of tolerance 0."""
    exact, strict, loose = (decide(PROBE, RIG, effects, tolerance) for tolerance in sorted((0.0, one, other)))
    assert cost_of(loose) <= cost_of(strict) * (1 + 1e-12)
    assert cost_of(strict) <= cost_of(exact) * (1 + 1e-12)


@given(made_up(), TOLERANCES, st.randoms(use_true_random=False))
def test_decision_does_not_depend_on_the_order_of_effects(effects: list[MadeUp], tolerance: float, random):
    """Effects are distinguished by their names only; the decision keeps the order of the chain."""
    mixed = random.sample(effects, len(effects))
    first, second = (decide(PROBE, RIG, order, tolerance) for order in (effects, mixed))
    assert variants(first) == variants(second)
    assert [one.name for one in second.taken] == [effect.name for effect in mixed]


@given(made_up())
def test_tolerance_of_zero_makes_every_effect_of_the_rig_exact(effects: list[MadeUp]):
    """Only effects that the rig lacks are off."""
    decision = decide(PROBE, RIG, effects, 0.0)
    for one in decision.taken:
        has = one.menu.effect.left_out > 0 or one.name == "quantisation"
        assert one.option.variant == ("exact" if has else "off")
    assert decision.error == 0
    assert decision.chosen == decision.exact


@given(made_up())
def test_infinite_tolerance_leaves_only_quantisation_on(effects: list[MadeUp]):
    """Every effect that may be off is off."""
    on = [one.name for one in decide(PROBE, RIG, effects, math.inf).taken if one.is_on]
    assert on == [effect.name for effect in effects if effect.name == "quantisation"]


@given(made_up(), TOLERANCES, st.data())
def test_selection_by_name_switches_on_only_named_effects(effects: list[MadeUp], tolerance: float, data):
    """Named effects of the rig are on, in a variant within the tolerance; the others are off, except quantisation."""
    known = [effect.name for effect in effects]
    named = data.draw(st.lists(st.sampled_from(known), min_size=1, unique=True)) if known else ["all"]
    decision = decide(PROBE, RIG, effects, tolerance, ", ".join(named))
    for one in decision.taken:
        assert one.is_on == (one.name == "quantisation" or (one.name in named and one.menu.effect.left_out > 0))
    assert math.fsum(one.option.error for one in decision.taken if one.is_on) <= tolerance


@given(made_up(5), st.floats(1e-3, 5))
def test_decision_saves_at_least_half_of_the_possible_cost(effects: list[MadeUp], tolerance: float):
    """The rule's worst case is compared with an enumeration of all options."""
    decision = decide(PROBE, RIG, effects, tolerance)
    menus = list_options(PROBE, RIG, effects)
    ways = [menu.variants if menu.name == "quantisation" else (*menu.variants, menu.off) for menu in menus]
    fitting = (way for way in itertools.product(*ways) if math.fsum(one.error for one in way) <= tolerance)
    least = min(math.fsum(one.cost_ns for one in way) for way in fitting)
    best = math.fsum(menu.exact.cost_ns for menu in menus) - least
    saved = math.fsum(one.menu.exact.cost_ns for one in decision.taken) - cost_of(decision)
    assert saved >= best / 2 - 1e-9


ENDLESS = [MadeUp(name, math.inf, (("exact", 0.0, 9.0), ("cheap", math.inf, 1.0))) for name in ("a", "b")]
STORED = [MadeUp("a", 0.01, (("exact", 0.0, 9.0), ("cheap", 0.001, 1.0))), MadeUp("saturation", 0.0), MadeUp("b", 0)]
THREE = [
    MadeUp(n, e, (("exact", 0.0, c),)) for n, e, c in (("blur", 0.05, 0.9), ("noise", 0.04, 7.7), ("smile", 0.03, 0.3))
]
PAIR = [MadeUp("small", 0.01, (("exact", 0.0, 2.0),)), MadeUp("large", 1.0, (("exact", 0.0, 50.0),))]
FREE = [MadeUp("free", 0.05, (("exact", 0.0, 0.0),)), MadeUp("dear", 0.05, (("exact", 0.0, 9.0),))]
POISSON = [MadeUp("shot", 2.0, (("poisson", 0.0, 24.7), ("gauss", 0.01, 7.7), ("rough", 0.5, 3.8)))]


@pytest.mark.parametrize(
    ("effects", "tolerance", "asked", "wanted"),
    [
        pytest.param(ENDLESS, math.inf, "auto", "off off", id="an infinite tolerance holds for bounds without limit"),
        pytest.param(ENDLESS, math.inf, "a,b", "cheap cheap", id="those asked for are then as cheap as may be"),
        pytest.param(ENDLESS, 1e9, "auto", "exact exact", id="no other tolerance does"),
        pytest.param(STORED, 1.0, "all", "exact exact off", id="all is exact, but for what is absent"),
        pytest.param(STORED, 1.0, "none", "off exact off", id="none keeps what is stored"),
        pytest.param(THREE, 0.11, "auto", "off off exact", id="dearest per bound goes first, 1.2 (0.05 + 0.04) fit"),
        pytest.param(PAIR, 1.2, "auto", "exact off", id="a long step is not shut out by a short one"),
        pytest.param(PAIR, 0.1, "auto", "off exact", id="what is off may return in exchange for a dearer one"),
        pytest.param(FREE, 0.12, "auto", "off off", id="what costs nothing is left out too"),
        pytest.param(FREE, 0.11, "auto", "exact off", id="but goes last"),
        pytest.param(POISSON, 0.1, "auto", "gauss", id="a variant where leaving out is too much, no cheaper one"),
    ],
)
def test_decision_matches_hand_calculation(effects: list[MadeUp], tolerance: float, asked: str, wanted: str):
    """The wanted variants are in the order of the chain; with ``auto`` the error is within the tolerance."""
    decision = decide(PROBE, RIG, effects, tolerance, asked)
    assert " ".join(variants(decision).values()) == wanted
    assert decision.error <= tolerance or asked != "auto"


def test_gains_multiply_the_errors_of_others_but_not_their_own():
    """Light that is 25 % brighter carries errors 25 % larger, also to the readout; DN do not depend on the light."""
    effects = [
        MadeUp("read", 0.1),
        Brightening("vignetting", 0.25, fraction=0.25),
        Brightening("cloud", 0.5, fraction=-0.5),
    ]
    errors = [menu.off.error for menu in list_options(replace(PROBE, unit="dn"), RIG, effects)]
    assert errors == pytest.approx([0.1 * 1.875 * SAFETY, 0.25 * 1.5 * SAFETY, 0.5 * 1.25 * SAFETY])


def test_worst_of_several_exposures_counts():
    """Each option has the greater error of two probes; an effect that one probe does not show may show in the other."""
    fine, coarse = even_probe(), even_probe(level=np.full(1, 2.0), slope=np.zeros((2, 1)))
    steep = replace(fine, slope=np.ones((2, 1)))
    effects = [MadeUp("read", 0.1, (("exact", 0.0, 5.0), ("cheap", 0.01, 1.0))), Shift("shift", 0.1)]
    read, shift = list_options([steep, coarse], RIG, effects)
    assert (read.off.error, read.variants[1].error) == pytest.approx((0.2 * SAFETY, 0.02 * SAFETY))
    assert read.off.why == "read as off"
    assert shift.off.error == pytest.approx(0.1 * SAFETY)
    assert shift.off.why == "0.1 px aside"
    assert decide(fine, RIG, effects, 0.15).taken[0].option.variant == "off"
    assert decide([fine, coarse], RIG, effects, 0.15).taken[0].option.variant == "cheap"


def test_gain_that_only_darkens_does_not_multiply_errors():
    """A shadow states its own range; leaving it out counts by the smaller noise within the shadow."""
    rig = Rig(sky=Sky(cloud_fraction=0.5))
    slope = even_probe(slope=np.ones((2, 1)), brightest_e=1e4, darkest_e=1e4)
    shift, cloud = (menu.off.error for menu in list_options(slope, rig, [Shift("shift", 0.1), CLOUD]))
    assert shift == pytest.approx(0.1 * SAFETY)
    assert cloud == pytest.approx(0.5 * SAFETY * math.sqrt((1e4 + 402.083) / (5e3 + 402.083)), rel=1e-6)


@pytest.mark.parametrize("name", ["rotation", "slit", "smear"])
def test_later_gains_multiply_errors_of_the_renderer(name: str):
    """In 1.5 times the light, lines without rotation err by 1.5 times, and so does a readout of that light."""
    effects = [MadeUp(name, 0.1), MadeUp("read", 0.1), Brightening("drift", 0.5, fraction=0.5)]
    errors = [menu.off.error for menu in list_options(replace(PROBE, unit="dn"), RIG, effects)]
    assert errors[:2] == pytest.approx([0.15 * SAFETY, 0.15 * SAFETY])


def test_readout_is_bounded_by_the_light_that_it_receives():
    """Under a cloud that takes all light, read noise is all noise, and its bound is that of darkness."""
    probe = even_probe(brightest_e=1e4, darkest_e=1e4)
    rig = Rig(sky=Sky(cloud_fraction=1.0))
    found = {menu.name: menu.off.error for menu in list_options(probe, rig, [READ_NOISE, CLOUD])}
    dark = READ_NOISE.bound(replace(probe, darkest_e=0.0), rig).value
    assert found["read-noise"] == pytest.approx(SAFETY * dark)
    assert dark > 10 * READ_NOISE.bound(probe, rig).value


def test_shift_on_an_even_scene_is_unseen():
    """An effect without a trace in the scene is off from the smallest tolerance upwards, and on at 0."""

    assert decide(PROBE, RIG, [Shift("shift", 1.0)], 1e-300).taken[0].reason == "unseen"
    assert decide(PROBE, RIG, [Shift("shift", 1.0)], 0.0).taken[0].reason == "exact"


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("vigneting", r"unknown effect 'vigneting'; did you mean 'vignetting'\?"),
        ("shot,jittr", r"unknown effect 'jittr'; did you mean 'jitter'\?"),
        ("zzz", "unknown effect 'zzz'; known are shot, jitter, vignetting"),
        ("auto,shot", "'auto' stands alone, got 'auto,shot'"),
        (" , ", "no effect is named in ' , '; write auto, all, none, or names"),
    ],
)
def test_unknown_names_are_refused_with_a_suggestion(asked: str, words: str):
    """One error states the nearest known name, or the correct use of ``auto``, ``all`` and ``none``."""
    with pytest.raises(SettingsError, match=words):
        named_effects(asked, ["shot", "jitter", "vignetting"])


@pytest.mark.parametrize("tolerance", [-0.1, math.nan])
def test_negative_and_nan_tolerances_are_refused(tolerance: float):
    """A tolerance is a number of 0 or more."""
    with pytest.raises(SettingsError, match="tolerance must be 0 or more, got"):
        decide(PROBE, RIG, [], tolerance)


def test_nan_bounds_are_refused_by_name():
    """The error names the effect, the variant and the bound's reason."""
    with pytest.raises(SettingsError, match=r"effect smear, off: its bound is nan.*smear as off"):
        decide(PROBE, RIG, [MadeUp("smear", math.nan)], 0.1)


FIELDS = {"name", "state", "variant", "bound", "cost_ns", "reason", "left_out", "magnitude", "unit"}
EFFECTS = [
    MadeUp("wind", 0.0),
    Shift("rotation", 2.0),
    MadeUp("blur", 0.05, (("kernel", 0.0, 2.0),)),
    MadeUp("shot", 2.0, (("poisson", 0.0, 24.0), ("gauss", 0.01, 8.0))),
    MadeUp("smile", 0.06, (("taps", 0.0, 0.5),)),
    MadeUp("throughput", 0.02, (("factor", 0.0, 0.0),)),
    MadeUp("saturation", 0.0, (("clip", 0.0, 0.1),)),
]


def test_rows_have_the_fields_of_a_receipt_and_plain_values():
    """Rows survive JSON without NaN, as receipts need, and keep the order of the effects."""
    rows = list_effects(decide(PROBE, RIG, EFFECTS, math.inf))
    assert all(set(row) == FIELDS for row in rows)
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    assert [row["name"] for row in rows] == [effect.name for effect in EFFECTS]


def test_totals_are_sums_of_the_rows():
    """Bounds sum to the whole bound, and costs to that of what is on."""
    decision = decide(PROBE, RIG, EFFECTS, 0.1)
    rows = list_effects(decision)
    totals = sum_up(decision)
    assert math.fsum(row["bound"] for row in rows) == pytest.approx(totals["bound"])
    assert totals["bound"] <= totals["tolerance"] == 0.1
    assert math.fsum(row["cost_ns"] for row in rows) == pytest.approx(cost_of(decision))
    assert (totals["on"], totals["off"], totals["within"]) == (3, 4, True)


def test_selected_effects_may_exceed_the_tolerance():
    """The totals state that ``none`` is not within the tolerance."""
    totals = sum_up(decide(PROBE, RIG, EFFECTS, 0.1, "none"))
    assert not totals["within"]
    assert totals["bound"] == pytest.approx(1.2 * (0.05 + 2.0 + 0.06 + 0.02))


def test_every_outcome_of_the_rule_has_its_reason():
    """The reasons are absent, unseen, small, needed, without room in the tolerance (``spent``), and always on."""
    rows = list_effects(decide(PROBE, RIG, EFFECTS, 0.1))
    assert [row["reason"] for row in rows] == ["absent", "unseen", "small", "needed", "spent", "small", "always"]
    assert rows[3]["magnitude"] == "shot as off"
    assert rows[3]["left_out"] == pytest.approx(2.4)


def test_infinite_bounds_become_null():
    """JSON has no infinity."""
    decision = decide(PROBE, RIG, [MadeUp("slit", math.inf)], math.inf, "none")
    assert list_effects(decision)[0]["bound"] is None
    assert (sum_up(decision)["bound"], sum_up(decision)["tolerance"]) == (None, None)

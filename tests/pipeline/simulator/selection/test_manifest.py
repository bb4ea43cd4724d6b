"""The manifest: rows that a receipt takes, totals that add up, and words that say why."""

from __future__ import annotations

import json
import math

import pytest

from pipeline.simulator.selection.choice import decide, list_effects, sum_up
from tests.pipeline.simulator.made_up_effects import RIG, MadeUp, Shift, even_probe

FIELDS = {"name", "state", "variant", "bound", "measured", "cost_s", "why", "reason", "left_out", "magnitude", "unit"}
PROBE = even_probe()
EFFECTS = [
    MadeUp("wind", 0.0),
    Shift("rotation", 2.0),
    MadeUp("blur", 0.05, (("kernel", 0.0, 2.0),)),
    MadeUp("shot", 2.0, (("poisson", 0.0, 24.0), ("gauss", 0.01, 8.0))),
    MadeUp("smile", 0.06, (("taps", 0.0, 0.5),)),
    MadeUp("throughput", 0.02, (("factor", 0.0, 0.0),)),
    MadeUp("saturation", 0.0, (("clip", 0.0, 0.1),)),
]


def whys(tolerance: float, asked: str = "auto") -> dict[str, str]:
    """Reasons by name."""
    return {row["name"]: row["why"] for row in list_effects(decide(PROBE, RIG, EFFECTS, tolerance, asked))}


def test_rows_have_the_fields_of_a_receipt_and_plain_values():
    """Receipts take them as they are."""
    rows = list_effects(decide(PROBE, RIG, EFFECTS, math.inf), {"blur": 0.01})
    assert all(set(row) == FIELDS for row in rows)
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    assert [row["name"] for row in rows] == [effect.name for effect in EFFECTS]
    assert [row["measured"] for row in rows if row["name"] in ("blur", "shot")] == [0.01, None]


def test_rows_have_the_parts_of_their_reasons():
    """What leaving an effect out would do also where it is on, and the words of its bound by themselves."""
    rows = {row["name"]: row for row in list_effects(decide(PROBE, RIG, EFFECTS, 0.1))}
    parts = [[rows[name][part] for part in ("reason", "left_out", "magnitude")] for name in ("wind", "shot")]
    assert parts == [["absent", 0.0, "wind as off"], ["needed", pytest.approx(2.4), "shot as off"]]


def test_totals_add_up():
    """Bounds to the whole bound, seconds to what was saved against everything on."""
    decision = decide(PROBE, RIG, EFFECTS, 0.1)
    rows, totals = list_effects(decision), sum_up(decision, {"all effects": 0.03})
    assert math.fsum(row["bound"] for row in rows) == pytest.approx(totals["bound"])
    assert totals["bound"] <= totals["tolerance"] == 0.1
    assert math.fsum(row["cost_s"] for row in rows) == pytest.approx(totals["cost_s"])
    assert totals["saved_s"] == pytest.approx((24.0 - 8.0 + 2.0 + 1.0 + 0.001) * 1e-9 * 100 * 640)
    assert (totals["on"], totals["off"], totals["within"], totals["measured"]) == (3, 4, True, 0.03)


def test_seconds_against_cheap_variants_are_told_too():
    """With variants whose own error is within a tenth of the tolerance: 0.12 for the noise's 0.012."""
    totals = sum_up(decide(PROBE, RIG, EFFECTS, 0.12))
    assert totals["cheap_cost_s"] == pytest.approx((8.0 + 2.0 + 0.5 + 1.0 + 0.1 + 0.001) * 1e-9 * 100 * 640)


def test_asked_effects_may_leave_the_tolerance():
    """The totals say so."""
    totals = sum_up(decide(PROBE, RIG, EFFECTS, 0.1, "none"))
    assert not totals["within"]
    assert totals["bound"] == pytest.approx(1.2 * (0.05 + 2.0 + 0.06 + 0.02))


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("wind", "the rig has none of it: wind as off"),
        ("rotation", "the scene shows nothing of it: 2 px aside"),
        ("blur", "left out it changes a stored number by at most 0.06 sigma of the noise: blur as off"),
        (
            "shot",
            "left out it could change a stored number by 2.4 sigma of the noise, more than the tolerance of 0.1: shot"
            " as off; gauss differs from exact by at most 0.012 sigma of the noise: shot as gauss",
        ),
        (
            "smile",
            "left out it could change a stored number by 0.072 sigma of the noise, and the tolerance of 0.1 is spent"
            " where it saves more: smile as off",
        ),
        ("throughput", "left out it changes a stored number by at most 0.024 sigma of the noise: throughput as off"),
        ("saturation", "always there, for raw lines are whole numbers of limited size: saturation as off"),
    ],
)
def test_reasons_say_why_in_words_and_numbers(name: str, why: str):
    """Every case of the rule."""
    assert whys(0.1)[name] == why


def test_reasons_name_what_was_asked():
    """Also where the rig lacks it, and where the tolerance is 0."""
    asked = whys(0.1, "wind, blur")
    assert asked["wind"].startswith("asked for, but the rig has none of it: ")
    assert asked["blur"].startswith("asked for: ")
    assert asked["smile"].startswith("not asked for; left out it could change a stored number by 0.072 sigma")
    assert whys(0.0)["rotation"].startswith("the tolerance is 0, so everything is computed: ")


def test_bounds_without_limit_become_null():
    """JSON knows no infinity."""
    decision = decide(PROBE, RIG, [MadeUp("slit", math.inf)], math.inf, "none")
    assert list_effects(decision)[0]["bound"] is None
    assert (sum_up(decision)["bound"], sum_up(decision)["tolerance"]) == (None, None)
    assert "any number of sigma" in list_effects(decision)[0]["why"]

"""The manifest of the simulator's effects: what was computed, what was left out, and why, for receipt and cube."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pipeline.simulator.effects.probe import Unit
from pipeline.simulator.selection.choice import Decision, Treatment

UNIT_WORDS: dict[Unit, str] = {"sigma": "sigma of the noise", "dn": "DN"}
TOTAL = "all effects"


def list_effects(decision: Decision, measured: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """Give one plain row for every effect, in the order of the chain.

    Each has ``name``; ``state`` (on or off); ``variant`` (None where off); ``bound`` on the change of any number that
    is stored, at the worst binning, by treating the effect so, in ``unit``, with the factor of safety: 0 where it is
    exact or absent, None where there is none; ``measured``, the same on lines of the scene (None where not verified);
    ``cost_s``, estimated CPU seconds of all sweeps; ``why`` in a sentence, and its parts: ``reason`` (see
    `choice.Treatment`), ``left_out``, the bound on what leaving it out would change, and ``magnitude``, how large it is
    here, in the words of its own bound.

    Parameters
    ----------
    measured
        What `verify` found, by name.
    """
    return [_row(one, decision, None if measured is None else measured.get(one.name)) for one in decision.taken]


def sum_up(decision: Decision, measured: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Give the totals: bound beside tolerance, and the CPU seconds that were saved against everything on.

    ``saved_s`` is against everything that the rig has, exact; ``saved_cheap_s`` against everything on with each effect
    in its cheapest variant whose own error is within a tenth of the tolerance. All are estimates from measured costs
    per number, without the rays through the footprint that every simulation takes.
    """
    cost, exact, cheap = (
        _seconds(ns, decision) for ns in (decision.cost_ns, decision.exact_cost_ns, decision.cheap_cost_ns)
    )
    return {
        "asked": decision.asked,
        "tolerance": _finite(decision.tolerance),
        "unit": decision.unit,
        "bound": _finite(decision.error),
        "measured": None if measured is None else measured.get(TOTAL),
        "within": decision.error <= decision.tolerance,
        "on": sum(one.is_on for one in decision.taken),
        "off": sum(not one.is_on for one in decision.taken),
        "cost_s": cost,
        "exact_cost_s": exact,
        "cheap_cost_s": cheap,
        "saved_s": exact - cost,
        "saved_cheap_s": cheap - cost,
    }


def _row(one: Treatment, decision: Decision, measured: float | None) -> dict[str, Any]:
    return {
        "name": one.name,
        "state": "on" if one.is_on else "off",
        "variant": one.option.variant if one.is_on else None,
        "bound": _finite(one.option.error),
        "measured": measured,
        "cost_s": _seconds(decision.cost_of(one), decision),
        "why": explain(one, decision),
        "reason": one.reason,
        "left_out": _finite(one.menu.off.error),
        "magnitude": one.menu.off.why,
        "unit": decision.unit,
    }


def explain(one: Treatment, decision: Decision) -> str:
    """Say why an effect is on or off, with the magnitude that its own bound states."""
    unit = UNIT_WORDS[decision.unit]
    said = f"{_reason(one, decision)}: {one.menu.off.why}"
    if one.is_on and one.option is not one.menu.exact:
        off_by = f"{_number(one.option.error)} {unit}"
        said += f"; {one.option.variant} differs from exact by at most {off_by}: {one.option.why}"
    return said


def _reason(one: Treatment, decision: Decision) -> str:
    unit, tolerance = UNIT_WORDS[decision.unit], _number(decision.tolerance)
    left_out = f"left out it could change a stored number by {_number(one.menu.off.error)} {unit}"
    asked = one.name in [word.strip() for word in decision.asked.split(",")]
    return {
        "absent": ("asked for, but " if asked else "") + "the rig has none of it",
        "unseen": "the scene shows nothing of it",
        "small": f"left out it changes a stored number by at most {_number(one.option.error)} {unit}",
        "needed": f"{left_out}, more than the tolerance of {tolerance}",
        "spent": f"{left_out}, and the tolerance of {tolerance} is spent where it saves more",
        "exact": "the tolerance is 0, so everything is computed",
        "asked": "asked for",
        "unasked": f"not asked for; {left_out}",
        "always": "always there, for raw lines are whole numbers of limited size",
    }[one.reason]


def _number(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "any number of"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _seconds(cost_ns: float, decision: Decision) -> float:
    return cost_ns * 1e-9 * decision.px_bands

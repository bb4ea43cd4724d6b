"""Choose which effects to compute, and how, so that what is left out stays within one tolerance; list what was chosen.

The search is greedy, and starts with everything exact. The cheaper option that still fits and saves most per added
error is taken, until none fits. One long step may be shut out by a short one. So the same is tried after each single
step, and the cheapest end counts: it saves at least half of what can be saved. A larger tolerance never costs more, but
may switch a cheap effect on again in exchange for a dear one.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.simulator.effects.effect import OFF, Effect
from spectralzoom.pipeline.simulator.effects.probe import Probe, Unit
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.selection.options import ALWAYS_ON, Menu, Option, list_options

Reason = Literal["absent", "unseen", "small", "needed", "spent", "exact", "asked", "unasked", "always"]
UNIT_NAMES: dict[Unit, str] = {"sigma": "sigma of the noise", "dn": "DN"}


@dataclass(frozen=True)
class Treatment:
    """Option taken. ``small``: off within the tolerance; ``needed``: beyond it alone; ``spent``: with the others."""

    menu: Menu
    option: Option
    reason: Reason

    @property
    def name(self) -> str:
        return self.menu.name

    @property
    def is_on(self) -> bool:
        return self.option.variant != OFF


@dataclass(frozen=True)
class Decision:
    """For every effect an option, in the order of the chain. Errors and tolerance are in ``unit``."""

    taken: tuple[Treatment, ...]
    tolerance: float
    unit: Unit
    asked: str

    @property
    def chosen(self) -> dict[Effect, str]:
        """Return effects that are on with their variants, as the renderer takes them."""
        return {one.menu.effect: one.option.variant for one in self.taken if one.is_on}

    @property
    def exact(self) -> dict[Effect, str]:
        """Return everything that the rig has, in its exact variant: the reference."""
        return {one.menu.effect: one.menu.exact.variant for one in self.taken if one.menu.present}

    @property
    def error(self) -> float:
        """Bound on the change of any number by all that is left out or cheapened; above the tolerance only if asked."""
        return math.fsum(one.option.error for one in self.taken)


def decide(
    probes: Probe | Sequence[Probe], rig: Rig, effects: Sequence[Effect], tolerance: float, asked: str = "auto"
) -> Decision:
    """Choose off or a variant for every effect, so that the sum of their errors stays within the tolerance.

    Tolerance 0 is everything that the rig has, exact; an infinite one switches off all that may be off. Quantisation
    and saturation are never off; what the rig has none of always is. ``probes``: one for each exposure of the survey;
    the worst counts. ``effects``: in the order of the chain, which does not change what is chosen. ``tolerance``:
    greatest change of any stored number, in the unit of the probes. ``asked``: ``auto``; ``all``: on and exact;
    ``none``; or names with commas: those on, in the variants that the tolerance lets them have, the others off.
    Raises SettingsError: the tolerance is negative or no number, or an asked name is not known.
    """
    if not tolerance >= 0:
        raise SettingsError(f"the tolerance must be 0 or more, got {tolerance}; 0 computes everything")
    named = named_effects(asked, [effect.name for effect in effects])
    menus = list_options(probes, rig, effects)
    settled = {menu.name: _settled(menu, tolerance, named, exact=asked == "all") for menu in menus}
    options = _cheapened([menu for menu in menus if settled[menu.name] is None], tolerance, forced=named is not None)
    taken = [
        settled[menu.name] or Treatment(menu, options[menu.name], _reason(menu, options[menu.name], tolerance, named))
        for menu in menus
    ]
    first = probes if isinstance(probes, Probe) else probes[0]
    return Decision(tuple(taken), tolerance, first.unit, asked)


def named_effects(asked: str, known: Sequence[str]) -> frozenset[str] | None:
    """Return the effects that ``asked`` demands; None where the tolerance decides.

    Raises SettingsError: a name is not known (names the nearest that is), or there is none.
    """
    words = [word.strip() for word in asked.split(",") if word.strip()]
    if words in (["auto"], ["all"], ["none"]):
        return {"auto": None, "all": frozenset(known), "none": frozenset[str]()}[words[0]]
    for word in words:
        if word in ("auto", "all", "none"):
            raise SettingsError(f"{word!r} stands alone, got {asked!r}; leave it or the names out")
        if word not in known:
            near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
            raise SettingsError(f"unknown effect {word!r}; {hint} (or one of auto, all, none alone)")
    if not words:
        raise SettingsError(f"no effect is named in {asked!r}; write auto, all, none, or names with commas")
    return frozenset(words)


def _settled(menu: Menu, tolerance: float, named: frozenset[str] | None, *, exact: bool) -> Treatment | None:
    """Return the decision on an effect that needs no search; None for the others."""
    kept = menu.name in ALWAYS_ON
    if not menu.present:
        return Treatment(menu, menu.off, "absent")
    if named is not None and menu.name not in named and not kept:
        return Treatment(menu, menu.off, "unasked")
    if tolerance == 0 or exact:
        return Treatment(menu, menu.exact, "always" if kept else "exact" if named is None else "asked")
    if named is None and not kept and menu.off.error == 0:
        return Treatment(menu, menu.off, "unseen")
    return None


class _Step(NamedTuple):
    """Sorted by added error per saving; among equals the smaller error, then names: the order of effects is none."""

    price: float
    added: float
    name: str
    variant: str
    option: Option


def _cheapened(menus: Sequence[Menu], tolerance: float, *, forced: bool) -> dict[str, Option]:
    exact = {menu.name: menu.exact for menu in menus}
    first = sorted(_steps(menus, exact, forced=forced))
    starts = [exact, *(exact | {step.name: step.option} for step in first if step.option.error <= tolerance)]
    ends = (_greedy(menus, tolerance, start, forced=forced) for start in starts)
    return min(ends, key=lambda end: math.fsum(one.cost_ns for one in end.values()))  # the first among equals


def _greedy(menus: Sequence[Menu], tolerance: float, start: Mapping[str, Option], *, forced: bool) -> dict[str, Option]:
    current = dict(start)
    while True:
        for step in sorted(_steps(menus, current, forced=forced)):
            if math.fsum(one.error for one in (current | {step.name: step.option}).values()) <= tolerance:
                current[step.name] = step.option
                break
        else:
            return current


def _steps(menus: Iterable[Menu], taken: Mapping[str, Option], *, forced: bool) -> Iterator[_Step]:
    """Yield the options that cost less than the ones taken."""
    for menu in menus:
        now = taken[menu.name]
        for option in menu.variants if forced or menu.name in ALWAYS_ON else (*menu.variants, menu.off):
            saved = now.cost_ns - option.cost_ns
            if saved > 0:
                added = max(0.0, option.error - now.error)
                yield _Step(added / saved, added, menu.name, option.variant, option)


def _reason(menu: Menu, option: Option, tolerance: float, named: frozenset[str] | None) -> Reason:
    if menu.name in ALWAYS_ON:
        return "always"
    if named is not None:
        return "asked"
    if option.variant == OFF:
        return "small"
    return "needed" if menu.off.error > tolerance else "spent"


def list_effects(decision: Decision) -> list[dict[str, Any]]:
    """Return one plain row for every effect, in the order of the chain.

    ``bound`` is on the change of any stored number, with the factor of safety, in ``unit``: 0 where exact or absent,
    None where there is none. ``cost_ns`` is the usual cost of a px and band. ``reason`` is that of `Treatment`.
    ``left_out`` is the bound on leaving it out, and ``magnitude`` the words of that bound.
    """
    return [
        {
            "name": one.name,
            "state": "on" if one.is_on else "off",
            "variant": one.option.variant if one.is_on else None,
            "bound": _finite(one.option.error),
            "cost_ns": one.option.cost_ns,
            "reason": one.reason,
            "left_out": _finite(one.menu.off.error),
            "magnitude": one.menu.off.why,
            "unit": decision.unit,
        }
        for one in decision.taken
    ]


def sum_up(decision: Decision) -> dict[str, Any]:
    """Return the totals: bound beside tolerance, and the number of effects that are on and off."""
    return {
        "asked": decision.asked,
        "tolerance": _finite(decision.tolerance),
        "unit": decision.unit,
        "bound": _finite(decision.error),
        "within": decision.error <= decision.tolerance,
        "on": sum(one.is_on for one in decision.taken),
        "off": sum(not one.is_on for one in decision.taken),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None

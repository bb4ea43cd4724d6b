"""The registry: every effect once, and each complete."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

import pytest

import pipeline.simulator.effects as package
from pipeline.simulator.effects import registry
from pipeline.simulator.effects.effect import OFF, Bound, Effect
from pipeline.simulator.effects.registry import AIMS, BY_NAME, EFFECTS, FOOTPRINT, LIGHT, RAYS, READOUT
from pipeline.simulator.selection.options import ALWAYS_ON
from tests.pipeline.simulator.made_up_effects import RIG, even_probe


def effects_of(module: ModuleType) -> list[object]:
    """Module-level instances of classes that the module itself defines and that have a bound and variants."""
    found = [value for name, value in vars(module).items() if not name.startswith("__")]
    own = [one for one in found if type(one).__module__ == module.__name__]
    return [one for one in own if hasattr(one, "bound") and hasattr(one, "variants")]


def test_every_effect_of_every_module_is_registered_once():
    """A module that is forgotten would never be computed."""
    modules = [
        importlib.import_module(f"{package.__name__}.{one.name}") for one in pkgutil.iter_modules(package.__path__)
    ]
    there = [one for module in modules if module is not registry for one in effects_of(module)]
    assert {type(one) for one in there} == {type(one) for one in EFFECTS}
    assert len(EFFECTS) == len({type(one) for one in EFFECTS}) == len(there)


def test_names_are_unique_and_as_flags_write_them():
    """Lower case with hyphens, none that flags give another meaning."""
    assert list(BY_NAME) == [effect.name for effect in EFFECTS]
    assert len(BY_NAME) == len(EFFECTS)
    assert all(name.replace("-", "").isalnum() and name == name.lower() for name in BY_NAME)
    assert not {"auto", "all", "none", OFF} & set(BY_NAME)
    assert set(BY_NAME) >= ALWAYS_ON


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_effects_are_complete(effect: Effect):
    """Variants with a cost each, bounds with reasons, the exact one's 0, and fit for a key."""
    assert effect.variants
    assert OFF not in effect.variants
    assert set(effect.cost_ns) == set(effect.variants)
    assert all(cost >= 0 for cost in effect.cost_ns.values())
    assert {effect: 1}[effect] == 1
    for variant in (OFF, *effect.variants):
        bound = effect.bound(even_probe(), RIG, variant)
        assert isinstance(bound, Bound)
        assert bound.value >= 0
        assert bound.why
    assert effect.bound(even_probe(), RIG, effect.variants[0]).value == 0


@pytest.mark.parametrize(
    ("part", "actions"),
    [(AIMS, {"aim"}), (RAYS, {"displaced"}), (FOOTPRINT, {"moments"}), (LIGHT, {"gain", "change"}), (READOUT, set())],
)
def test_effects_stand_where_they_act(part: tuple[Effect, ...], actions: set[str]):
    """Each has one action of its part of the chain; the renderer and the readout do the rest themselves."""
    by_renderer = {"rotation", "slit", "smear"}
    for effect in part:
        has = {action for action in ("aim", "displaced", "moments", "gain", "change") if hasattr(effect, action)}
        assert has <= actions
        assert len(has) == (0 if effect.name in by_renderer or part is READOUT else 1)

"""What is different between a store and the version of it before: parameters, inputs, versions, libraries."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from storage.archive.lineage import Catalogue
from storage.archive.records import Store

ABSENT = "(none)"
Kind = Literal["parameter", "input", "version", "library"]


@dataclass(frozen=True)
class Change:
    """One thing that differs. ``where`` is the stage whose store differs: that asked for, or one that it rests on."""

    where: str
    kind: Kind
    name: str
    old: Any
    new: Any


def version_before(catalogue: Catalogue, uri: str) -> Store | None:
    """The newest earlier store of the same stage, of the same part in a survey and of the same scene; None: the first.

    The part is what runs call it (capture_fine), or else what kind of store it was made of. The scene is known where
    it or a store that it rests on has a parameter ``scene``.
    """
    this = catalogue.stores[uri]
    before = [
        store
        for store in catalogue.stores.values()
        if store.ref.stage == this.ref.stage
        and store.problem is None
        and _moment(store) < _moment(this)
        and _same_part(catalogue, store, this)
    ]
    scenes = _scenes(catalogue, uri)
    same = [store for store in before if not scenes or _scenes(catalogue, store.ref.uri) in (scenes, set())]
    return max(same, key=_moment, default=None)


def changes_between(catalogue: Catalogue, old: Store, new: Store) -> list[Change]:
    """What differs, and for inputs that differ what differs in them, down to where it began."""
    found: list[Change] = []
    seen, waiting = set[tuple[str, str]](), [(old, new)]
    while waiting:
        before, after = waiting.pop(0)
        if (before.ref.uri, after.ref.uri) in seen:
            continue
        seen.add((before.ref.uri, after.ref.uri))
        where = after.ref.stage
        if before.version != after.version:
            found.append(Change(where, "version", "stage", before.version, after.version))
        found += _differing(where, "parameter", flatten(before.params), flatten(after.params))
        found += _differing(where, "library", before.libraries, after.libraries)
        inputs = _differing(where, "input", _by_stage(catalogue, before), _by_stage(catalogue, after))
        found += inputs
        for one in inputs:
            was, now = catalogue.stores.get(one.old), catalogue.stores.get(one.new)
            if was is not None and now is not None and was.ref.stage == now.ref.stage:
                waiting.append((was, now))
    return found


def flatten(value: object, name: str = "") -> dict[str, Any]:
    """Nested tables and lists of tables as dotted names: ``camera.samples``, ``sweeps[2].start_px``."""
    if isinstance(value, Mapping) and value:
        return {
            inner: one
            for key, part in value.items()
            for inner, one in flatten(part, f"{name}.{key}" if name else str(key)).items()
        }
    if isinstance(value, list) and any(isinstance(part, Mapping | list) for part in value):
        return {
            inner: one for number, part in enumerate(value) for inner, one in flatten(part, f"{name}[{number}]").items()
        }
    return {name: value}


def _differing(where: str, kind: Kind, old: Mapping[str, Any], new: Mapping[str, Any]) -> list[Change]:
    names = [name for name in sorted(old.keys() | new.keys()) if name]
    changes = [Change(where, kind, name, old.get(name, ABSENT), new.get(name, ABSENT)) for name in names]
    return [one for one in changes if one.old != one.new]


def _by_stage(catalogue: Catalogue, store: Store) -> dict[str, str]:
    """Addresses of inputs, told apart by stage, and by number within one."""
    found: dict[str, str] = {}
    for uri in catalogue.inputs_of(store.ref.uri):
        stage = uri.split("/")[1] if "/" in uri else "store that is not there"
        number = sum(name.split(" #")[0] == stage for name in found)
        found[stage if not number else f"{stage} #{number + 1}"] = uri
    return found


def _same_part(catalogue: Catalogue, *pair: Store) -> bool:
    roles = [catalogue.roles(store.ref.uri) for store in pair]
    if all(roles):
        return bool(roles[0] & roles[1])
    inputs = [[uri for uri in catalogue.inputs_of(store.ref.uri) if "/" in uri] for store in pair]
    first = [given[0].split("/")[1] if given else "" for given in inputs]  # it tells a fine capture from a coarse one
    return first[0] == first[1]


def _scenes(catalogue: Catalogue, uri: str) -> set[str]:
    stores = (catalogue.stores.get(one) for one in {uri, *catalogue.ancestors([uri])})
    return {str(store.params["scene"]) for store in stores if store is not None and "scene" in store.params}


def _moment(store: Store) -> tuple[str, int]:
    """When a store was published; the file's own date decides where clocks were too coarse."""
    return store.created, (store.ref.path / "manifest.json").stat().st_mtime_ns

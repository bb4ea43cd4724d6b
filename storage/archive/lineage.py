"""Find the stores that every store and run of an archive was made of, by manifests and receipts.

Find products by name. A damaged manifest gives a store with a problem, a missing input a bare key.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from graphlib import TopologicalSorter
from pathlib import Path

from spectralzoom.pipeline.errors import ArchiveError, NoRunError, list_some
from spectralzoom.storage.archive.keys import LATEST, StageRef, in_text, published_runs, published_stores
from spectralzoom.storage.archive.records import LINE_PRODUCTS, Run, Store, read_run, read_store
from spectralzoom.storage.archive.staging import MANIFEST_NAME, check_name

CAPTURED = "capture"  # stage of lines as they came
RASTER_ROLE = "condense_raster"  # the stage that reads the pixels of a raster


@dataclass(frozen=True)
class Catalogue:
    """All stores by address, and all runs, oldest first."""

    stores: dict[str, Store]
    runs: list[Run]

    @classmethod
    def read(cls, root: Path) -> Catalogue:
        """Read every manifest and receipt of an archive; damaged ones have a ``problem``."""
        stores = {ref.uri: read_store(ref) for ref in published_stores(root)}
        runs = sorted((read_run(path) for path in published_runs(root)), key=lambda run: (run.created, run.folder.name))
        return cls(stores, runs)

    @cached_property
    def by_key(self) -> dict[str, list[str]]:
        """Return addresses of stores by key, also of missing ones that a run names."""
        found: dict[str, list[str]] = {}
        for uri in dict.fromkeys((*self.stores, *(uri for run in self.runs for uri in sorted(run.names)))):
            found.setdefault(uri.rpartition("/")[2], []).append(uri)
        return found

    def inputs_of(self, uri: str) -> list[str]:
        """Return the addresses of a store's inputs; a key without a store stays a bare key.

        Without a manifest, those of condensed lines are the raw lines of the runs that name them.
        """
        store = self.stores.get(uri)
        if store is None or store.problem is not None:
            return self._raw_of.get(uri, [])
        return [self.by_key.get(given, [given])[0] for given in store.inputs]

    @cached_property
    def _raw_of(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for run in self.runs:
            for names in LINE_PRODUCTS.items():
                raw, condensed = (in_text(run.products.get(name, "")) for name in names)
                if raw is not None and condensed is not None:
                    found.setdefault(condensed, []).append(raw)
        return found

    def ancestors(self, uris: Iterable[str]) -> set[str]:
        """Return all inputs of these stores, direct and indirect, without themselves; missing ones as bare keys."""
        begun = set(uris)
        found = set(begun)
        waiting = list(begun)
        while waiting:
            new = set(self.inputs_of(waiting.pop())) - found
            found |= new
            waiting += new
        return found - begun

    def inputs_first(self, uris: Iterable[str]) -> list[str]:
        """Return these stores with inputs before the stores made of them."""
        wanted = set(uris)
        graph = {uri: self.inputs_of(uri) for uri in sorted({*wanted, *self.ancestors(wanted)})}
        return [uri for uri in TopologicalSorter(graph).static_order() if uri in wanted]

    def named_by(self, uri: str) -> list[Run]:
        """Return the runs that rest on a store."""
        return self._namers.get(uri, [])

    @cached_property
    def _namers(self) -> dict[str, list[Run]]:
        found: dict[str, list[Run]] = {}
        for run in self.runs:
            for uri in run.names:
                found.setdefault(uri, []).append(run)
        return found

    def roles(self, uri: str) -> set[str]:
        """Return the names that runs give the stage of a store, such as capture_fine."""
        return self._roles.get(uri.rpartition("/")[2], set())

    @cached_property
    def _roles(self) -> dict[str, set[str]]:
        found: dict[str, set[str]] = {}
        for row in (row for run in self.runs for row in run.stages):
            if isinstance(row.get("key"), str) and isinstance(row.get("name"), str):
                found.setdefault(row["key"], set()).add(row["name"])
        return found

    def descendants(self, uris: Iterable[str]) -> set[str]:
        """Return all stores that were made of these, directly or not, without themselves."""
        given = set(uris)
        found = set(given)
        inputs = {uri: self.inputs_of(uri) for uri in self.stores}
        while new := {uri for uri in inputs.keys() - found if not found.isdisjoint(inputs[uri])}:
            found |= new
        return found - given

    def is_only_copy(self, uri: str) -> bool:
        """Return whether a store cannot be made again by the archive alone: lines and pixels that were not simulated.

        So is a store that was made of such lines, if they were cleared away or are missing.
        """
        stage = uri.partition("/")[2].partition("/")[0]
        if stage != CAPTURED and RASTER_ROLE not in self.roles(uri):
            known = {one: self.stores.get(one) for one in self.inputs_of(uri)}
            gone = [one for one, store in known.items() if store is None or store.cleared]
            return any(map(self.is_only_copy, gone))
        if asked := [run for run in self.named_by(uri) if run.settings]:
            return not all(run.simulated for run in asked)
        store = self.stores.get(uri)
        params = {} if store is None else store.params
        return bool(params.get("source", "sim" if "effects" in params else "rig") != "sim")


def rests_on(root: Path, refs: Iterable[StageRef]) -> list[StageRef]:
    """Return these stores and all their existing inputs, sorted by address."""
    found: dict[str, StageRef] = {}
    waiting = list(refs)
    while waiting:
        ref = waiting.pop()
        if ref.uri not in found:
            found[ref.uri] = ref
            stages = [path for path in (root / "stages").iterdir() if path.is_dir()]
            paths = (stage / key for key in read_store(ref).inputs if "/" not in key for stage in stages)
            waiting += [StageRef(p.parent.name, p.name, p) for p in paths if (p / MANIFEST_NAME).is_file()]
    return [found[uri] for uri in sorted(found)]


def find_product(catalogue: Catalogue, text: str) -> str | Run:
    """Return the address of a store that is there, or a run.

    Raises NoRunError: nothing has this name; ArchiveError: more than one product has it, or it is not allowed.
    """
    parts = text.rstrip("/").split("/")
    for part in parts:
        check_name(part)
    name = parts[1] if parts[0] == "runs" and len(parts) > 1 else text
    if runs := [run for run in catalogue.runs if name in (run.folder.name, LATEST)]:
        return runs[-1]
    if name != text:
        there = [run.uri for run in reversed(catalogue.runs)]
        raise NoRunError(f"there is no run {name} in this archive; there is {list_some(there, 3) or 'none'}")
    newest = next((run for run in reversed(catalogue.runs) if run.products), None)
    products = {} if newest is None else newest.products
    address = products.get(text, text)
    if newest is not None and address.startswith("runs/"):
        return newest
    wanted = in_text(address) or f"stages/{address}"
    if wanted in catalogue.stores:
        return wanted
    found = [
        uri for uri in sorted(catalogue.stores) if uri.startswith(wanted) or uri.rpartition("/")[2].startswith(address)
    ]
    if len(found) == 1:
        return found[0]
    if found:
        raise ArchiveError(f"{text} begins {len(found)} stores: {list_some(found, 3)}; give more of it")
    if newest is not None and text in products:
        raise ArchiveError(f"the {text} of {newest.uri} lacks its store {wanted}; survey again to make it")
    known = ", ".join(products) or list_some(sorted(catalogue.stores), 3) or "nothing in it"
    raise NoRunError(f"{text!r} is no product, store or run of this archive; there is {known}")

"""What rests on what: every store and run of an archive as their manifests and receipts tell.

Nothing here trusts what it reads: a damaged manifest is a store with a problem, an input that is not there a name.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pipeline.errors import ArchiveError
from storage.archive.addresses import StageRef, in_text, published_runs, published_stores, without_manifest
from storage.archive.records import Run, Store, read_run, read_store
from storage.archive.staging import MANIFEST_NAME, check_name

RAW_STAGES = ("capture", "ingest")


@dataclass(frozen=True)
class Catalogue:
    """All stores by address, and all runs, oldest first; ``lost`` are the addresses of stores without a manifest."""

    stores: dict[str, Store]
    runs: list[Run]
    lost: tuple[str, ...] = ()

    @classmethod
    def read(cls, root: Path) -> Catalogue:
        """Read every manifest and receipt of an archive; damaged ones are in it as such."""
        stores = {ref.uri: read_store(ref) for ref in published_stores(root)}
        by_key: dict[str, list[str]] = {}
        for store in stores.values():
            by_key.setdefault(store.ref.key, []).append(store.ref.uri)
        runs = sorted(
            (read_run(path, by_key) for path in published_runs(root)), key=lambda run: (run.created, run.folder.name)
        )
        lost = (path.relative_to(root).as_posix() for path in without_manifest(root))
        return cls(stores, runs, tuple(uri for uri in lost if in_text(uri) == uri))

    @cached_property
    def by_key(self) -> dict[str, list[str]]:
        """Addresses of stores by key, also of those that are only named or lost; one, but for keys given by hand."""
        found: dict[str, list[str]] = {}
        for uri in dict.fromkeys((*self.stores, *self.lost, *(uri for run in self.runs for uri in sorted(run.names)))):
            found.setdefault(uri.rpartition("/")[2], []).append(uri)
        return found

    def inputs_of(self, uri: str) -> list[str]:
        """Addresses of what a store was made of; a key that is nowhere stays a bare key."""
        store = self.stores.get(uri)
        if store is None:
            return []
        return [(self.by_key.get(given) or [in_text(given) or given])[0] for given in store.inputs]

    @cached_property
    def _made_of_it(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for uri in self.stores:
            for given in self.inputs_of(uri):
                found.setdefault(given, []).append(uri)
        return found

    def ancestors(self, uris: Iterable[str]) -> set[str]:
        """What these stores rest on, themselves not counted; with keys that are nowhere."""
        return reach(uris, self.inputs_of)

    def dependents(self, uris: Iterable[str]) -> set[str]:
        """What rests on these stores, themselves not counted."""
        return reach(uris, lambda uri: self._made_of_it.get(uri, []))

    def inputs_first(self, uris: Iterable[str]) -> list[str]:
        """These stores in such an order that none comes before what it was made of."""
        wanted, done, ordered = set(uris), set[str](), list[str]()
        for start in sorted(wanted):
            waiting: list[tuple[str, Iterator[str]]] = [] if start in done else [(start, iter(self.inputs_of(start)))]
            done.add(start)
            while waiting:
                uri, rest = waiting[-1]
                following = next((given for given in rest if given not in done and given in self.stores), None)
                if following is None:
                    ordered += [uri] if uri in wanted else []
                    waiting.pop()
                else:
                    done.add(following)
                    waiting.append((following, iter(self.inputs_of(following))))
        return ordered

    def named_by(self, uri: str) -> list[Run]:
        """Runs that name a store, or rest on it."""
        return self._namers.get(uri, [])

    @cached_property
    def _namers(self) -> dict[str, list[Run]]:
        found: dict[str, list[Run]] = {}
        for run in self.runs:
            for uri in self.named_and_below[run.uri]:
                found.setdefault(uri, []).append(run)
        return found

    @cached_property
    def named_and_below(self) -> dict[str, set[str]]:
        """For each run the stores that it names, and what these rest on."""
        return {run.uri: set(run.names) | self.ancestors(run.names) for run in self.runs}

    def roles(self, uri: str) -> set[str]:
        """What runs call the stage that made a store, such as capture_fine."""
        return self._roles.get(uri.rpartition("/")[2], set())

    @cached_property
    def _roles(self) -> dict[str, set[str]]:
        found: dict[str, set[str]] = {}
        for row in (row for run in self.runs for row in run.stages):
            if isinstance(row.get("key"), str) and isinstance(row.get("name"), str):
                found.setdefault(row["key"], set()).add(row["name"])
        return found

    def is_only_copy(self, uri: str) -> bool:
        """Whether a store holds raw lines that cannot be had again; simulated ones can."""
        if uri.split("/")[1] not in RAW_STAGES:
            return False
        runs, store = self.named_by(uri), self.stores.get(uri)
        if runs and not all(run.simulated for run in runs if run.settings):
            return True
        params = {} if store is None else store.params
        known = params.get("source", "sim" if "effects" in params else "rig") == "sim"
        return not (known or any(run.simulated for run in runs))


def rests_on(root: Path, refs: Iterable[StageRef]) -> list[StageRef]:
    """These stores and all that they were made of, as far as it is there, by address."""
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


def reach(starts: Iterable[str], following: Callable[[str], Iterable[str]]) -> set[str]:
    """All that can be reached, the starts themselves only where a circle leads back to them: then they are left out."""
    begun = set(starts)
    found, waiting = set(begun), list(begun)
    while waiting:
        new = set(following(waiting.pop())) - found
        found |= new
        waiting += new
    return found - begun


SHORTEST = 4  # letters of a key
LATEST = "latest"  # the newest run


def find_product(catalogue: Catalogue, text: str) -> str | Run:
    """The address of a store that is there, or a run.

    Raises ArchiveError: nothing is called so, several things are, or it could not be a name in any archive.
    """
    parts = text.rstrip("/").split("/")
    for part in parts:
        check_name(part)
    if parts[0] == "stages" and len(parts) > 2:
        return _store(catalogue, "/".join(parts[:3]))
    if parts[0] == "runs" and len(parts) > 1:
        for run in catalogue.runs:
            if run.folder.name == parts[1]:
                return run
        there = [run.uri for run in reversed(catalogue.runs)]
        hint = f"there is {_some(there)}" if there else "see ls"
        raise ArchiveError(f"there is no run {parts[1]} in this archive; {hint}")
    if len(parts) == 2 and any(uri.startswith(f"stages/{parts[0]}/") for uri in catalogue.stores):
        return _store(catalogue, "/".join(("stages", *parts)))
    runs = [run for run in catalogue.runs if text in (run.folder.name, LATEST)]
    return runs[-1] if runs else _named(catalogue, text)


def _store(catalogue: Catalogue, uri: str) -> str:
    if uri in catalogue.stores:
        return uri
    _, stage, key = uri.split("/")
    begun = [one for one in catalogue.stores if len(key) >= SHORTEST and one.startswith(uri)]
    if len(begun) == 1:
        return begun[0]
    there = sorted(begun or (one for one in catalogue.stores if one.startswith(f"stages/{stage}/")))
    hint = f"there is {_some(there)}" if there else "there is no store of this stage; see ls"
    lost = " (its folder is there, but has lost its manifest: run verify)" if uri in catalogue.lost else ""
    raise ArchiveError(f"there is no store {uri} in this archive{lost}; {hint}")


def _named(catalogue: Catalogue, text: str) -> str:
    """A product of the newest run that can be read, or a store by the beginning of its key."""
    newest = next((run for run in reversed(catalogue.runs) if run.products), None)
    products = {} if newest is None else newest.products
    if text in products:
        uri = in_text(products[text])
        if newest is not None and uri is None:
            raise ArchiveError(f"{text} is no store but a file of {newest.uri}; explain {newest.uri} tells of that run")
        return _store(catalogue, uri or text)
    keys = [uri for uri in catalogue.stores if len(text) >= SHORTEST and uri.rpartition("/")[2].startswith(text)]
    if len(keys) == 1:
        return keys[0]
    if keys:
        raise ArchiveError(f"{text} begins {len(keys)} keys: {_some(keys)}; give more of it")
    near = difflib.get_close_matches(text, products, n=1)
    if near:
        known = f"did you mean {near[0]}?"
    elif products:
        known = f"products of the newest run: {', '.join(products)}"
    else:
        known = f"no run has products; there is {_some(sorted(catalogue.stores)) or 'nothing in it'}"
    raise ArchiveError(f"{text!r} is no product, key or run of this archive; {known}")


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")

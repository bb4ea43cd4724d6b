"""Verify an archive: compare every byte with its manifest, and every manifest with its seal and its address.

A link or a pipe instead of a file is reported and never opened. The finding on a damaged file of an array names its
rows and columns.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import zarr

from storage.archive.keys import without_manifest
from storage.archive.lineage import Catalogue
from storage.archive.manifests import broken_files, listed_bytes, manifests_before, try_manifest
from storage.archive.run_folders import unfinished_extensions
from storage.archive.staging import MANIFEST_NAME, kind_of

WORDS = {"y": "rows", "x": "columns", "line": "lines", "sample": "samples", "band": "bands", "patch": "patches"}
_NO_ARRAY = (OSError, ValueError, KeyError, TypeError, IndexError, RecursionError)


def name_damage(store: Path, name: str) -> str:
    """Return the part of an array in a damaged file, as text behind its name; empty where it belongs to no array.

    For example ``(values: rows 0 to 63, columns 0 to 639)``; dimensions that the file covers are left out.
    """
    file = store / name
    inner = [path for path in file.parents if path.is_relative_to(store)]
    folder = next((path for path in inner if path != store and kind_of(path / "zarr.json") == "a file"), None)
    if folder is None or any(path.is_symlink() for path in inner):
        return ""
    try:
        array: zarr.Array[Any] = zarr.open_array(folder, mode="r", zarr_format=3)
        numbers = [int(part) for part in file.relative_to(folder).parts[1:]]  # of c/0/3/0
        sizes = zip(numbers, array.shards or array.chunks, array.shape, strict=True)
        box = [slice(number * size, min((number + 1) * size, whole)) for number, size, whole in sizes]
    except _NO_ARRAY:  # such as a store's own description
        return ""
    dims = getattr(array.metadata, "dimension_names", None) or [f"axis {axis}" for axis in range(array.ndim)]
    ranges = [
        f"{WORDS.get(dim, dim)} {part.start} to {part.stop - 1}"
        for dim, size, part in zip(dims, array.shape, box, strict=True)
        if part.stop - part.start < size
    ]
    return f" ({folder.relative_to(store).as_posix()}: {', '.join(ranges) or 'all of it'})"


Kind = Literal["whole", "broken", "missing", "stray"]
Progress = Callable[[str, float], None]  # address being read, fraction of all bytes


@dataclass(frozen=True)
class Finding:
    """Finding on one store or run; ``problem`` is None where every byte is as published.

    ``missing``: a run or store names a store that is not there. ``stray``: something that is no part of an archive.
    """

    uri: str
    problem: str | None
    kind: Kind = "whole"


def verify_everything(
    root: Path, progress: Progress | None = None, problems_of: Callable[[Path], Iterator[str]] | None = None
) -> list[Finding]:
    """Return a finding for each store and run without damage, and for each problem.

    ``problems_of`` reads one published folder whose files lie elsewhere, as in a bucket.
    """
    read_again = problems_of or _problems
    catalogue = Catalogue.read(root)
    places = [(uri, store.ref.path, store.size) for uri, store in catalogue.stores.items()]
    places += [(run.uri, run.folder, listed_bytes(run.facts) if run.facts else 0) for run in catalogue.runs]
    total, done = sum(size for *_, size in places) or 1, 0
    found: list[Finding] = []
    for uri, path, size in places:
        if progress is not None:
            progress(uri, done / total)
        done += size
        if not os.path.lexists(path) and not catalogue.named_by(uri):
            continue  # gc or a repair has cleared it away since
        problems = list(read_again(path)) + list(_identity_problems(catalogue, uri))
        if problems and _changed_since(catalogue, uri):  # its files and its manifest changed together
            catalogue = Catalogue.read(root)
            problems = list(read_again(path)) + list(_identity_problems(catalogue, uri))
        found += [Finding(uri, problem, "broken") for problem in problems]
        if not problems:
            found.append(Finding(uri, None))
    found += [*_misplaced(catalogue, root), *_missing(catalogue)]
    words = "its extension is not finished; any command that writes into the archive finishes it"
    found += [Finding(f"runs/{part.stem}", words, "stray") for part in unfinished_extensions(root)]
    return found


def _changed_since(catalogue: Catalogue, uri: str) -> bool:
    """Return whether something was added to a run after the catalogue was read."""
    run = None if uri in catalogue.stores else next((run for run in catalogue.runs if run.uri == uri), None)
    if run is None:
        return False
    return manifests_before(try_manifest(run.folder)[0]) != manifests_before(run.facts)


def _problems(folder: Path) -> Iterator[str]:
    """Yield the problems of one published folder, file by file."""
    manifest, problem = try_manifest(folder)
    if problem is not None:
        yield f"{MANIFEST_NAME} is damaged: {problem}"
        return
    for name, problem in broken_files(folder, manifest, hashes=True):
        yield f"{name} {problem}{name_damage(folder, name) if name in manifest['files'] else ''}"


def _identity_problems(catalogue: Catalogue, uri: str) -> Iterator[str]:
    """Yield whether the manifest of a store is that of another address."""
    store = catalogue.stores.get(uri)
    if store is None or store.problem is not None or kind_of(store.ref.path / MANIFEST_NAME) != "a file":
        return  # which is reported already
    stated = f"stages/{store.facts.get('stage')}/{store.facts.get('key')}"
    if stated != uri:
        yield f"its {MANIFEST_NAME} is that of {stated}; move it back, or take it out of the archive"


def _misplaced(catalogue: Catalogue, root: Path) -> Iterator[Finding]:
    """Yield findings on runs with another run's name (copies, or renamed), and on folders without a manifest."""
    there = {run.folder.name for run in catalogue.runs}
    for run in catalogue.runs:
        stated = run.facts.get("run", run.folder.name)
        if stated != run.folder.name:
            do = "it is a copy: take it out of the archive" if stated in there else "give it its name back"
            yield Finding(run.uri, f"its {MANIFEST_NAME} is that of runs/{stated}; {do}", "stray")
    for path in without_manifest(root):
        uri, kind = path.relative_to(root).as_posix(), kind_of(path)
        if kind != "a folder" or uri.count("/") < 1:
            yield Finding(uri, f"is {kind}, expected a folder with a manifest; take it out of the archive", "stray")
        else:
            yield Finding(uri, f"{MANIFEST_NAME} is missing", "broken")


def _missing(catalogue: Catalogue) -> Iterator[Finding]:
    """Yield the stores that a run or another store names and that are missing."""
    there, told = set(catalogue.stores), set[str]()
    for run in catalogue.runs:
        for uri in sorted(run.names - there - told):
            told.add(uri)
            yield Finding(uri, f"is not there, but {run.uri} names it", "missing")
    for uri in catalogue.stores:
        for given in catalogue.inputs_of(uri):
            if given not in there | told:
                told.add(given)
                yield Finding(given, f"is not there, but {uri} was made of it", "missing")

"""Verify an archive: compare every byte with its manifest, and every manifest with its seal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from spectralzoom.storage.archive.archive import Archive
from spectralzoom.storage.archive.keys import without_manifest
from spectralzoom.storage.archive.lineage import Catalogue
from spectralzoom.storage.archive.manifests import broken_files, is_cleared, listed_bytes, try_manifest
from spectralzoom.storage.archive.staging import MANIFEST_NAME

Progress = Callable[[str, float], None]  # address being read, fraction of all bytes


@dataclass(frozen=True)
class Finding:
    """Finding on one store or run; ``problem`` is None where every byte is as published.

    ``missing``: a run or store names a store that is not there. ``stray``: something that is no part of an archive.
    """

    uri: str
    problem: str | None
    kind: Literal["whole", "broken", "missing", "stray"] = "whole"


def verify_everything(archive: Archive, progress: Progress | None = None) -> list[Finding]:
    """Return a finding for each store and run without damage, and for each problem."""
    catalogue = Catalogue.read(archive.root)
    places = [(uri, store.ref.path, store.size) for uri, store in catalogue.stores.items()]
    places += [(run.uri, run.folder, listed_bytes(run.facts) if run.facts else 0) for run in catalogue.runs]
    total = sum(size for *_, size in places) or 1
    done = 0
    found: list[Finding] = []
    for uri, path, size in places:
        if progress is not None:
            progress(uri, done / total)
        done += size
        problems = list(_problems(path))
        if not path.exists() and not catalogue.named_by(uri):
            continue  # gc has removed it since
        found += [Finding(uri, problem, "broken") for problem in problems] or [Finding(uri, None)]
    for path in without_manifest(archive.root):
        uri = path.relative_to(archive.root).as_posix()
        if path.is_dir():
            found.append(Finding(uri, f"{MANIFEST_NAME} is missing", "broken"))
        else:
            found.append(Finding(uri, "expected a folder with a manifest; take it out of the archive", "stray"))
    there = set(catalogue.stores)
    reported: set[str] = set()
    for run in catalogue.runs:
        for uri in sorted(run.names - there - reported):
            reported.add(uri)
            found.append(Finding(uri, f"is not there, but {run.uri} names it", "missing"))
    for uri in catalogue.stores:
        for given in catalogue.inputs_of(uri):
            if given not in there | reported:
                reported.add(given)
                found.append(Finding(given, f"is not there, but {uri} was made of it", "missing"))
    return found


def _problems(folder: Path) -> Iterator[str]:
    """Yield the problems of one published folder, file by file."""
    manifest, problem = try_manifest(folder)
    if problem is not None:
        yield f"{MANIFEST_NAME} is damaged: {problem}"
        return
    found = [f"{name} {problem}" for name, problem in broken_files(folder, manifest, hashes=True)]
    changed = found and (is_cleared(folder) or try_manifest(folder)[0] != manifest)  # cleared meanwhile, or made anew
    yield from _problems(folder) if changed else found

"""Verify an archive: compare every byte with its manifest, and every manifest with its seal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from storage.archive.keys import without_manifest
from storage.archive.lineage import Catalogue
from storage.archive.manifests import broken_files, listed_bytes, try_manifest
from storage.archive.run_folders import unfinished_extensions
from storage.archive.staging import MANIFEST_NAME

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
        if not path.exists() and not catalogue.named_by(uri):
            continue  # gc or a repair has cleared it away since
        problems = list(read_again(path))
        found += [Finding(uri, problem, "broken") for problem in problems]
        if not problems:
            found.append(Finding(uri, None))
    found += [*_without_manifest(root), *_missing(catalogue)]
    words = "its extension is not finished; any command that writes into the archive finishes it"
    found += [Finding(f"runs/{part.stem}", words, "stray") for part in unfinished_extensions(root)]
    return found


def _problems(folder: Path) -> Iterator[str]:
    """Yield the problems of one published folder, file by file."""
    manifest, problem = try_manifest(folder)
    if problem is not None:
        yield f"{MANIFEST_NAME} is damaged: {problem}"
        return
    for name, problem in broken_files(folder, manifest, hashes=True):
        yield f"{name} {problem}"


def _without_manifest(root: Path) -> Iterator[Finding]:
    for path in without_manifest(root):
        uri = path.relative_to(root).as_posix()
        if path.is_dir():
            yield Finding(uri, f"{MANIFEST_NAME} is missing", "broken")
        else:
            yield Finding(uri, "expected a folder with a manifest; take it out of the archive", "stray")


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

"""What stays in an archive for a run, counted on the disk or in the bucket: all files of its stores and its folder."""

from __future__ import annotations

from collections.abc import Mapping

from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.records import Run


def kept_bytes(archive: Archive, run: Run, catalogue: Catalogue | None = None) -> int:
    """Bytes of all files that the archive has now for a run: its folder, the stores it names and those they rest on.

    Manifests count, and a store whose files were cleared away has its manifest alone. ``catalogue`` is of the archive,
    where it was read before.
    """
    known = Catalogue.read(archive.root) if catalogue is None else catalogue
    return sum(archive.sizes([run.uri, *known.named_and_below[run.uri]]).values())


def all_sizes(archive: Archive, catalogue: Catalogue) -> dict[str, int]:
    """Bytes of all files of every store and run, by address, also of stores that are only named."""
    below = catalogue.named_and_below
    return archive.sizes(sorted({*catalogue.stores, *below, *(uri for uris in below.values() for uri in uris)}))


def kept_by_runs(catalogue: Catalogue, sizes: Mapping[str, int]) -> dict[str, int]:
    """`kept_bytes` of all runs of a catalogue, by address; ``sizes`` are of `all_sizes`."""
    return {run: sum(sizes[uri] for uri in (run, *uris)) for run, uris in catalogue.named_and_below.items()}


def own_by_runs(catalogue: Catalogue, sizes: Mapping[str, int]) -> dict[str, int]:
    """Bytes of each run's folder and of the stores that no other run names or rests on, by its address.

    So much goes with it. ``sizes`` are of `all_sizes`.
    """
    return {
        run: sizes[run] + sum(sizes[uri] for uri in uris if len(catalogue.named_by(uri)) == 1)
        for run, uris in catalogue.named_and_below.items()
    }

"""Give stores to workers on other machines by way of a bucket."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.storage.remote.bucket import fetch_store, send_stores
from spectralzoom.storage.remote.objects import Objects
from spectralzoom.storage.store import MANIFEST, Archive, Ref, digest_of


@dataclass(frozen=True)
class FetchingWork:
    """Work on blocks that first fetches the stores it reads, into their folders, where its machine lacks them."""

    work: Callable[[Any], Any]
    refs: dict[Ref, str | None]  # with the digests that the survey has
    bucket: str

    def __call__(self, item: Any) -> Any:
        """Return the result of a block. Raises as `bucket.pull`."""
        for ref, digest in self.refs.items():
            if not ref.path.exists():
                fetch_store(ref.uri, MANIFEST, Objects(self.bucket), Archive.open(ref.path.parents[2]))
            if (found := digest_of(ref.path)) != digest:
                raise IncompleteStoreError(
                    f"{ref.path} of a worker has digest {found}, and {ref.uri} of the survey {digest}; remove that of "
                    f"the worker and of {self.bucket}, or use another bucket prefix"
                )
        return self.work(item)


class _Refs(pickle.Pickler):
    """Finds the stores that work names, wherever they stand in it."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO())
        self.found: dict[Ref, None] = {}

    def persistent_id(self, value: object) -> None:
        """Note a store, and pickle everything as usual."""
        if isinstance(value, Ref):
            self.found[value] = None


def fetching_work(work: Callable[[Any], Any], bucket: str) -> FetchingWork:
    """Send the stores that ``work`` names to a bucket that lacks them; return work that fetches them.

    Raises as `bucket.push`.
    """
    refs = _Refs()
    refs.dump(work)
    for root in {ref.path.parents[2] for ref in refs.found}:
        send_stores(Archive(root), Objects(bucket), [ref.uri for ref in refs.found if ref.path.parents[2] == root])
    return FetchingWork(work, {ref: digest_of(ref.path) for ref in refs.found}, bucket)

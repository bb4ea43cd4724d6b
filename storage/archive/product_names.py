"""What a person means by a product: an address, a key or its beginning, a run or `latest`, a name in the newest run."""

from __future__ import annotations

import difflib

from pipeline.errors import ArchiveError
from storage.archive.addresses import in_text
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.archive.staging import check_name

SHORTEST = 4  # letters of a key
LATEST = "latest"  # the newest run


def find_product(catalogue: Catalogue, text: str) -> str | Run:
    """The address of a store that is there, or a run.

    Raises
    ------
    ArchiveError : nothing is called so, several things are, or it could not be a name in any archive.
    """
    parts = text.rstrip("/").split("/")
    for part in parts:
        check_name(part)
    if parts[0] == "stages" and len(parts) > 2:
        return _store(catalogue, "/".join(parts[:3]))
    if parts[0] == "runs" and len(parts) > 1:
        return _run(catalogue, parts[1])
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


def _run(catalogue: Catalogue, name: str) -> Run:
    for run in catalogue.runs:
        if run.folder.name == name:
            return run
    there = [run.uri for run in reversed(catalogue.runs)]
    raise ArchiveError(
        f"there is no run {name} in this archive; " + (f"there is {_some(there)}" if there else "see ls")
    )


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

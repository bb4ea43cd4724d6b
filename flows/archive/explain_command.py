"""The verb `explain`: the stores that a product was made of, and what a survey would make otherwise by now."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.tree import Tree

from spectralzoom.flows.archive.commands import command
from spectralzoom.flows.archive.plan_command import dry_run
from spectralzoom.flows.archive.reprocess_command import asked_again
from spectralzoom.flows.publish.scores import warnings_of
from spectralzoom.flows.settings.flags import ArchiveName, AsJson
from spectralzoom.flows.stage import Row
from spectralzoom.flows.terminal.processes import DONE
from spectralzoom.flows.terminal.progress import put_out, show_text, show_warnings
from spectralzoom.pipeline.errors import PipelineError
from spectralzoom.storage.runs import Catalogue, Run, find_product
from spectralzoom.storage.store import Archive, plain

SHORT_KEY = 12


def explain(archive: ArchiveName, product: str, *, as_json: AsJson = False) -> int:
    """Show the lineage of a product: its stages, their keys and inputs. A run also shows what would change now.

    Parameters
    ----------
    product
        Its address (stages/rectify/KEY), a key or its beginning, a run's name or `latest`, or a product's name in the
        newest run (class_map, mosaic).
    """
    put_out(explanation(Archive.open(archive, create=False, write=False), product), show_explanation, as_json=as_json)
    return DONE


def explanation(archive: Archive, product: str) -> dict[str, Any]:
    """Return the lineage of a product as nested tables. Raises ArchiveError: there is no such product."""
    catalogue = Catalogue.read(archive)
    found = find_product(catalogue, product)
    if not isinstance(found, Run):
        runs = [run.uri for run in catalogue.named_by(found)]
        return {"archive": archive.name, "product": found, "runs": runs, "lineage": [_tree(catalogue, found, set())]}
    shown: set[str] = set()
    below = {one for uri in found.names & catalogue.stores.keys() for one in catalogue.stores[uri]["inputs"]}
    return {
        "archive": archive.name,
        "product": found.uri,
        "warnings": warnings_of(found.receipt),
        "problem": found.problem,
        "command": command(found.settings, archive.name),
        "lineage": [_tree(catalogue, uri, shown) for uri in sorted(found.names - below)],
        "differs": differences(catalogue, found, archive),
    }


def _tree(catalogue: Catalogue, uri: str, shown: set[str]) -> dict[str, Any]:
    """Return a store and its inputs; the inputs of a store in ``shown`` are left out."""
    store = catalogue.stores.get(uri)
    if store is None:
        return {"uri": uri, "problem": "is not there", "inputs": []}
    node = {
        "uri": uri,
        "stage": uri.split("/")[1],
        "key": uri.split("/")[2],
        "version": str(store.get("version", "")),
        "cleared": store["cleared"],
        "called": sorted(catalogue.called(uri)),
        "problem": store["problem"],
        "inputs": [],
    }
    if uri in shown:
        return node | {"see": "above"}
    shown.add(uri)
    return node | {"inputs": [_tree(catalogue, one, shown) for one in store["inputs"]]}


def differences(catalogue: Catalogue, run: Run, archive: Archive) -> dict[str, list[str]]:
    """Return what a survey of a run's settings would make otherwise by now, by stage.

    A stage whose inputs alone differ is left out. ``run`` has the error of settings that cannot be surveyed again.
    """
    try:
        rows = dry_run(asked_again(run, archive.name, None))[1].rows
    except PipelineError as error:
        return {"run": [str(error)]}
    keys = {str(row.get("name")): str(row.get("key")) for row in run.stages}
    found = {}
    for name, row in rows.items():
        made = catalogue.stores.get(f"stages/{row.ref.stage}/{keys.get(name)}")
        if row.ref.key and row.ref.key != keys.get(name):
            found[name] = ["the run has no such store"] if made is None else list(_changes(made, row))
    return {name: words for name, words in found.items() if words}


def _changes(made: Mapping[str, Any], row: Row) -> Iterator[str]:
    """Yield version and parameters of a store that its stage would have otherwise now."""
    if made.get("version") != row.version:
        yield f"version {made.get('version')}, now {row.version}"
    before, now = _flat(made["params"]), _flat(plain(row.params))
    for name in sorted(before.keys() | now.keys()):
        if before.get(name) != now.get(name):
            yield f"{name} {before.get(name)}, now {now.get(name)}"


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """Return nested tables as one, with names such as camera.exposure_ms."""
    if not isinstance(value, Mapping):
        return {name: value}
    return {
        key: one for part, inner in value.items() for key, one in _flat(inner, f"{name}.{part}".lstrip(".")).items()
    }


def show_explanation(content: dict[str, Any], console: Console) -> None:
    """Print warnings about a run's map, a product's lineage, and what would be made otherwise."""
    show_warnings(content.get("warnings", ()), console)
    for text in (content["product"], content.get("problem"), content.get("command")):
        if text:
            show_text(text, console)
    for node in content["lineage"]:
        console.print(_branch(node, None))
    for name, words in content.get("differs", {}).items():
        show_text(f"otherwise by now: {name}: {'; '.join(words)}", console)
    if "runs" in content:
        named = ", ".join(content["runs"]) or "no run: gc --dry-run lists what it would remove"
        show_text(f"named by {named}", console)


def _branch(node: Mapping[str, Any], parent: Tree | None) -> Tree:
    text = _format_node(node)
    tree = Tree(text) if parent is None else parent.add(text)
    for one in node["inputs"]:
        _branch(one, tree)
    return tree


def _format_node(node: Mapping[str, Any]) -> str:
    if "stage" not in node:
        return f"[bold red]{escape(node['uri'])} {escape(node['problem'])}[/]"
    name = f"[bold]{escape(node['stage'])}[/] {escape(node['key'][:SHORT_KEY])}"
    called = [word for word in node["called"] if word != node["stage"]]
    name += f" [dim]({escape(', '.join(called))})[/]" if called else ""
    if node["problem"] is not None:
        return f"{name} [bold red]damaged: {escape(node['problem'])}[/]"
    if "see" in node:
        return f"{name} [dim]{node['see']}[/]"
    cleared = ", cleared away, made again if needed" if node["cleared"] else ""
    return f"{name} version {escape(node['version'])}{cleared}"

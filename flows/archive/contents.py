"""What an archive holds, as plain tables: runs and stores, a product's lineage, what is broken and what remakes it."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from flows.survey.scores import score_of
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue, changes_between, find_product, version_before
from storage.archive.records import Run, Store
from storage.maintenance.repair import plan_repair
from storage.maintenance.verification import Finding

DEEPEST = 60  # levels of a lineage that are shown


def contents(archive: Archive, now: datetime | None = None) -> dict[str, Any]:
    """Runs, newest last, and stores by stage, oldest first, of an archive."""
    catalogue, moment = Catalogue.read(archive.root), now or datetime.now(UTC)
    stages: dict[str, list[dict[str, Any]]] = {}
    for store in sorted(catalogue.stores.values(), key=lambda store: (store.ref.stage, store.created, store.ref.key)):
        stages.setdefault(store.ref.stage, []).append(_store_row(catalogue, store, moment))
    return {
        "archive": archive.name,
        "runs": [{**_run_row(catalogue, run), "age_s": _age_s(run.created, moment)} for run in catalogue.runs],
        "stages": stages,
        "bytes": sum(store.size for store in catalogue.stores.values()),
        "lost": list(catalogue.lost),
    }


def _run_row(catalogue: Catalogue, run: Run) -> dict[str, Any]:
    receipt, settings = run.receipt, run.settings
    below = catalogue.named_and_below[run.uri]
    return {
        "id": run.folder.name,
        "created": run.created,
        "survey": receipt.get("survey", run.facts.get("survey")),
        "scene": settings.get("scene"),
        "seed": settings.get("seed"),
        "budget": settings.get("budget"),
        **score_of(receipt),
        "accuracy_is": receipt.get("accuracy_is"),
        "bytes": sum(catalogue.stores[uri].size for uri in below if uri in catalogue.stores),
        "state": _run_state(catalogue, run, below),
    }


def _run_state(catalogue: Catalogue, run: Run, below: Iterable[str]) -> str:
    """Told from manifests alone: verify reads every byte."""
    missing = [uri for uri in below if uri not in catalogue.stores]
    damaged = [uri for uri in below if uri in catalogue.stores and catalogue.stores[uri].problem is not None]
    if run.problem is not None:
        return "damaged"
    if missing or damaged:
        counts = ((len(missing), "missing"), (len(damaged), "damaged"))
        return " and ".join(f"{count} {word}" for count, word in counts if count)
    return "there"


def _store_row(catalogue: Catalogue, store: Store, now: datetime) -> dict[str, Any]:
    return {
        "key": store.ref.key,
        "version": store.version,
        "created": store.created,
        "age_s": _age_s(store.created, now),
        "bytes": store.size,
        "runs": len(catalogue.named_by(store.ref.uri)),
        "problem": store.problem,
    }


def _age_s(created: str, now: datetime) -> float | None:
    try:
        return (now - datetime.fromisoformat(created)).total_seconds()
    except (ValueError, TypeError):
        return None


def explanation(archive: Archive, product: str) -> dict[str, Any]:
    """Lineage of a product as nested tables, and what changed since the version before it.

    Raises
    ------
    ArchiveError : there is no such product.
    """
    catalogue = Catalogue.read(archive.root)
    found = find_product(catalogue, product)
    if isinstance(found, Run):
        below = set[str]().union(*(catalogue.ancestors([uri]) for uri in found.names))
        shown: set[str] = set()
        trees = [_tree(catalogue, uri, shown, ()) for uri in sorted(found.names - below)]
        row = {**_run_row(catalogue, found), "problem": found.problem, "command": command(found.settings, archive.name)}
        return {"archive": archive.name, "product": found.uri, "run": row, "lineage": trees}
    this, before = catalogue.stores[found], version_before(catalogue, found)
    return {
        "archive": archive.name,
        "product": found,
        "runs": [run.uri for run in catalogue.named_by(found)],
        "lineage": [_tree(catalogue, found, set(), ())],
        "before": None if before is None else before.ref.uri,
        "changes": [] if before is None else [asdict(one) for one in changes_between(catalogue, before, this)],
    }


def _tree(catalogue: Catalogue, uri: str, shown: set[str], path: tuple[str, ...]) -> dict[str, Any]:
    """One store and below it what it was made of; what was shown already is not opened again."""
    store = catalogue.stores.get(uri)
    if store is None:
        return {"uri": uri, "problem": "is not there", "inputs": []}
    wall, cpu = _took(catalogue, store)
    node = {
        "uri": uri,
        "stage": store.ref.stage,
        "key": store.ref.key,
        "version": store.version,
        "called": sorted(catalogue.roles(uri)),
        "created": store.created,
        "bytes": store.size,
        "wall_s": wall,
        "cpu_s": cpu,
        "problem": store.problem,
        "inputs": [],
    }
    if uri in shown or uri in path or len(path) >= DEEPEST:
        return node | {"see": "in a circle" if uri in path else "above" if uri in shown else "too deep"}
    shown.add(uri)
    return node | {"inputs": [_tree(catalogue, one, shown, (*path, uri)) for one in catalogue.inputs_of(uri)]}


def _took(catalogue: Catalogue, store: Store) -> tuple[float | None, float | None]:
    """Wall and CPU seconds of the making, by the manifest or by the receipt of the run that made it."""
    if store.cost is not None:
        return store.cost.wall_s, store.cost.cpu_s
    rows = [row for run in catalogue.runs for row in run.stages if row.get("key") == store.ref.key]
    ran = next((row for row in rows if row.get("state") == "ran"), {})
    return _number(ran.get("wall_s")), _number(ran.get("cpu_s"))


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def verdict(archive: Archive, findings: list[Finding], versions: Mapping[str, int]) -> dict[str, Any]:
    """What verification found, and for what is broken what a repair would do."""
    bad = [finding for finding in findings if finding.problem is not None]
    places = {finding.uri for finding in findings if finding.kind in ("whole", "broken", "unreadable")}
    broken = {finding.uri for finding in bad if finding.kind == "broken"}
    content: dict[str, Any] = {
        "archive": archive.name,
        "checked": len(places),
        "whole": len(places - broken),
        "problems": [asdict(finding) for finding in bad],
    }
    if bad:
        plan = plan_repair(archive, bad, versions=versions)
        content["to_remake"] = list(plan.remade)
        content["hopeless"] = plan.hopeless
        content["surveys"] = [
            {"run": run.uri, "command": command(settings, archive.name)} for run, settings in plan.surveys
        ]
    return content


def command(settings: Mapping[str, Any], out: str) -> str:
    """The command that asks for these settings in the archive ``out``, as far as flags can say it; empty without any.

    The archive may have been moved since: what its receipt calls ``out`` is not said.
    """
    if not settings:
        return ""
    settings = {**settings, "out": out}
    from flows.settings.survey_settings import Settings

    defaults = Settings().to_dict()
    words = ["spectralzoom", "survey"]
    for name, usual in defaults.items():
        value = settings.get(name, usual)
        if value != usual and not isinstance(value, dict) and value is not None:
            words += _flag(name.replace("_", "-"), value)
    tables = [name for name, value in settings.items() if isinstance(value, dict) and value != defaults.get(name)]
    more = [f"with [{'], ['.join(tables)}] as in its receipt"] if tables else []
    more += ["it had two rounds of detail, which are no more"] if "rounds" in settings else []
    return shlex.join(words) + (f"  ({'; '.join(more)})" if more else "")


def _flag(name: str, value: object) -> list[str]:
    if isinstance(value, bool):
        return [f"--{name}" if value else f"--no-{name}"]
    between = "x" if name == "size" else ","
    return [f"--{name}", between.join(map(str, value)) if isinstance(value, list) else str(value)]

"""The history of a field: its runs and what its ledger says, oldest first, as plain rows for a page."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from flows.publish.receipt import areas_on_ground
from flows.schedule.field_schedule import ENDINGS, read_moment
from flows.survey.scores import score_of
from flows.terminal.figures import known_number
from pipeline.errors import ArchiveError
from storage.archive.archive import Archive
from storage.archive.ledger import Ledger, ledgers
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.arrays.class_maps import load_class_map, load_class_names


@dataclass(frozen=True)
class FieldHistory:
    """What is known of one field. ``events``: endings and passed-over times of its ledger; ``runs``: rows by run."""

    field: str
    archive: str
    runs: Sequence[Mapping[str, Any]]
    events: Sequence[Mapping[str, Any]]

    @property
    def counts(self) -> dict[str, int]:
        found = dict.fromkeys(ENDINGS, 0)
        for event in self.events:
            if event["event"] == "passed":
                found["skipped"] += event.get("count") or 0
            else:
                found[event["event"]] += 1
        return found

    def to_dict(self) -> dict[str, Any]:
        return {
            "field": self.field,
            "archive": self.archive,
            "counts": self.counts,
            "runs": list(self.runs),
            "events": list(self.events),
        }


def read_histories(archive: Archive, field: str | None = None) -> list[FieldHistory]:
    """The histories of all fields by name, or of one. Raises ArchiveError: no field is called so."""
    catalogue = Catalogue.read(archive.root)
    kept = {ledger.field: ledger for ledger in ledgers(archive.root)}
    names = sorted({*kept, *(called(run) for run in catalogue.runs)})
    if field is not None and field not in names:
        near = difflib.get_close_matches(field, names, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(names) or 'none'}"
        raise ArchiveError(f"no field of {archive.name} is called {field!r}; {hint}")
    wanted = names if field is None else [field]
    return [_history(archive, catalogue, name, kept.get(name)) for name in wanted]


def called(run: Run) -> str:
    """The field that a run is of."""
    return str(run.receipt.get("survey") or run.facts.get("survey") or run.folder.name)


def _history(archive: Archive, catalogue: Catalogue, name: str, ledger: Ledger | None) -> FieldHistory:
    lines = [] if ledger is None else ledger.lines()
    events = [line for line in lines if line.get("event") in (*ENDINGS, "passed")]
    by_run = {line["run"]: line for line in events if isinstance(line.get("run"), str)}
    rows = [
        _row(archive, catalogue, run, by_run.get(run.uri, {}))
        for run in catalogue.runs
        if run.uri in by_run or called(run) == name
    ]
    return FieldHistory(name, archive.name, rows, events)


def _row(archive: Archive, catalogue: Catalogue, run: Run, line: Mapping[str, Any]) -> dict[str, Any]:
    receipt = run.receipt
    savings = found if isinstance(found := receipt.get("savings"), Mapping) else {}
    shares, unit = _areas(archive, catalogue, run)
    colours: dict[str, str] = {}  # in which the run's map shows its classes, as CSS writes them
    if (address := run.products.get("class_map")) is not None:
        with suppress(OSError, LookupError, ValueError):
            shown = load_class_names(archive.locate(address))
            hexes = [f"#{bytes(map(int, rgb)).hex()}" for rgb in shown.colours]
            colours = dict(zip(shown.names, hexes, strict=False))
    return {
        "run": run.uri,
        "created": run.created,
        "due": line.get("due"),
        "attempts": line.get("attempts"),
        **score_of(receipt),
        "savings": {
            name: known_number(entry.get("ratio")) if isinstance(entry := savings.get(name), Mapping) else None
            for name in ("capture_s", "lines", "bytes_stored", "multiply_adds")
        },
        "areas": shares,
        "colours": colours,
        "unit": unit,
        "problem": run.problem,
    }


def _areas(archive: Archive, catalogue: Catalogue, run: Run) -> tuple[dict[str, float], str]:
    """What each class covers: hectares where the survey was put on the ground, else shares of the map."""
    hectares = areas_on_ground(run.receipt)
    if hectares is not None:
        return {str(name): float(area) for name, area in hectares.items() if known_number(area) is not None}, "ha"
    address = run.products.get("class_map")
    store = None if address is None else catalogue.stores.get("/".join(address.split("/")[:3]))
    if address is None or store is None or store.problem is not None:
        return {}, "share"
    try:
        found = load_class_map(archive.locate(address))
    except (OSError, LookupError, ValueError):
        return {}, "share"
    counts = {name: int((found.classes == number).sum()) for number, name in enumerate(found.names)}
    total = sum(counts.values()) or 1
    return {name: count / total for name, count in counts.items()}, "share"


def day_of(row: Mapping[str, Any]) -> float | None:
    """When a row's run was due or else published, in seconds since 1970; None where that is not known."""
    moment = read_moment(row.get("due")) or read_moment(row.get("created"))
    return None if moment is None else moment.timestamp()

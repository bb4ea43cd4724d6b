"""List, verify and clear up archives: the verbs `ls`, `verify` and `gc`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any

from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.publish.scores import score_of, warnings_of
from spectralzoom.flows.settings.flags import ArchiveName, AsJson, Switch
from spectralzoom.flows.settings.load import flag_of
from spectralzoom.flows.settings.rules import OF_THE_PLAN
from spectralzoom.flows.settings.settings import Settings, to_state
from spectralzoom.flows.settings.values import ALWAYS, RECORDED
from spectralzoom.flows.terminal.figures import DASH, counted, format_bytes, format_points
from spectralzoom.flows.terminal.processes import DONE, FAILED, PARTLY
from spectralzoom.flows.terminal.progress import StageProgress, put_out, show_text, stderr, table
from spectralzoom.pipeline.errors import shortened
from spectralzoom.storage.runs import Catalogue, Finding, Run, clear_up, verify_everything
from spectralzoom.storage.store import Archive, descendants

SHORT_KEY = 12
WHOLE = ("when", "key", "seed", "budget", "mIoU", "size", "own", "state", "stage", "what")  # never folded
MOST_SHOWN = 60  # characters of a scene, a seed and a budget
MOST_ROWS = 20  # stores of a stage, removals


def ls(archive: ArchiveName, *, as_json: AsJson = False) -> int:
    """List the runs and stores of an archive with their scene, score and size."""
    put_out(contents(Archive.open(archive, create=False, write=False)), show_contents, as_json=as_json)
    return DONE


def verify(archive: ArchiveName, *, as_json: AsJson = False) -> int:
    """Read every byte of an archive again and compare it with its manifests.

    It names damaged stores and what was made of them, and the commands that remove them and make them again.
    """
    opened = Archive.open(archive, create=False, write=False)
    findings = _verified(opened)
    put_out(verdict(opened, findings), show_verdict, as_json=as_json)
    return DONE if all(finding.problem is None for finding in findings) else FAILED


def _verified(archive: Archive) -> list[Finding]:
    with StageProgress(stderr, {"verify": "reading again"}) as bars:
        findings = verify_everything(archive, lambda uri, fraction: bars.show("verify", fraction, uri))
        bars.show("verify", 1.0, ended=True)
    return findings


def gc(
    archive: ArchiveName,
    *,
    keep_days: float = 1.0,
    raw_too: Switch = False,
    damaged: Switch = False,
    dry_run: Switch = False,
    as_json: AsJson = False,
) -> int:
    """Remove stores that no run rests on, or damaged ones.

    Parameters
    ----------
    keep_days
        Stores younger than this stay: an unfinished survey may need them.
    raw_too
        Also remove raw lines of a rig that no run names; they cannot be captured again.
    damaged
        Instead, read every byte as `verify` does, and remove damaged stores, what was made of them, and damaged runs.
        The surveys of these stores make them again.
    dry_run
        Only print what would be removed, and its size.
    """
    opened = Archive.open(archive, create=False, write=not dry_run)
    findings = _verified(opened) if damaged else None
    with StageProgress(stderr, {"gc": "clearing up"}) as bars:
        done = clear_up(
            opened,
            keep_days=keep_days,
            raw_too=raw_too,
            damaged=findings,
            dry_run=dry_run,
            progress=lambda removal, fraction: bars.show("gc", fraction, removal.uri),
        )
    content = {
        "archive": opened.name,
        "dry_run": dry_run,
        "bytes": done.size,
        "removals": [removal._asdict() for removal in done.removals],
        "kept": done.kept,
        "obstacle": done.obstacle,
    }
    put_out(content, show_clearance, as_json=as_json)
    return PARTLY if done.obstacle is not None or (damaged and done.kept) else DONE


def contents(archive: Archive) -> dict[str, Any]:
    """Return the runs of an archive, newest last, and its stores by stage, oldest first."""
    catalogue = Catalogue.read(archive)
    of_runs = (uri for run in catalogue.runs for uri in (run.uri, *run.names))  # also of stores that are missing
    sizes = {uri: archive.size_of(uri) for uri in sorted({*catalogue.stores, *of_runs})}
    stages: dict[str, list[dict[str, Any]]] = {}
    for uri, store in sorted(catalogue.stores.items(), key=lambda one: (one[1]["created"], one[0])):
        _, stage, key = uri.split("/")
        row = {
            "key": key,
            "version": str(store.get("version", "")),
            "created": store["created"],
            "bytes": sizes[uri],  # with its manifest
            "cleared": store["cleared"],
            "runs": len(catalogue.named_by(uri)),
            "problem": store["problem"],
        }
        stages.setdefault(stage, []).append(row)
    return {
        "archive": archive.name,
        "runs": [
            _run_row(catalogue, run, sum(sizes[uri] for uri in (run.uri, *run.names)))
            | {
                # would go with the run: its folder, and the stores that no other run needs
                "own_bytes": sizes[run.uri] + sum(sizes[uri] for uri in run.names if len(catalogue.named_by(uri)) == 1)
            }
            for run in catalogue.runs
        ],
        "stages": dict(sorted(stages.items())),
        "bytes": sum(sizes.values()),
        "shared_bytes": sum(size for uri, size in sizes.items() if len(catalogue.named_by(uri)) > 1),
    }


def _run_row(catalogue: Catalogue, run: Run, kept: int) -> dict[str, Any]:
    return {
        "id": run.folder.name,
        "created": run.created,
        "survey": run.receipt.get("survey", run.facts.get("survey")),
        **{name: run.settings.get(name) for name in ("scene", "seed", "budget")},
        **score_of(run.receipt),
        "training_scene": run.receipt.get("training_scene"),
        "warnings": warnings_of(run.receipt),
        "bytes": kept,
        "state": _run_state(catalogue, run),
    }


def _run_state(catalogue: Catalogue, run: Run) -> str:
    """Return the state of a run by its manifests alone."""
    if run.problem is not None:
        return "damaged"
    stores = [catalogue.stores.get(uri) for uri in run.names]
    damaged = sum(store is not None and store["problem"] is not None for store in stores)
    counts = ((stores.count(None), "missing"), (damaged, "damaged"))
    return " and ".join(f"{count} {word}" for count, word in counts if count) or "there"


def verdict(archive: Archive, findings: list[Finding]) -> dict[str, Any]:
    """Return problems, stores made of damaged ones, and the commands that remove them and make them again."""
    bad = [finding for finding in findings if finding.problem is not None]
    places = {finding.uri for finding in findings if finding.kind in ("whole", "broken", "missing")}
    damaged = {finding.uri for finding in bad if finding.kind in ("broken", "missing")}
    content: dict[str, Any] = {
        "archive": archive.name,
        "checked": len(places),
        "whole": len(places - damaged),
        "problems": [finding._asdict() for finding in bad],
    }
    if damaged:
        catalogue = Catalogue.read(archive)
        below = set(descendants(catalogue.stores, damaged))
        runs = [run for run in catalogue.runs if run.uri in damaged or run.names & (damaged | below)]
        surveys = {command(run.settings, archive.name): run.uri for run in runs if run.settings}
        content |= {
            "made_of_them": sorted(below),
            "removal": shlex.join(["spectralzoom", "gc", archive.name, "--damaged"]),
            "surveys": [{"run": uri, "command": words} for words, uri in surveys.items()],
        }
    return content


def command(settings: Mapping[str, Any], out: str) -> str:
    """Return the command line of these settings into the archive ``out``.

    A chosen uniform scan stands for the time that it was chosen by. Recorded lines have their own exposures.
    Two passes of recorded lines that state an exposure repeat the plan of their run.
    """
    if not settings:
        return ""
    chosen = settings.get("scan_step") and settings.get("zoom") != ALWAYS
    left_out: set[str] = {"seconds"} if chosen else set()
    if settings.get("source") == RECORDED:
        repeated = settings.get("scan_exposure_ms") is not None and not chosen
        left_out |= {"scan_exposure_ms", *(OF_THE_PLAN if repeated else ())}
    asked = {name: one for name, one in settings.items() if name in Settings.model_fields and name not in left_out}
    parts = ["spectralzoom", "survey"]
    for name, value in to_state({**asked, "out": out}).items():
        if isinstance(value, bool):
            parts.append(flag_of(name, off=not value))
        else:
            joint = "x" if name == "size" else ","
            text = joint.join(map(str, value)) if isinstance(value, list) else str(value)
            parts += [f"{flag_of(name)}={text}"] if text.startswith("-") else [flag_of(name), text]
    return shlex.join(parts)


def show_contents(content: dict[str, Any], console: Console) -> None:
    """Print the content of an archive."""
    columns: Sequence[str] = ("run", "scene", "seed", "budget", "mIoU", "own", "state")
    runs = map(_shown_run, content["runs"])
    console.print(table(columns, runs, title="Runs", left=2, whole=WHOLE) if content["runs"] else "no runs")
    if any(run["training_scene"] and run["miou"] is not None for run in content["runs"]):
        console.print("* on a scene that the weights were trained on", highlight=False)
    if any(run["warnings"] for run in content["runs"]):
        console.print("! with a warning about its map: spectralzoom explain ARCHIVE RUN", highlight=False)
    rows = [row for stage, stores in content["stages"].items() for row in _shown_stores(stage, stores)]
    columns = ("stage", "key", "version", "size", "named by")
    console.print(table(columns, rows, title="Stores", left=3, whole=WHOLE) if rows else "no stores")
    count = counted(sum(map(len, content["stages"].values())), "store")
    shared = f", {format_bytes(content['shared_bytes'])} shared by several runs" if content["shared_bytes"] else ""
    show_text(f"{counted(len(content['runs']), 'run')}, {count}, {format_bytes(content['bytes'])}{shared}", console)


def _shown_run(run: Mapping[str, Any]) -> list[str]:
    miou = run["miou"]
    asked = [DASH if run[name] is None else shortened(str(run[name]), MOST_SHOWN) for name in ("seed", "budget")]
    state = run["state"] if run["state"] == "there" else f"[bold red]{escape(run['state'])}[/]"
    marks = ("" if run["training_scene"] is None or miou is None else "*") + "!" * bool(run["warnings"])
    return [
        *map(escape, (run["id"], shortened(PurePath(str(run["scene"] or DASH)).name, MOST_SHOWN), *asked)),
        format_points(miou) + marks,
        format_bytes(run["own_bytes"]),
        state,
    ]


def _shown_stores(stage: str, stores: Sequence[Mapping[str, Any]]) -> Iterator[list[str]]:
    for number, row in enumerate(stores[-MOST_ROWS:]):
        size = "cleared" if row["cleared"] else format_bytes(row["bytes"])
        size = "[bold red]damaged[/]" if row["problem"] else size
        name = escape(stage) if number == 0 else ""
        yield [name, escape(row["key"]), escape(row["version"]), size, str(row["runs"] or "none")]
    if len(stores) > MOST_ROWS:
        yield ["", f"[dim]and {len(stores) - MOST_ROWS} older[/]"]


def show_clearance(content: dict[str, Any], console: Console) -> None:
    """Print what `gc` removed or would remove."""
    verb = "would go" if content["dry_run"] else "went"
    for removal in content["removals"][:MOST_ROWS]:
        show_text(f"{removal['uri']}  {format_bytes(removal['size'])}  {removal['why']}", console)
    if len(content["removals"]) > MOST_ROWS:
        show_text(f"and {len(content['removals']) - MOST_ROWS} more", console)
    for reason in dict.fromkeys(content["kept"].values()):
        count = sum(why == reason for why in content["kept"].values())
        show_text(f"{counted(count, 'store')} {'stays' if count == 1 else 'stay'}: {reason}", console)
    if content["obstacle"] is not None:
        console.print(f"[bold yellow]{escape(content['obstacle'])}[/]", soft_wrap=True)
    show_text(f"{len(content['removals'])} things {verb}, {format_bytes(content['bytes'])}", console)


def show_verdict(content: dict[str, Any], console: Console) -> None:
    """Print the summary of a verification, and the commands that remove damaged stores and make them again."""
    for finding in content["problems"]:
        console.print(f"[bold red]{escape(finding['uri'])}[/]: {escape(finding['problem'])}", soft_wrap=True)
    for uri in content.get("made_of_them", ()):
        show_text(f"{uri}: was made of them", console)
    if any(finding["kind"] == "broken" for finding in content["problems"]):
        show_text(f"this removes damaged stores, and what was made of them: {content['removal']}", console)
    for survey in content.get("surveys", ()):
        show_text(f"this makes the stores of {survey['run']} again: {survey['command']}", console)
    show_text(f"{content['whole']} stores and runs are as published, out of {content['checked']}", console)

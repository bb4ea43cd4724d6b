"""Write histories of fields, their runs from the oldest on, as pages with charts: `spectralzoom report`."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rich.markup import escape

from flows.archive.field_visits import (
    Chart,
    VisitPicture,
    line_chart,
    look_of,
    moment_words,
    read_moment,
    visit_pictures,
)
from flows.archive.stale_runs import called
from flows.cli.app import ArchiveName, AsJson, OutFile, check_outside, stderr
from flows.publish.receipt import areas_on_ground
from flows.publish.report import render_page
from flows.tasks.scores import score_of
from flows.terminal.figures import DASH, LEAST_HECTARES, area_words, counted, format_percent, known_number
from flows.terminal.processes import DONE
from flows.terminal.progress import print_json
from pipeline.errors import ArchiveError, SettingsError
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.archive.whole_files import write_whole
from storage.arrays.class_maps import load_class_map, load_class_names
from storage.remote.opening import open_archive


@dataclass(frozen=True)
class FieldHistory:
    """The runs of one field, as rows, and pictures of its visits."""

    field: str
    archive: str
    runs: Sequence[Mapping[str, Any]]
    visits: Sequence[VisitPicture] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return what is written as JSON."""
        return {"field": self.field, "archive": self.archive, "runs": list(self.runs)}


def read_histories(archive: Archive, field: str | None = None) -> list[FieldHistory]:
    """Return the histories of all fields by name, or of one. Raises ArchiveError: no field is called so."""
    catalogue = Catalogue.read(archive.root)
    names = sorted({called(run) for run in catalogue.runs})
    if field is not None and field not in names:
        near = difflib.get_close_matches(field, names, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(names) or 'none'}"
        raise ArchiveError(f"no field of {archive.name} is called {field!r}; {hint}")
    wanted = names if field is None else [field]
    return [_history(archive, catalogue, name) for name in wanted]


def _history(archive: Archive, catalogue: Catalogue, name: str) -> FieldHistory:
    own = [run for run in catalogue.runs if called(run) == name]
    rows = [_row(archive, catalogue, run) for run in own]
    found = sorted(zip(own, rows, strict=True), key=lambda one: day_of(one[1]) or 0.0)
    visits = visit_pictures(archive, [(run, _called(row)) for run, row in found])
    return FieldHistory(name, archive.name, [row for _, row in found], visits)


def _called(row: Mapping[str, Any]) -> str:
    """What a visit is called, and when it was where its name does not say so."""
    when = _short(str(row["looked"] or row["created"]))
    visit = str(row["visit"] or "")
    return when if not visit or read_moment(visit) is not None else f"{visit}, {when}"


def _row(archive: Archive, catalogue: Catalogue, run: Run) -> dict[str, Any]:
    receipt = run.receipt
    savings = found if isinstance(found := receipt.get("savings"), Mapping) else {}
    shares, unit = _covered(archive, catalogue, run)
    colours: dict[str, str] = {}  # in which the run's map shows its classes, as CSS writes them
    if (address := run.products.get("class_map")) is not None:
        with suppress(OSError, LookupError, ValueError):
            shown = load_class_names(archive.locate(address))
            hexes = [f"#{bytes(map(int, rgb)).hex()}" for rgb in shown.colours]
            colours = dict(zip(shown.names, hexes, strict=False))
    return {
        "run": run.uri,
        "created": run.created,
        "visit": run.settings.get("visit"),
        "looked": None if (at := look_of(run)) is None else moment_words(at),
        "capture_seconds": _seconds(savings),
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


def _seconds(savings: Mapping[str, Any]) -> dict[str, float | None]:
    """Seconds at the camera, of this run and of scanning everything."""
    entry = savings.get("capture_s")
    told = entry if isinstance(entry, Mapping) else {}
    return {"done": known_number(told.get("done")), "full": known_number(told.get("full"))}


def _covered(archive: Archive, catalogue: Catalogue, run: Run) -> tuple[dict[str, float], str]:
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
    """When a row's run looked or else was published, in seconds since 1970; None where that is not known."""
    moment = next((at for name in ("looked", "created") if (at := read_moment(row.get(name))) is not None), None)
    return None if moment is None else moment.timestamp()


MOST_ROWS = 1000  # of each table; older ones are counted
PLAYER_SCRIPTS = ("scripts/swipe.js", "scripts/player.js")
SAVINGS = {"capture_s": "time at the camera", "lines": "lines", "bytes_stored": "stored data", "multiply_adds": "model"}
SCORES = {"miou": "mIoU", "overall_accuracy": "overall"}
Rows = Sequence[Mapping[str, Any]]


def report(archive: ArchiveName, *, field: str | None = None, out: OutFile, as_json: AsJson = False) -> int:
    """Write a field's history as one page that opens from disk: dates, class areas, savings.

    Parameters
    ----------
    field
        What it is called; without one an index of all fields is written, beside a page for each.
    out
        The page to write.
    """
    opened = open_archive(archive, create=False, write=False)
    page = check_outside(out, opened.root)
    if page.is_dir():
        raise SettingsError(f"--out {out} is a folder, expected the file to write, such as {out}/history.html")
    if page.suffix.lower() not in (".html", ".htm"):
        raise SettingsError(f"--out {out}: expected a page's name that ends in .html")
    with stderr.status("reading the archive"):
        histories = read_histories(opened, field)
    names = {one.field: page.name if field else f"{page.stem}-{one.field}{page.suffix}" for one in histories}
    written = []
    for one in histories:
        written.append(page.with_name(names[one.field]))
        write_whole(written[-1], render_history(one, "" if opened.in_bucket else way_to(opened.root, written[-1])))
    content = (
        histories[0].to_dict() if field else {"archive": opened.name, "fields": [one.to_dict() for one in histories]}
    )
    if not field:
        write_whole(page, render_index(histories, opened.name, names))
        written.append(page)
    stderr.print(f"  {escape(str(written[-1]))}", soft_wrap=True)
    if as_json:
        print_json({**content, "pages": [str(path) for path in written]})
    return DONE


def render_history(history: FieldHistory, runs_at: str) -> str:
    """The page; ``runs_at`` is the way from it to the archive's folder, empty where there is none."""
    return render_page(
        "history.html",
        PLAYER_SCRIPTS if history.visits else (),
        kicker="SpectralZoom field",
        title=history.field,
        lead=f"{counted(len(history.runs), 'run')} in the archive.",
        about=f"{history.archive}; times in UTC",
        areas=_areas(history.runs),
        savings=_savings(history.runs),
        visits=[asdict(one) for one in history.visits],
        runs=[_run(row, runs_at) for row in reversed(history.runs[-MOST_ROWS:])],
        older_runs=len(history.runs) - MOST_ROWS,
    )


def render_index(histories: Sequence[FieldHistory], archive: str, pages: Mapping[str, str]) -> str:
    """Return a page of all fields of an archive; ``pages`` are the files of their histories."""
    return render_page(
        "fields.html",
        kicker="SpectralZoom archive",
        title="Fields",
        lead=f"{counted(len(histories), 'field')}.",
        about=f"{archive}; times in UTC",
        fields=[
            {
                "name": one.field,
                "page": pages[one.field],
                "runs": len(one.runs),
                "newest": _short(max((str(row["created"]) for row in one.runs), default="")) or DASH,
            }
            for one in histories
        ],
    )


@dataclass(frozen=True)
class ClassCharts:
    """Charts of the classes' areas, one each with a scale of its own: a class of few pixels is seen too."""

    title: str
    charts: Sequence[Chart]


def _areas(runs: Rows) -> list[ClassCharts]:
    """Areas on the ground in hectares, small ones in square metres; else shares of the map. Colours are the map's."""
    colours = {name.replace("_", " "): rgb for row in runs for name, rgb in row["colours"].items()}
    found = []
    for unit in sorted({str(row["unit"]) for row in runs if row["areas"]}):
        series = _by_class(runs, unit)
        most = max((value for points in series.values() for _, value in points), default=1.0)
        title, shown, times = "Share of the map of each class", "%", 1.0
        if unit != "share":
            small = most < LEAST_HECTARES
            title, shown, times = (
                ("Square metres of each class", "m²", 1e4) if small else ("Hectares of each class", "ha", 1.0)
            )
        moments = [moment for points in series.values() for moment, _ in points]
        span = (min(moments, default=0.0), max(moments, default=0.0))
        charts = [
            line_chart(
                {name: [(at, times * value) for at, value in points]}, name, shown, colours, small=True, span=span
            )
            for name, points in series.items()
        ]
        found.append(ClassCharts(title, charts))
    return found


def _by_class(runs: Rows, unit: str) -> dict[str, list[tuple[float, float]]]:
    found: dict[str, list[tuple[float, float]]] = {}
    for row in runs:
        moment = day_of(row)
        for name, area in row["areas"].items() if row["unit"] == unit and moment is not None else ():
            found.setdefault(name.replace("_", " "), []).append((float(moment or 0), area))
    return {name: points for name, points in found.items() if any(value for _, value in points)}


def _savings(runs: Rows) -> list[Chart]:
    dated = [(moment, {**row, **row["savings"]}) for row in runs if (moment := day_of(row)) is not None]
    spent, scores = (
        {
            label: points
            for name, label in labels.items()
            if (points := [(moment, row[name]) for moment, row in dated if row.get(name) is not None])
        }
        for labels in (SAVINGS, SCORES)
    )
    drawn = [line_chart(spent, "Share of everything", "%")]
    drawn += [line_chart(scores, "Score against the truth", "%")] if scores else []
    return [*drawn, line_chart(_summed_seconds(runs), "Seconds at the camera, all visits so far", "s")]


def _summed_seconds(runs: Rows) -> dict[str, list[tuple[float, float]]]:
    """What all visits up to each took, and what scanning everything every time would have."""
    told = ((moment, row["capture_seconds"]) for row in runs if (moment := day_of(row)) is not None)
    dated = sorted(told, key=itemgetter(0))
    dated = [(moment, seconds) for moment, seconds in dated if None not in seconds.values()]
    names, spent = {"done": "these visits", "full": "everything, every time"}, {"done": 0.0, "full": 0.0}
    points: dict[str, list[tuple[float, float]]] = {label: [] for label in names.values()}
    for moment, seconds in dated:
        for name, label in names.items():
            spent[name] += seconds[name]
            points[label].append((moment, spent[name]))
    return {label: found for label, found in points.items() if found}


def _run(row: Mapping[str, Any], runs_at: str) -> dict[str, Any]:
    largest = sorted(row["areas"].items(), key=lambda item: -item[1])[:3]
    show = area_words if row["unit"] == "ha" else format_percent
    name = quote(str(row["run"]).removeprefix("runs/"), errors="surrogateescape")
    return {
        "looked": _short(str(row.get("looked") or "")) or DASH,
        "published": _short(str(row["created"])),
        "report": f"{runs_at}/runs/{name}/report.html" if runs_at else "",
        "capture_s": row["savings"]["capture_s"],
        **{score: row[score] for score in SCORES},
        "areas": ", ".join(f"{name.replace('_', ' ')} {show(area)}" for name, area in largest if area),
    }


def _short(text: str) -> str:
    moment = read_moment(text)
    return text if moment is None else f"{moment:%Y-%m-%d %H:%M}"


def way_to(archive: Path, page: Path) -> str:
    """The way from a page's folder to the archive's, as a link; an absolute one where they have nothing in common."""
    folder, root = page.absolute().parent, archive.absolute()
    for up, parent in enumerate((folder, *folder.parents)):
        if root.is_relative_to(parent) and parent != Path(parent.anchor):
            return "/".join([*[".."] * up, *(quote(part) for part in root.relative_to(parent).parts)]) or "."
    return root.as_uri()

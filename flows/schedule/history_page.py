"""What `spectralzoom report` does: histories of an archive's fields as pages that open from disk.

Links lead to reports in the archive, beside the page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rich.console import Console
from rich.markup import escape

from flows.archive.commands import check_outside
from flows.publish.charts import Chart, line_chart
from flows.publish.finding_words import LEAST_HECTARES, area_words
from flows.publish.pages import render_page
from flows.schedule.field_history import FieldHistory, day_of, read_histories
from flows.schedule.ledger_state import read_moment
from flows.terminal.figures import DASH, counted, format_percent
from pipeline.errors import SettingsError
from storage.archive.archive import Archive
from storage.archive.whole_files import write_whole
from storage.remote.opening import open_archive

MOST_ROWS = 1000  # of each table; older ones are counted
SAVINGS = {"capture_s": "time at the camera", "lines": "lines", "bytes_stored": "stored data", "multiply_adds": "model"}
SCORES = {"miou": "mIoU", "overall_accuracy": "overall"}
Rows = Sequence[Mapping[str, Any]]


def run_report(archive: str | Path, field: str | None, out: Path, console: Console) -> dict[str, Any]:
    """Write one field's page, or an index with a page for each field beside it; what they show is given.

    Raises
    ------
    SettingsError : ``out`` is a folder, or lies in the archive.
    ArchiveError : no field is called so, or a file cannot be read or written.
    """
    opened = open_archive(archive, create=False, write=False)
    page = check_outside(out, opened)
    if page.is_dir():
        raise SettingsError(f"--out {out} is a folder, expected the file to write, such as {out}/history.html")
    if page.suffix.lower() not in (".html", ".htm"):
        raise SettingsError(f"--out {out}: expected a page's name that ends in .html")
    with console.status("reading the archive"):
        histories = read_histories(opened, field)
    if field is not None:
        written = [_write(histories[0], page, opened)]
        content = histories[0].to_dict()
    else:
        names = {one.field: f"{page.stem}-{one.field}{page.suffix}" for one in histories}
        written = [_write(one, page.with_name(names[one.field]), opened) for one in histories]
        write_whole(page, render_index(histories, opened.name, names))
        written.append(page)
        content = {"archive": opened.name, "fields": [one.to_dict() for one in histories]}
    console.print(f"  {escape(str(written[-1]))}", highlight=False, soft_wrap=True)
    return {**content, "pages": [str(path) for path in written]}


def _write(history: FieldHistory, page: Path, archive: Archive) -> Path:
    write_whole(page, render_history(history, "" if archive.in_bucket else way_to(archive.root, page)))
    return page


def render_history(history: FieldHistory, runs_at: str) -> str:
    """The page; ``runs_at`` is the way from it to the archive's folder, empty where there is none."""
    counts = ", ".join(f"{count} {word}" for word, count in history.counts.items())
    troubles = [event for event in history.events if event["event"] != "done"]
    return render_page(
        "history.html",
        kicker="SpectralZoom field",
        title=history.field,
        lead=f"{counted(len(history.runs), 'run')} in the archive. Of what was due on schedule: {counts}.",
        about=f"{history.archive}; times in UTC",
        areas=_areas(history.runs),
        savings=_savings(history.runs),
        troubles=[_trouble(event) for event in reversed(troubles[-MOST_ROWS:])],
        older_troubles=len(troubles) - MOST_ROWS,
        runs=[_run(row, runs_at) for row in reversed(history.runs[-MOST_ROWS:])],
        older_runs=len(history.runs) - MOST_ROWS,
    )


def render_index(histories: Sequence[FieldHistory], archive: str, pages: Mapping[str, str]) -> str:
    """All fields of an archive, with what became of their runs; ``pages`` are the files of their histories."""
    return render_page(
        "fields.html",
        kicker="SpectralZoom archive",
        title="Fields",
        lead=f"{counted(len(histories), 'field')}.",
        about=f"{archive}; times in UTC",
        fields=[_field(one, pages[one.field]) for one in histories],
    )


def _field(history: FieldHistory, page: str) -> dict[str, Any]:
    newest = max((str(row["created"]) for row in history.runs), default="")
    trouble: Mapping[str, Any] = next((line for line in reversed(history.events) if line["event"] != "done"), {})
    return {
        "name": history.field,
        "page": page,
        "runs": len(history.runs),
        "newest": _short(newest) or DASH,
        "counts": list(history.counts.values()),
        "trouble": trouble.get("reason") or "",
    }


def _areas(runs: Rows) -> list[Chart]:
    units = {str(row["unit"]) for row in runs if row["areas"]}
    colours = {name.replace("_", " "): rgb for row in runs for name, rgb in row["colours"].items()}
    return [_area_chart(_by_class(runs, unit), unit, colours) for unit in sorted(units)]


def _area_chart(series: dict[str, list[tuple[float, float]]], unit: str, colours: Mapping[str, str]) -> Chart:
    """Areas on the ground in hectares, small ones in square metres; else shares of the map. Colours are the map's."""
    if unit == "share":
        return line_chart(series, "Share of the map of each class", "%", colours)
    if max((value for points in series.values() for _, value in points), default=1.0) >= LEAST_HECTARES:
        return line_chart(series, "Hectares of each class", "ha", colours)
    small = {name: [(moment, value * 1e4) for moment, value in points] for name, points in series.items()}
    return line_chart(small, "Square metres of each class", "m²", colours)


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
    return [*drawn, line_chart(scores, "Score against the truth", "%")] if scores else drawn


def _trouble(event: Mapping[str, Any]) -> dict[str, str]:
    what, due = str(event["event"]), _short(str(event.get("due", "")))
    if what == "passed":
        what = f"{'very many' if event.get('count') is None else event['count']} skipped"
        due = f"{_short(str(event.get('after', '')))} to {_short(str(event.get('until', '')))}"
    return {"due": due, "what": what, "why": str(event.get("reason", ""))}


def _run(row: Mapping[str, Any], runs_at: str) -> dict[str, Any]:
    largest = sorted(row["areas"].items(), key=lambda item: -item[1])[:3]
    show = area_words if row["unit"] == "ha" else format_percent
    again = f" (attempt {row['attempts']})" if (row["attempts"] or 1) > 1 else ""
    name = quote(str(row["run"]).removeprefix("runs/"), errors="surrogateescape")
    return {
        "published": _short(str(row["created"])),
        "report": f"{runs_at}/runs/{name}/report.html" if runs_at else "",
        "due": (_short(str(row["due"] or "")) or DASH) + again,
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

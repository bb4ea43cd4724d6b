"""A field's history as one HTML page that opens from disk, and the index of an archive's fields.

Styles and drawings are inline, nothing is loaded from anywhere. Links lead to reports in the archive, beside the page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from flows.publish.finding_words import LEAST_HECTARES, area_words
from flows.publish.line_chart import line_chart
from flows.publish.page_parts import escape, page_row, page_section, page_table
from flows.schedule.field_history import FieldHistory, day_of
from flows.schedule.ledger_state import read_moment
from flows.terminal.figures import DASH, format_percent, format_points

MOST_ROWS = 1000  # of each table; older ones are counted
SAVINGS = {"capture_s": "time at the camera", "lines": "lines", "bytes_stored": "stored data", "multiply_adds": "model"}
SCORES = {"miou": "mIoU", "overall_accuracy": "overall"}


def render_history(history: FieldHistory, runs_at: str) -> str:
    """The page; ``runs_at`` is the way from it to the archive's folder, empty where there is none."""
    counts = history.counts
    told = ", ".join(f"{count} {word}" for word, count in counts.items())
    lead = f"{len(history.runs)} runs in the archive. Of what was due on schedule: {told}."
    body = [
        page_section("Class areas", _areas(history.runs)),
        page_section("Spent, as a share of scanning everything", _savings(history.runs)),
        page_section("Failures and skipped runs", _troubles(history.events)),
        page_section("Runs", _runs(history.runs, runs_at)),
    ]
    return _page(history.field, "SpectralZoom field", lead, history.archive, "\n".join(body))


def render_index(histories: Sequence[FieldHistory], archive: str, pages: Mapping[str, str]) -> str:
    """All fields of an archive, with what became of their runs; ``pages`` are the files of their histories."""
    head = page_row("th", ["field", "runs", "newest", "done", "skipped", "failed", "last trouble"])
    rows = []
    for one in histories:
        newest = max((str(row["created"]) for row in one.runs), default="")
        trouble: Mapping[str, Any] = next((line for line in reversed(one.events) if line["event"] != "done"), {})
        cells = [_link(pages[one.field], one.field), str(len(one.runs)), escape(_short(newest) or DASH)]
        cells += [str(count) for count in one.counts.values()]
        cells.append(f'<span class="words">{escape(str(trouble.get("reason") or ""))}</span>')
        rows.append(page_row("td", cells))
    body = page_section("Fields", page_table([head, *rows]) if rows else "<p>There are no fields yet.</p>")
    return _page("Fields", "SpectralZoom archive", f"{len(histories)} fields.", archive, body)


def _areas(runs: Sequence[Mapping[str, Any]]) -> str:
    units = {str(row["unit"]) for row in runs if row["areas"]}
    colours = {name.replace("_", " "): rgb for row in runs for name, rgb in row["colours"].items()}
    drawn = [_area_chart(_by_class(runs, unit), unit, colours) for unit in sorted(units)]
    return "".join(drawn) or "<p>No run has left a map yet.</p>"


def _area_chart(series: dict[str, list[tuple[float, float]]], unit: str, colours: Mapping[str, str]) -> str:
    """Areas on the ground in hectares, small ones in square metres; else shares of the map. Colours are the map's."""
    if unit == "share":
        return line_chart(series, "Share of the map of each class", "%", colours)
    if max((value for points in series.values() for _, value in points), default=1.0) >= LEAST_HECTARES:
        return line_chart(series, "Hectares of each class", "ha", colours)
    small = {name: [(moment, value * 1e4) for moment, value in points] for name, points in series.items()}
    return line_chart(small, "Square metres of each class", "m²", colours)


def _by_class(runs: Sequence[Mapping[str, Any]], unit: str) -> dict[str, list[tuple[float, float]]]:
    found: dict[str, list[tuple[float, float]]] = {}
    for row in runs:
        moment = day_of(row)
        for name, area in row["areas"].items() if row["unit"] == unit and moment is not None else ():
            found.setdefault(name.replace("_", " "), []).append((float(moment or 0), area))
    return {name: points for name, points in found.items() if any(value for _, value in points)}


def _savings(runs: Sequence[Mapping[str, Any]]) -> str:
    series: dict[str, list[tuple[float, float]]] = {label: [] for label in SAVINGS.values()}
    scores: dict[str, list[tuple[float, float]]] = {label: [] for label in SCORES.values()}
    for row in runs:
        moment = day_of(row)
        if moment is None:
            continue
        for name, label in SAVINGS.items():
            if row["savings"].get(name) is not None:
                series[label].append((moment, row["savings"][name]))
        for name, label in SCORES.items():
            if row[name] is not None:
                scores[label].append((moment, row[name]))
    scored = {name: points for name, points in scores.items() if points}
    drawn = line_chart({name: points for name, points in series.items() if points}, "Share of everything", "%")
    return drawn + (line_chart(scored, "Score against the truth", "%") if scored else "")


def _troubles(events: Sequence[Mapping[str, Any]]) -> str:
    found = [event for event in events if event["event"] != "done"]
    if not found:
        return "<p>None.</p>"
    head = page_row("th", ["due", "what", "why"])
    rows = []
    for event in reversed(found[-MOST_ROWS:]):
        what, when = str(event["event"]), _short(str(event.get("due", "")))
        if what == "passed":
            what = f"{'very many' if event.get('count') is None else event['count']} skipped"
            when = f"{_short(str(event.get('after', '')))} to {_short(str(event.get('until', '')))}"
        why = f'<span class="words">{escape(str(event.get("reason", "")))}</span>'
        rows.append(page_row("td", [escape(when), f'<span class="state {escape(what)}">{escape(what)}</span>', why]))
    return page_table([head, *rows]) + _rest(len(found))


def _runs(runs: Sequence[Mapping[str, Any]], runs_at: str) -> str:
    if not runs:
        return "<p>There are no runs yet.</p>"
    head = page_row("th", ["published", "due", "time at the camera", *SCORES.values(), "largest classes"])
    rows = [_run_row(row, runs_at) for row in reversed(runs[-MOST_ROWS:])]
    return page_table([head, *rows]) + _rest(len(runs))


def _run_row(row: Mapping[str, Any], runs_at: str) -> str:
    largest = sorted(row["areas"].items(), key=lambda item: -item[1])[:3]
    show = area_words if row["unit"] == "ha" else format_percent
    areas = ", ".join(f"{name.replace('_', ' ')} {show(area)}" for name, area in largest if area)
    name = str(row["run"]).removeprefix("runs/")
    when = _short(str(row["created"]))
    link = _link(f"{runs_at}/runs/{quote(name)}/report.html", when) if runs_at else escape(when)
    due = _short(str(row["due"] or "")) or DASH
    again = f" (attempt {row['attempts']})" if (row["attempts"] or 1) > 1 else ""
    cells = [link, escape(due + again), format_percent(row["savings"]["capture_s"])]
    cells += [*(format_points(row[name]) for name in SCORES), f'<span class="words">{escape(areas)}</span>']
    return page_row("td", cells)


def _rest(count: int) -> str:
    return f"<p class=note>And {count - MOST_ROWS} before these.</p>" if count > MOST_ROWS else ""


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


def _link(address: str, words: str) -> str:
    return f'<a href="{escape(address)}">{escape(words)}</a>'


def _page(title: str, kicker: str, lead: str, about: str, body: str) -> str:
    from flows.publish.report import PAGE_STYLE

    return _PAGE.substitute(
        title=escape(title), kicker=escape(kicker), lead=escape(lead), about=escape(about), style=PAGE_STYLE + _STYLE,
        body=body,
    )  # fmt: skip


_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>$style</style>
</head>
<body>
<main>
<header><p class="kicker">$kicker</p><h1>$title</h1><p class="lead">$lead</p><p class="note">$about; times in UTC</p>
</header>
$body
</main>
</body>
</html>
""")

_STYLE = """
svg { display: block; width: 100%; height: auto; font: 11px system-ui, "DejaVu Sans", sans-serif; }
svg text { fill: var(--soft); } svg .rule { stroke: var(--line); }
.key { margin-right: 1rem; white-space: nowrap; } .key i { display: inline-block; width: .8rem; height: .8rem;
  border-radius: .2rem; margin-right: .35rem; vertical-align: -.05rem; }
a { color: var(--bar); }
"""

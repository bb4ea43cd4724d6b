"""Write the history of a field, by the receipts of its runs, as a page with a table and a chart: the verb `report`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from rich.markup import escape

from flows.archive.stale_runs import called, generations
from flows.publish.receipt import check_receipt
from flows.settings.flags import ArchiveName, AsJson, OutFile, check_outside
from flows.settings.load import time_of_visit
from flows.settings.survey_settings import BUILT_IN_SCENES
from flows.tasks.scores import score_of
from flows.terminal.figures import counted, format_area, format_percent
from flows.terminal.processes import DONE
from flows.terminal.progress import print_json, stderr
from pipeline.errors import PipelineError, SettingsError, ShapeError, visible
from pipeline.lazy import deferred
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.archive.whole_files import write_whole
from storage.arrays.class_maps import ClassNames, legend_of
from storage.arrays.layout import open_group
from storage.remote.opening import open_archive

if TYPE_CHECKING:
    import matplotlib.figure as mpl_figure

    import flows.publish.panels as panels
    import flows.publish.report as pages
else:
    mpl_figure = deferred("matplotlib.figure")
    panels = deferred("flows.publish.panels")
    pages = deferred("flows.publish.report")

LEADING_CLASSES = 3  # of a run in the table
SHOW_AREA = {"ha": format_area, "fraction": format_percent}
AXES = {"ha": "hectares", "fraction": "fraction of the map"}
Row = Mapping[str, Any]


@dataclass(frozen=True)
class FieldHistory:
    """The runs of one field as rows, by the date of their visits."""

    field: str
    archive: str
    runs: Sequence[Row]
    legend: ClassNames | None = None  # of the newest run's map


def report(archive: ArchiveName, *, field: str | None = None, out: OutFile, as_json: AsJson = False) -> int:
    """Write a field's history as one page that opens from disk: dates, capture times, scores, class areas.

    Parameters
    ----------
    field
        Name of the field; needed where the archive has several.
    out
        The page to write.
    """
    opened = open_archive(archive, create=False, write=False)
    page = check_outside(out, opened.root)
    if page.is_dir():
        raise SettingsError(f"--out {out} is a folder, expected the file to write, such as {out}/history.html")
    if page.suffix.lower() not in (".html", ".htm"):
        raise SettingsError(f"--out {out}: expected a page's name that ends in .html")
    history = read_history(opened, field)
    runs_at = "" if opened.in_bucket else quote(Path(os.path.relpath(opened.root, page.parent)).as_posix())
    write_whole(page, render_history(history, runs_at))
    stderr.print(f"  {escape(str(page))}", soft_wrap=True)
    if as_json:
        print_json({"field": history.field, "archive": history.archive, "runs": list(history.runs), "page": str(page)})
    return DONE


def read_history(archive: Archive, field: str | None = None) -> FieldHistory:
    """Return the history of a field, or of the only one.

    Raises SettingsError: no field has this name, or there are several.
    """
    catalogue = Catalogue.read(archive.root)
    names = sorted({called(run) for run in catalogue.runs})
    name = names[0] if field is None and len(names) == 1 else field
    if name not in names:
        which = f"no field of {archive.name} is called {name!r}" if name else f"{archive.name} has {len(names)} fields"
        advice = f"give --field with one of: {', '.join(names)}" if names else "survey into it first"
        raise SettingsError(f"{which}; {advice}")
    runs = sorted((run for run in catalogue.runs if called(run) == name), key=lambda run: str(time_of_visit(run)))
    legend = None
    with suppress(KeyError, OSError, PipelineError):  # the map was deleted
        legend = legend_of(open_group(archive.locate(runs[-1].products["class_map"])))
    newest: dict[tuple[int, str | None], str] = {}
    for number, some in enumerate(generations(catalogue)):  # of one visit; a built-in scene grows without a new name
        for run in some:
            newest[number, time_of_visit(run) if run.settings.get("scene") in BUILT_IN_SCENES else None] = run.uri
    return FieldHistory(str(name), archive.name, [_row(run, run.uri not in newest.values()) for run in runs], legend)


def _row(run: Run, replaced: bool) -> Row:
    """Return the figures of a run's receipt, ``replaced`` or not; a receipt that is not valid gives none."""
    receipt: Mapping[str, Any] = {}
    with suppress(ShapeError):
        receipt = check_receipt(run.receipt)
    areas: Mapping[str, Mapping[str, float]] = receipt.get("areas") or {}
    counts = areas.get("px", {})
    return {
        "run": run.uri,
        "replaced": replaced,
        "created": run.created,
        "visit": run.settings.get("visit"),
        "visited": time_of_visit(run),
        **score_of(receipt),
        "training_scene": receipt.get("training_scene"),
        "capture_s": (receipt["savings"].get("capture_s") or {}).get("done") if receipt else None,
        "areas": areas.get("ha", {name: count / sum(counts.values()) for name, count in counts.items() if count}),
        "unit": "ha" if "ha" in areas else "fraction",
        "problem": run.problem,
    }


def render_history(history: FieldHistory, runs_at: str) -> str:
    """Return the page; ``runs_at`` is the relative address of the archive's folder, empty where there is none."""
    visits = sum(not row["replaced"] for row in history.runs)
    return pages.render_page(
        "history.html",
        kicker="SpectralZoom field",
        title=history.field,
        lead=f"{counted(visits, 'visit')}, {counted(len(history.runs), 'run')} in the archive.",
        about=f"{history.archive}; times in UTC",
        chart=_draw_areas(history.runs, history.legend),
        runs=[_shown(row, runs_at) for row in reversed(history.runs)],
        trained=any(row["training_scene"] for row in history.runs),
    )


def _draw_areas(rows: Sequence[Row], legend: ClassNames | None) -> str | None:
    """Return a chart of the class areas over time, in the newest run's unit, as a data address; None without areas."""
    dated = [row for row in rows if row["visited"] and row["areas"] and not row["replaced"]]
    if not dated:
        return None
    unit = dated[-1]["unit"]
    dated = [row for row in dated if row["unit"] == unit]
    figure = mpl_figure.Figure(figsize=(9.5, 3.2), dpi=100, layout="constrained", facecolor=panels.PAPER)
    axes = figure.subplots()
    colours = {} if legend is None else dict(zip(legend.names, legend.colours / 255, strict=True))
    for name in dict.fromkeys(name for row in dated for name in row["areas"]):
        points = [(datetime.fromisoformat(row["visited"]), row["areas"].get(name, 0.0)) for row in dated]
        label = visible(name).replace("_", " ").replace("$", r"\$")
        axes.plot(*zip(*points, strict=True), marker="o", markersize=4, color=colours.get(name), label=label)
    axes.set(ylim=(0, None), ylabel=AXES[unit])
    axes.grid(color=panels.GRID)
    axes.tick_params(axis="x", labelrotation=20)
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    return panels.data_address(panels.png(figure, () if legend is None else legend.colours))


def _shown(row: Row, runs_at: str) -> dict[str, Any]:
    largest = sorted(row["areas"].items(), key=lambda item: -item[1])[:LEADING_CLASSES]
    name = quote(str(row["run"]).removeprefix("runs/"), errors="surrogateescape")
    return {
        **row,
        "visited": str(row["visited"] or "")[:16].replace("T", " "),
        "published": str(row["created"])[:16].replace("T", " "),
        "report": f"{runs_at}/runs/{name}/report.html" if runs_at else "",
        "mark": "*" if row["training_scene"] and row["miou"] is not None else "",
        "areas": ", ".join(f"{one.replace('_', ' ')} {SHOW_AREA[row['unit']](area)}" for one, area in largest),
    }

"""Write the history of a field as a page with charts: the verb `report`."""

from __future__ import annotations

import base64
import io
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from rich.markup import escape

from flows.archive.compare_command import part_of
from flows.archive.stale_runs import called
from flows.cli.app import ArchiveName, AsJson, OutFile, check_outside, stderr
from flows.publish.receipt import hectares_of_classes
from flows.publish.receipt_table import format_days
from flows.settings.survey_settings import BUILT_IN_SCENES
from flows.tasks.scene import TRAINING_SCENE
from flows.tasks.scores import score_of
from flows.terminal.figures import (
    DASH,
    MOST_PERCENT,
    counted,
    format_area,
    format_percent,
    format_points,
    format_seconds,
    known_number,
)
from flows.terminal.processes import DONE
from flows.terminal.progress import print_json
from pipeline.errors import ArchiveError, SettingsError, visible
from pipeline.lazy import deferred
from pipeline.simulator.scenes.farm.farm_scene import USUAL_HOUR
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.archive.whole_files import write_whole
from storage.arrays.class_maps import ClassMap, ProbabilityStore, load_class_map
from storage.remote.opening import open_archive

if TYPE_CHECKING:
    import matplotlib.figure as mpl_figure

    import flows.publish.field_map as pictures
    import flows.publish.panels as panels
    import flows.publish.report as pages
else:
    mpl_figure = deferred("matplotlib.figure")
    pictures = deferred("flows.publish.field_map")
    panels = deferred("flows.publish.panels")
    pages = deferred("flows.publish.report")

MOST_ROWS = 1000  # of the table; older ones are counted
MOST_VISITS = 24  # that a page shows: the newest
MOST_PX = 400  # of a visit's picture
MOST_CLASSES = 128  # that have numbers of their own; the last of them stands for no class
CHANGED_FRACTION = 0.25  # of a patch's pixels, from which the patch counts as changed
PALE = 0.8  # of patches that did not change
SAVINGS = {"capture_s": "capture time", "lines": "lines", "bytes_kept": "bytes kept", "multiply_adds": "model"}
HECTARES = "Hectares of each class"
SCORES = {"miou": "mIoU", "overall_accuracy": "overall"}
TRAINING_MARKS = {"all": "*", "other pixels": "**"}  # behind scores, by `TRAINING_SCENE`
Row = Mapping[str, Any]
Points = Mapping[str, Sequence[tuple[datetime, float]]]  # of a series by its name


@dataclass(frozen=True)
class FieldHistory:
    """The runs of one field as rows, and pictures of its visits."""

    field: str
    archive: str
    runs: Sequence[Row]
    visits: Sequence[Mapping[str, str]] = ()
    colours: Mapping[str, str] = dataclass_field(default_factory=dict)  # of the classes, as in CSS


def report(archive: ArchiveName, *, field: str | None = None, out: OutFile, as_json: AsJson = False) -> int:
    """Write a field's history as one page that opens from disk: dates, class areas, savings.

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
    with stderr.status("reading the archive"):
        history = read_history(opened, field)
    runs_at = "" if opened.in_bucket else quote(Path(os.path.relpath(opened.root, page.parent)).as_posix())
    write_whole(page, render_history(history, runs_at))
    stderr.print(f"  {escape(str(page))}", soft_wrap=True)
    if as_json:
        print_json({"field": history.field, "archive": history.archive, "runs": list(history.runs), "page": str(page)})
    return DONE


def read_history(archive: Archive, field: str | None = None) -> FieldHistory:
    """Return the history of a field, or of the only one.

    Raises ArchiveError: no field has this name, or there are several.
    """
    catalogue = Catalogue.read(archive.root)
    names = sorted({called(run) for run in catalogue.runs})
    name = names[0] if field is None and len(names) == 1 else field
    if name not in names:
        which = f"no field of {archive.name} is called {name!r}" if name else f"{archive.name} has {len(names)} fields"
        raise ArchiveError(f"{which}; give --field with one of: {', '.join(names) or 'none'}")
    own = sorted((run for run in catalogue.runs if called(run) == name), key=lambda run: str(time_of_visit(run) or ""))
    maps = {run.uri: found for run in own if (found := _map_of(archive, catalogue, run)) is not None}
    kept = catalogue.kept_by_runs(archive.all_sizes(catalogue))
    rows = [_row(run, maps.get(run.uri), kept[run.uri]) for run in own]
    mapped = [(run, row) for run, row in zip(own, rows, strict=True) if run.uri in maps][-MOST_VISITS:]
    visits = [_visit(archive, run, row, maps[run.uri]) for run, row in mapped]
    colours = {
        one: f"#{bytes(map(int, rgb)).hex()}"
        for found in maps.values()
        for one, rgb in zip(found.names, found.colours, strict=False)
    }
    return FieldHistory(str(name), archive.name, rows, visits, colours)


def _map_of(archive: Archive, catalogue: Catalogue, run: Run) -> ClassMap | None:
    """Return a run's class map; None where it has none that can be read."""
    address = run.products.get("class_map", "")
    store = catalogue.stores.get("/".join(address.split("/")[:3]))
    if store is not None and store.problem is None and run.problem is None:
        with suppress(OSError, LookupError, ValueError):
            return load_class_map(archive.locate(address))
    return None


def _row(run: Run, shown: ClassMap | None, kept: int) -> Row:
    savings = {name: known_number(part_of(run.receipt, "savings", name).get("ratio")) for name in SAVINGS}
    if reference := known_number(part_of(run.receipt, "data_bytes").get("reference")):
        savings["bytes_kept"] = kept / reference
    hectares, areas = hectares_of_classes(run.receipt), dict[str, float]()
    if hectares is not None:
        areas = {str(name): float(area) for name, area in hectares.items() if known_number(area) is not None}
    elif shown is not None:
        counts = [int((shown.classes == number).sum()) for number in range(len(shown.names))]
        areas = {name: count / (sum(counts) or 1) for name, count in zip(shown.names, counts, strict=True)}
    at = time_of_visit(run)
    return {
        "run": run.uri,
        "created": run.created,
        "visit": run.settings.get("visit"),
        "visited": None if at is None else at.isoformat().replace("+00:00", "Z"),
        **score_of(run.receipt),
        "training_scene": next((kind for kind in TRAINING_SCENE if kind == run.receipt.get("training_scene")), None),
        "savings": savings,
        "areas": areas,
        "unit": "fraction" if hectares is None else "ha",
        "problem": run.problem,
    }


def read_moment(value: object) -> datetime | None:
    """Return a moment in ISO 8601 in UTC; None for anything else."""
    with suppress(ValueError, OverflowError):
        found = datetime.fromisoformat(value) if isinstance(value, str) else None
        return None if found is None else found.replace(tzinfo=found.tzinfo or UTC).astimezone(UTC)
    return None


def time_of_visit(run: Run) -> datetime | None:
    """Return the moment that names a run's visit, else the day and hour of its farm, else when the run began.

    A farm's day counts in the year of the run. None where nothing can be read.
    """
    named = read_moment(run.settings.get("visit"))
    began = next((at for at in map(read_moment, (run.receipt.get("started"), run.created)) if at is not None), None)
    day, hour = run.settings.get("day"), run.settings.get("hour")
    if named is not None or began is None or run.settings.get("scene") not in BUILT_IN_SCENES:
        return named or began
    of_day = float(hour) if isinstance(hour, int | float) else USUAL_HOUR
    if not (isinstance(day, int) and 1 <= day <= 366 and 0 <= of_day <= 24):
        return began
    return datetime(began.year, 1, 1, tzinfo=UTC) + timedelta(days=day - 1, hours=of_day)


def _visit(archive: Archive, run: Run, row: Row, shown: ClassMap) -> dict[str, str]:
    """Return the date of a visit, its map, its changes (empty for a first visit) and a caption."""
    thin = slice(None, None, -(-max(shown.classes.shape) // MOST_PX))
    palette = pictures.palette_bytes(shown.colours[: MOST_CLASSES - 1])[:MOST_CLASSES]
    numbers, changes = np.minimum(shown.classes[thin, thin], MOST_CLASSES - 1), ""
    address = run.products.get("class_probabilities")
    with suppress(OSError, LookupError, ValueError):
        store = None if address is None else ProbabilityStore(archive.locate(address))
        changed = None if store is None else store.changed()
        if store is not None and changed is not None:
            of_pixels = np.kron(changed >= CHANGED_FRACTION, np.ones((store.patch_px,) * 2, np.bool_))
            is_same = ~of_pixels[: shown.classes.shape[0], : shown.classes.shape[1]][thin, thin]
            pale = np.rint(255 * PALE + (1 - PALE) * palette).astype(np.uint8)
            changes = pictures.png_address(numbers + np.uint8(MOST_CLASSES) * is_same, np.concatenate([palette, pale]))
    when = _short(str(row["visited"] or row["created"]))
    visit = str(row["visit"] or "")
    when = when if not visit or read_moment(visit) is not None else f"{visit}, {when}"
    return {"when": when, "map": pictures.png_address(numbers, palette), "changes": changes, "words": _caption(run)}


def _caption(run: Run) -> str:
    """Return the seconds of a visit, and the use of its prior map."""
    seconds, memory = (
        known_number(part_of(run.receipt, "savings", "capture_s").get("done")),
        part_of(run.receipt, "memory"),
    )
    parts = [] if seconds is None else [f"{format_seconds(seconds)} at the camera"]
    if not memory:
        return ", ".join([*parts, "first visit"])
    if memory.get("put_aside"):
        return ", ".join([*parts, f"prior map not used ({memory['put_aside']})"])
    fraction = memory["changed_px"] / memory["compared_px"] if memory.get("compared_px") else 0.0
    prior = f"prior map of {format_days(memory['days'])}"
    return ", ".join([*parts, prior, f"{format_percent(fraction)} changed"])


def render_history(history: FieldHistory, runs_at: str) -> str:
    """Return the page; ``runs_at`` is the relative address of the archive's folder, empty where there is none."""
    moments = ((read_moment(row.get("visited") or row["created"]), row) for row in history.runs)
    shown = history.runs[-MOST_ROWS:]
    kinds = [kind for kind in TRAINING_SCENE if any(row["training_scene"] == kind for row in shown)]
    colours = {name.replace("_", " "): colour for name, colour in history.colours.items()}
    charts = _charts([(at, row) for at, row in moments if at is not None])
    return pages.render_page(
        "history.html",
        kicker="SpectralZoom field",
        title=history.field,
        lead=f"{counted(len(history.runs), 'run')} in the archive.",
        about=f"{history.archive}; times in UTC",
        charts=[
            {"title": title, "picture": _draw(title, series, colours)}
            for title, series in charts
            if any(series.values())
        ],
        visits=history.visits,
        runs=[_shown(row, runs_at) for row in reversed(shown)],
        trained={TRAINING_MARKS[kind]: TRAINING_SCENE[kind] for kind in kinds},
        older_runs=len(history.runs) - MOST_ROWS,
    )


def _charts(dated: Sequence[tuple[datetime, Row]]) -> Iterator[tuple[str, Points]]:
    """Yield the title and the series of each chart."""

    def series(values: Iterable[float | None]) -> list[tuple[datetime, float]]:
        both = zip(dated, values, strict=True)
        return [(at, value) for (at, _), value in both if value is not None and math.isfinite(value)]

    rows = [row for _, row in dated]
    for unit, title in (("fraction", "Fraction of the map of each class"), ("ha", HECTARES)):
        areas = [row["areas"] if row["unit"] == unit else {} for row in rows]
        names = dict.fromkeys(name for one in areas for name, area in one.items() if area)
        yield title, {name.replace("_", " "): series([one.get(name) for one in areas]) for name in names}
    savings = {label: series([row["savings"].get(name) for row in rows]) for name, label in SAVINGS.items()}
    yield "Fraction of everything", savings
    scores = {
        f"{label}{', trained on it' * trained}": series(
            [row[name] if (row["training_scene"] is not None) is trained else None for row in rows]
        )
        for trained in (False, True)
        for name, label in SCORES.items()
    }
    yield "Score against the truth", scores


def _draw(title: str, series: Points, colours: Mapping[str, str]) -> str:
    """Return the data address of a chart as PNG; the same points give the same bytes."""
    figure = mpl_figure.Figure(figsize=(9.5, 3.2), dpi=100, layout="constrained", facecolor=panels.PAPER)
    axes = figure.subplots()
    for name, points in series.items():
        if points:
            label = visible(name).replace("$", r"\$")
            axes.plot(
                *zip(*sorted(points), strict=True), marker="o", markersize=4, label=label, color=colours.get(name)
            )
    axes.set_ylim(bottom=0)
    if title != HECTARES:
        axes.yaxis.set_major_formatter(
            lambda value, _: format_percent(value) if value >= MOST_PERCENT / 100 else f"{100 * value:.3g} %"
        )
    axes.grid(color=panels.GRID)
    axes.tick_params(axis="x", labelrotation=20)
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    file = io.BytesIO()
    panels.save_png(figure, file)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


def _shown(row: Row, runs_at: str) -> dict[str, Any]:
    largest = sorted(row["areas"].items(), key=lambda item: -item[1])[:3]
    show = format_area if row["unit"] == "ha" else format_percent
    name = quote(str(row["run"]).removeprefix("runs/"), errors="surrogateescape")
    mark = TRAINING_MARKS.get(row["training_scene"], "")
    return {
        "visited": _short(str(row.get("visited") or "")) or DASH,
        "published": _short(str(row["created"])),
        "report": f"{runs_at}/runs/{name}/report.html" if runs_at else "",
        "capture_s": row["savings"]["capture_s"],
        **{score: format_points(row[score]) + mark * (row[score] is not None) for score in SCORES},
        "areas": ", ".join(f"{name.replace('_', ' ')} {show(area)}" for name, area in largest if area),
    }


def _short(text: str) -> str:
    moment = read_moment(text)
    return text if moment is None else f"{moment:%Y-%m-%d %H:%M}"

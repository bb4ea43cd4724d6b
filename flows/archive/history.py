"""Write histories of fields, their runs from the oldest on, as pages with charts: `spectralzoom report`."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from rich.markup import escape

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
MOST_CLASSES = 128  # that have numbers of their own, the last of them standing for none
CHANGED_FRACTION = 0.25  # of a patch's pixels, from which it is said to have changed
PALE = 0.8  # of what did not change
SAVINGS = {"capture_s": "time at the camera", "lines": "lines", "bytes_kept": "bytes kept", "multiply_adds": "model"}
SCORES = {"miou": "mIoU", "overall_accuracy": "overall"}
TRAINING_MARKS = {"all": "*", "tiles": "**", "other pixels": "***"}  # behind scores, by `TRAINING_SCENE`
DRAWN_YEARS = range(1900, 2200)
_MOST_VALUE = 1e100  # that can be drawn; receipts may claim anything
Row = Mapping[str, Any]
Points = Mapping[str, Sequence[tuple[datetime, float]]]  # of a series by its name


@dataclass(frozen=True)
class FieldHistory:
    """The runs of one field, as rows, and pictures of its visits."""

    field: str
    archive: str
    runs: Sequence[Row]
    visits: Sequence[Mapping[str, str]] = ()
    colours: Mapping[str, str] = dataclass_field(default_factory=dict)  # of the classes on the maps, as CSS writes them


def report(archive: ArchiveName, *, field: str | None = None, out: OutFile, as_json: AsJson = False) -> int:
    """Write a field's history as one page that opens from disk: dates, class areas, savings.

    Parameters
    ----------
    field
        What it is called; needed where the archive has several.
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
    """Return the history of a field, or of the only one. Raises ArchiveError: no field is called so, or several are."""
    catalogue = Catalogue.read(archive.root)
    names = sorted({called(run) for run in catalogue.runs})
    name = names[0] if field is None and len(names) == 1 else field
    if name not in names:
        which = f"no field of {archive.name} is called {name!r}" if name else f"{archive.name} has {len(names)} fields"
        raise ArchiveError(f"{which}; give --field with one of: {', '.join(names) or 'none'}")
    own = sorted((run for run in catalogue.runs if called(run) == name), key=lambda run: str(time_of_visit(run) or ""))
    maps = {run.uri: shown for run in own if (shown := _map_of(archive, catalogue, run)) is not None}
    kept = catalogue.kept_by_runs(archive.all_sizes(catalogue))
    rows = [_row(run, maps.get(run.uri), kept[run.uri]) for run in own]
    mapped = [(run, row) for run, row in zip(own, rows, strict=True) if run.uri in maps][-MOST_VISITS:]
    visits = [_visit(archive, run, row, maps[run.uri]) for run, row in mapped]
    colours = {
        one: f"#{bytes(map(int, rgb)).hex()}"
        for shown in maps.values()
        for one, rgb in zip(shown.names, shown.colours, strict=False)
    }
    return FieldHistory(str(name), archive.name, rows, visits, colours)


def _map_of(archive: Archive, catalogue: Catalogue, run: Run) -> ClassMap | None:
    """Return a run's class map; None where it left none that can be read."""
    address = run.products.get("class_map")
    store = None if address is None else catalogue.stores.get("/".join(address.split("/")[:3]))
    if address is not None and store is not None and store.problem is None and run.problem is None:
        with suppress(OSError, LookupError, ValueError):
            return load_class_map(archive.locate(address))
    return None


def _row(run: Run, shown: ClassMap | None, kept: int) -> Row:
    savings = found if isinstance(found := run.receipt.get("savings"), Mapping) else {}
    entries = {name: one if isinstance(one := savings.get(name), Mapping) else {} for name in SAVINGS}
    told = found if isinstance(found := run.receipt.get("data_bytes"), Mapping) else {}
    if reference := known_number(told.get("reference")):
        entries["bytes_kept"] = {"ratio": kept / reference}
    hectares, areas = hectares_of_classes(run.receipt), dict[str, float]()
    if hectares is not None:
        areas = {str(name): float(area) for name, area in hectares.items() if known_number(area) is not None}
    elif shown is not None:
        counts = [int((shown.classes == number).sum()) for number in range(len(shown.names))]
        areas = {name: count / (sum(counts) or 1) for name, count in zip(shown.names, counts, strict=True)}
    return {
        "run": run.uri,
        "created": run.created,
        "visit": run.settings.get("visit"),
        "visited": None if (at := time_of_visit(run)) is None else at.isoformat().replace("+00:00", "Z"),
        "capture_seconds": {name: known_number(entries["capture_s"].get(name)) for name in ("done", "full")},
        **score_of(run.receipt),
        "training_scene": next((kind for kind in TRAINING_SCENE if kind == run.receipt.get("training_scene")), None),
        "savings": {name: known_number(entry.get("ratio")) for name, entry in entries.items()},
        "areas": areas,
        "unit": "fraction" if hectares is None else "ha",
        "problem": run.problem,
    }


def read_moment(value: object) -> datetime | None:
    """Return a moment that was written in ISO 8601, in UTC; None where it is none."""
    with suppress(ValueError, OverflowError):
        found = datetime.fromisoformat(value) if isinstance(value, str) else None
        return None if found is None else found.replace(tzinfo=found.tzinfo or UTC).astimezone(UTC)
    return None


def time_of_visit(run: Run) -> datetime | None:
    """Return the moment that a run's visit is called by, else the day that its farm was drawn on.

    Other runs have the time when they began, or were published. The day is of the year in which the run was published.
    None where nothing of that can be read.
    """
    named = read_moment(run.settings.get("visit"))
    if named is not None:
        return named
    began = next((at for at in map(read_moment, (run.receipt.get("started"), run.created)) if at is not None), None)
    day, hour = run.settings.get("day"), run.settings.get("hour")
    if began is None or run.settings.get("scene") not in BUILT_IN_SCENES or not isinstance(day, int):
        return began
    of_day = float(hour) if isinstance(hour, int | float) else USUAL_HOUR
    if not (1 <= day <= 366 and 0 <= of_day <= 24):
        return began
    return datetime(began.year, 1, 1, tzinfo=UTC) + timedelta(days=day - 1, hours=of_day)


def _visit(archive: Archive, run: Run, row: Row, shown: ClassMap) -> dict[str, str]:
    """Return when a visit was, its map, what changed of it among pale colours (empty of a first one), and words."""
    thin = slice(None, None, -(-max(shown.classes.shape) // MOST_PX))
    palette = pictures.palette_bytes(shown.colours[: MOST_CLASSES - 1])[:MOST_CLASSES]
    numbers, changes = np.minimum(shown.classes[thin, thin], MOST_CLASSES - 1), ""
    address = run.products.get("class_probabilities")
    with suppress(OSError, LookupError, ValueError):
        store = None if address is None else ProbabilityStore(archive.locate(address))
        changed = None if store is None else store.changed()
        if store is not None and changed is not None:
            patch_index = (changed >= CHANGED_FRACTION).repeat(store.patch_px, axis=0).repeat(store.patch_px, axis=1)
            pale = np.rint(255 * PALE + (1 - PALE) * palette).astype(np.uint8)
            kept = patch_index[: shown.classes.shape[0], : shown.classes.shape[1]][thin, thin]
            table = np.concatenate([palette, pale])
            changes = pictures.png_address(numbers + np.where(kept, 0, MOST_CLASSES).astype(np.uint8), table)
    when = _short(str(row["visited"] or row["created"]))
    visit = str(row["visit"] or "")
    when = when if not visit or read_moment(visit) is not None else f"{visit}, {when}"
    return {
        "when": when,
        "map": pictures.png_address(numbers, palette),
        "changes": changes,
        "words": _format_row(run.receipt),
    }


def _format_row(receipt: Mapping[str, Any]) -> str:
    """Return a row of the table: the seconds spent, and the use of the prior map."""
    capture, memory = (receipt.get("savings") or {}).get("capture_s") or {}, receipt.get("memory")
    seconds = known_number(capture.get("done"))
    parts = [] if seconds is None else [f"{format_seconds(seconds)} at the camera"]
    if not isinstance(memory, Mapping):
        return ", ".join([*parts, "a first look"])
    if memory.get("put_aside"):
        return ", ".join([*parts, f"its prior map put aside ({memory['put_aside']})"])
    fraction = memory["changed_px"] / memory["compared_px"] if memory.get("compared_px") else 0.0
    return ", ".join([*parts, f"goes on from {format_days(memory['days'])}", f"{format_percent(fraction)} changed"])


def render_history(history: FieldHistory, runs_at: str) -> str:
    """Return the page; ``runs_at`` is the way from it to the archive's folder, empty where there is none."""
    moments = ((read_moment(row.get("visited") or row["created"]), row) for row in history.runs)
    dated = [(moment, row) for moment, row in moments if moment is not None and moment.year in DRAWN_YEARS]

    def savings_of(name: str) -> Sequence[tuple[datetime, float]]:
        return [(at, one) for at, row in dated if (one := row["savings"].get(name)) is not None]

    def scores_of(name: str, *, trained: bool) -> Sequence[tuple[datetime, float]]:
        fitting = [(at, row[name]) for at, row in dated if (row["training_scene"] is not None) is trained]
        return [(at, one) for at, one in fitting if one is not None]

    colours = {name.replace("_", " "): colour for name, colour in history.colours.items()}
    charts: list[tuple[str, Points, bool]] = []
    for unit, title in (("fraction", "Fraction of the map of each class"), ("ha", "Hectares of each class")):
        own = [(at, row["areas"]) for at, row in dated if row["unit"] == unit]
        names = dict.fromkeys(name for _, areas in own for name, area in areas.items() if area)
        areas = {name.replace("_", " "): [(at, one[name]) for at, one in own if name in one] for name in names}
        charts.append((title, areas, unit == "fraction"))
    charts.append(("Fraction of everything", {label: savings_of(name) for name, label in SAVINGS.items()}, True))
    scores = {
        f"{label}{', trained on it' * trained}": scores_of(name, trained=trained)
        for trained in (False, True)
        for name, label in SCORES.items()
    }
    charts.append(("Score against the truth", scores, True))
    shown = history.runs[-MOST_ROWS:]
    kinds = [kind for kind in TRAINING_SCENE if any(row["training_scene"] == kind for row in shown)]
    return pages.render_page(
        "history.html",
        kicker="SpectralZoom field",
        title=history.field,
        lead=f"{counted(len(history.runs), 'run')} in the archive.",
        about=f"{history.archive}; times in UTC",
        charts=[{"title": title, "picture": picture} for title, picture in _drawn(charts, colours)],
        visits=history.visits,
        runs=[_shown(row, runs_at) for row in reversed(shown)],
        trained={TRAINING_MARKS[kind]: TRAINING_SCENE[kind] for kind in kinds},
        older_runs=len(history.runs) - MOST_ROWS,
    )


def _drawn(charts: Sequence[tuple[str, Points, bool]], colours: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Draw each chart that has a point: its title, and the data address of a PNG; same points, same bytes."""
    for title, series, is_fraction in charts:
        known = {
            name: sorted((at, value) for at, value in points if abs(value) < _MOST_VALUE)
            for name, points in series.items()
        }
        if not any(known.values()):
            continue
        figure = mpl_figure.Figure(figsize=(9.5, 3.2), dpi=100, layout="constrained", facecolor=panels.PAPER)
        axes = figure.subplots()
        for name, points in known.items():
            if points:
                label = visible(name).replace("$", r"\$")
                axes.plot(*zip(*points, strict=True), marker="o", markersize=4, label=label, color=colours.get(name))
        axes.set_ylim(bottom=0)
        if is_fraction:
            axes.yaxis.set_major_formatter(
                lambda value, _: format_percent(value) if value >= MOST_PERCENT / 100 else f"{100 * value:.3g} %"
            )
        axes.grid(color=panels.GRID)
        axes.tick_params(axis="x", labelrotation=20)
        figure.legend(loc="outside right upper", frameon=False, fontsize=8)
        file = io.BytesIO()
        panels.save_png(figure, file)
        yield title, f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


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

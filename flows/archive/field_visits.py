"""A field's visits, for a page of its history: when each looked, its map, what changed; and charts over dates.

Charts are SVG: the same points give the same bytes.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.dates import AutoDateFormatter, AutoDateLocator
from matplotlib.figure import Figure
from matplotlib.ticker import Formatter, FuncFormatter, MaxNLocator, StrMethodFormatter
from numpy.typing import NDArray

from flows.publish.change_pictures import CHANGED_SHARE
from flows.publish.page_data import in_base64, indexed_png
from flows.publish.panels import UNLABELLED_COLOUR, class_palette
from flows.publish.receipt_words import days_words
from flows.settings.survey_settings import BUILT_IN_SCENES
from flows.terminal.figures import format_percent, format_points, format_seconds, known_number
from pipeline.errors import visible
from pipeline.simulator.scenes.farm.farm_scene import USUAL_HOUR
from storage.archive.archive import Archive
from storage.archive.records import Run
from storage.arrays.class_maps import BeliefStore, ClassMap, load_class_map

MOST_VISITS = 60  # that a page plays: the newest
MOST_PX = 400  # of a picture's longer side
PALE = 0.8  # of what did not change
MOST_CLASSES = 128  # that are told apart, the last of them standing for none
COLOURS = ("#2f7d4f", "#c2571a", "#3465a4", "#8e6bb0", "#b58900", "#5b8a8a", "#a04050", "#777777")  # told apart by most
MOST_DOTS = 500  # of a series; longer ones are a line alone
_STYLE: Any = {"svg.fonttype": "none", "font.family": "DejaVu Sans", "font.size": 11, "timezone": "UTC"}
# the page scales it; left, bottom, width, height of 1
_SIZE_IN, _AXES = (760 / 72, 220 / 72), (0.09, 0.13, 0.89, 0.81)
_SMALL_IN, _SMALL_AXES = (360 / 72, 150 / 72), (0.17, 0.18, 0.78, 0.74)
_MOST_VALUE = 1e100  # that can be drawn; receipts may claim anything
_DAYS = (-719_160.0, 2_932_890.0)  # since 1970, of years 1 to 9999: what dates can be written of

Points = Sequence[tuple[float, float]]  # seconds since 1970, value


def read_moment(value: object) -> datetime | None:
    """Return a moment that was written in ISO 8601, in UTC; None where it is none."""
    try:
        found = datetime.fromisoformat(value) if isinstance(value, str) else None
    except ValueError:
        return None
    return None if found is None else found.replace(tzinfo=found.tzinfo or UTC).astimezone(UTC)


def moment_words(moment: datetime) -> str:
    """Return a moment in ISO 8601 and UTC."""
    return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")


def look_of(run: Run) -> datetime | None:
    """Return the moment that a run's visit is called by, else the day that its farm was drawn on.

    Of others when they began, or were published. The day is of the year in which the run was published. None where
    nothing of that can be read.
    """
    named = read_moment(run.settings.get("visit"))
    if named is not None:
        return named
    began = next((at for at in map(read_moment, (run.receipt.get("started"), run.created)) if at is not None), None)
    return _day_of_farm(run.settings, began) or began


def _day_of_farm(settings: Mapping[str, Any], published: datetime | None) -> datetime | None:
    day, hour = settings.get("day"), settings.get("hour")
    if settings.get("scene") not in BUILT_IN_SCENES or not isinstance(day, int) or published is None:
        return None
    of_day = float(hour) if isinstance(hour, int | float) else USUAL_HOUR
    if not (1 <= day <= 366 and 0 <= of_day <= 24):
        return None
    return datetime(published.year, 1, 1, tzinfo=UTC) + timedelta(days=day - 1, hours=of_day)


@dataclass(frozen=True)
class VisitPicture:
    """One visit: when, its map and what changed of it as PNG in base64, and what is said of it."""

    when: str
    map: str
    changes: str  # all else pale; empty of a first look
    words: str


def visit_pictures(archive: Archive, runs: Sequence[tuple[Run, str]]) -> list[VisitPicture]:
    """Pictures of runs with a map, given with words for when they looked, oldest first; damaged ones are left out."""
    found = []
    for run, when in runs[-MOST_VISITS:]:
        address = run.products.get("class_map")
        if run.problem is None and address is not None:
            with suppress(OSError, LookupError, ValueError):
                shown = load_class_map(archive.locate(address))
                changed = _changed_pixels(archive, run, shown.classes.shape)
                found.append(VisitPicture(when, *_drawn(shown, changed), _words(run.receipt)))
    return found


def _changed_pixels(archive: Archive, run: Run, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """Pixels (y, x) of seats with another class than remembered; None of a first look."""
    address = run.products.get("belief")
    store = None if address is None else BeliefStore(archive.locate(address))
    changed = None if store is None else store.changed()
    if store is None or changed is None:
        return None
    seats = changed >= CHANGED_SHARE
    return seats.repeat(store.patch_px, axis=0).repeat(store.patch_px, axis=1)[: shape[0], : shape[1]]


def _drawn(shown: ClassMap, changed: NDArray[np.bool_] | None) -> tuple[str, str]:
    """The map, and what changed of it among pale colours."""
    thin = -(-max(shown.classes.shape) // MOST_PX)
    palette = np.tile(np.asarray(UNLABELLED_COLOUR, np.float32), (MOST_CLASSES, 1))
    known = class_palette(len(shown.names), shown.colours)[: MOST_CLASSES - 1]
    palette[: len(known)] = known
    table = np.rint(255 * np.concatenate([palette, PALE + (1 - PALE) * palette])).astype(np.uint8)
    numbers = np.minimum(shown.classes[::thin, ::thin], MOST_CLASSES - 1)
    drawn = in_base64(indexed_png(numbers, table))
    if changed is None:
        return drawn, ""
    pale = np.where(changed[::thin, ::thin], 0, MOST_CLASSES).astype(np.uint8)
    return drawn, in_base64(indexed_png(numbers + pale, table))


def _words(receipt: Mapping[str, Any]) -> str:
    """Seconds spent, score, and what became of the memory."""
    savings = receipt.get("savings") or {}
    seconds = known_number((savings.get("capture_s") or {}).get("done"))
    parts = [] if seconds is None else [f"{format_seconds(seconds)} at the camera"]
    score = known_number((receipt.get("accuracy") or {}).get("miou"))
    parts += [] if score is None else [f"mIoU {format_points(score)}"]
    memory = receipt.get("memory")
    if not isinstance(memory, Mapping):
        return ", ".join([*parts, "a first look"])
    if memory.get("put_aside"):
        return ", ".join([*parts, f"its memory put aside ({memory['put_aside']})"])
    share = memory["changed_px"] / memory["compared_px"] if memory.get("compared_px") else 0.0
    return ", ".join([*parts, f"goes on from {days_words(memory['days'])}", f"{format_percent(share)} changed"])


@dataclass(frozen=True)
class Chart:
    """A drawing, and colours of its series by name. Without a point there is nothing to draw."""

    title: str
    legend: Mapping[str, str]
    drawing: Markup | None


def line_chart(
    series: Mapping[str, Points],
    title: str,
    unit: str = "",
    colours: Mapping[str, str] | None = None,
    *,
    small: bool = False,
    span: tuple[float, float] | None = None,
) -> Chart:
    """Draw series from 0 up, "%" as shares; same points, same bytes. ``colours`` by name, others in turn.

    A ``small`` chart stands beside others; ``span`` are the moments from which and to which their dates go together.
    """
    legend = {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(series)}
    legend |= {name: colour for name, colour in (colours or {}).items() if name in series}
    lines = {name: np.array(sorted(points)).reshape(-1, 2) for name, points in series.items()}
    lines = {name: line[(np.abs(line) < _MOST_VALUE).all(axis=1)] for name, line in lines.items()}
    every = np.concatenate([np.empty((0, 2)), *lines.values()])
    if not len(every):
        return Chart(title, legend, None)
    with mpl.rc_context({**_STYLE, "svg.hashsalt": visible(title)}):
        figure = Figure(figsize=_SMALL_IN if small else _SIZE_IN)
        FigureCanvasSVG(figure)
        axes = figure.add_axes(_SMALL_AXES if small else _AXES, frameon=False)
        for name, line in lines.items():
            dots = "o" if len(line) <= MOST_DOTS else "none"
            axes.plot(_days(line), line[:, 1], marker=dots, ms=5, lw=1.8, color=legend[name], clip_on=False)
        ends = every if span is None else np.array([(moment, 0.0) for moment in span])
        first, last, most = _days(ends).min(), _days(ends).max(), every[:, 1].max()
        around = 2.0 if first == last else 0.0
        axes.set(xlim=(first - around, last + around), ylim=(0, most if most > 1e-9 else 1))
        locator = AutoDateLocator(minticks=2, maxticks=4 if small else 7)  # type: ignore[no-untyped-call]
        dates = AutoDateFormatter(locator)  # type: ignore[no-untyped-call]
        dates.scaled |= dict.fromkeys((1 / 24, 1 / 1440), "%m-%d %H:%M")
        axes.xaxis.set(major_locator=locator, major_formatter=dates)
        values: Formatter = StrMethodFormatter(f"{{x:.3g}} {unit}".strip())
        if unit == "%":
            values = FuncFormatter(lambda share, place: f"{100 * share:.3g} %")
        axes.yaxis.set(major_locator=MaxNLocator(3 if small else 4, steps=[1, 2, 2.5, 5, 10]), major_formatter=values)
        axes.grid(axis="y", color="#88888855", clip_on=False)
        axes.tick_params(length=0, pad=8)
        figure.patch.set_visible(False)
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return Chart(title, legend, _inline(file.getvalue()))


def _days(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.clip(points[:, 0] / 86_400, *_DAYS)


def _inline(svg: str) -> Markup:
    root = ElementTree.fromstring(svg)
    for part in root.iter():
        part.tag = part.tag.partition("}")[2]
        part.attrib = {name.partition("}")[2] or name: value for name, value in part.attrib.items()}
        if part.tag == "g":
            part.attrib.pop("id", None)
    root.attrib = {"viewBox": root.attrib["viewBox"]}
    root.remove(root[0])  # its style, which would be the whole page's
    return Markup(ElementTree.tostring(root, encoding="unicode"))

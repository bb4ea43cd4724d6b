"""Line charts over dates as SVG for pages: the same points give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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

from pipeline.errors import visible

COLOURS = ("#2f7d4f", "#c2571a", "#3465a4", "#8e6bb0", "#b58900", "#5b8a8a", "#a04050", "#777777")  # told apart by most
MOST_DOTS = 500  # of a series; longer ones are a line alone
_STYLE: Any = {"svg.fonttype": "none", "font.family": "DejaVu Sans", "font.size": 11, "timezone": "UTC"}
# the page scales it; left, bottom, width, height of 1
_SIZE_IN, _AXES = (760 / 72, 220 / 72), (0.09, 0.13, 0.89, 0.81)
_SMALL_IN, _SMALL_AXES = (360 / 72, 150 / 72), (0.17, 0.18, 0.78, 0.74)
_MOST = 1e100  # that can be drawn; receipts may claim anything
_DAYS = (-719_160.0, 2_932_890.0)  # since 1970, of years 1 to 9999: what dates can be written of

Points = Sequence[tuple[float, float]]  # seconds since 1970, value


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
    lines = {name: line[(np.abs(line) < _MOST).all(axis=1)] for name, line in lines.items()}
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

"""Lines over time as inline SVG: a few series, dates below, values beside; nothing is loaded from anywhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import numpy as np

from flows.publish.page_parts import escape

WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 760.0, 220.0, 64.0, 28.0, 12.0, 12.0
_FORMS = ((1800, "%H:%M:%S"), (86_400, "%H:%M"), (300 * 86_400, "%d %b"))  # of dates, by seconds of the whole
COLOURS = ("#2f7d4f", "#c2571a", "#3465a4", "#8e6bb0", "#b58900", "#5b8a8a", "#a04050", "#777777")  # told apart by most

Points = Sequence[tuple[float, float]]  # seconds since 1970, value


def line_chart(
    series: Mapping[str, Points], title: str, unit: str = "", colours: Mapping[str, str] | None = None
) -> str:
    """A chart with its legend; words of what cannot be drawn where there is no point at all.

    ``colours`` of series by their names; others take `COLOURS` in turn.
    """
    every = [point for points in series.values() for point in points]
    if not every:
        return f"<p class=note>{escape(title)}: nothing to draw yet.</p>"
    times, values = np.array([point[0] for point in every]), np.array([point[1] for point in every])
    low, high = float(times.min()), float(times.max())
    top = float(values.max()) or 1.0
    parts = [*_axis(top, unit), *_dates(low, high)]
    drawn_in = {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(series)} | dict(colours or {})
    for name, points in series.items():
        parts += _line(name, points, drawn_in[name], (low, high, top))
    legend = " ".join(
        f'<span class="key"><i style="background:{escape(drawn_in[name])}"></i>{escape(name)}</span>' for name in series
    )
    drawing = f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{escape(title)}">{"".join(parts)}</svg>'
    return f"<h3>{escape(title)}</h3>{drawing}<p class=note>{legend}</p>"


def _place(time: float, value: float, span: tuple[float, float, float]) -> tuple[float, float]:
    low, high, top = span
    along = 0.5 if high == low else (time - low) / (high - low)
    return LEFT + along * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - value / top * (HEIGHT - BOTTOM - TOP)


def _line(name: str, points: Points, colour: str, span: tuple[float, float, float]) -> list[str]:
    places = [_place(time, value, span) for time, value in sorted(points)]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    dots = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{colour}"/>' for x, y in places[:500]]
    return [f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.8"/>', *dots]


def _axis(top: float, unit: str) -> list[str]:
    parts = []
    for share in (0.0, 0.5, 1.0):
        y = HEIGHT - BOTTOM - share * (HEIGHT - BOTTOM - TOP)
        words = f"{100 * share * top:.3g} %" if unit == "%" else f"{share * top:.3g} {unit}".strip()
        parts.append(f'<line x1="{LEFT:g}" x2="{WIDTH - RIGHT:g}" y1="{y:.1f}" y2="{y:.1f}" class="rule"/>')
        parts.append(f'<text x="{LEFT - 6:g}" y="{y + 4:.1f}" text-anchor="end">{escape(words)}</text>')
    return parts


def _dates(low: float, high: float) -> list[str]:
    span = high - low
    form = next((words for limit, words in _FORMS if span < limit), "%b %Y")
    shares = (0.5,) if high == low else (0.0, 0.25, 0.5, 0.75, 1.0)
    parts = []
    for share in shares:
        words = datetime.fromtimestamp(low + share * (high - low), UTC).strftime(form)
        x = LEFT + share * (WIDTH - LEFT - RIGHT)
        anchor = "start" if share == 0 else "end" if share == 1 else "middle"
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 8:g}" text-anchor="{anchor}">{escape(words)}</text>')
    return parts

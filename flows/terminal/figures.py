"""Numbers as text: seconds, bytes, counts, percent. An unknown number is a dash."""

from __future__ import annotations

import math
from typing import TypeGuard

DASH = "–"  # noqa: RUF001
MOST_PERCENT = 1000  # larger values are given as a factor
LEAST_HECTARES = 0.1  # smaller areas are given in square metres


def format_seconds(seconds: float | None) -> str:
    """Return a time in seconds, from ten minutes on in minutes and hours."""
    if not _known(seconds):
        return DASH
    if seconds < 1:
        return f"{seconds:.2f} s"
    if seconds < 600:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def format_bytes(count: float | None) -> str:
    """Return bytes in decimal units with three digits."""
    if not _known(count):
        return DASH
    size = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if abs(size) < 999.5:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"


def format_count(count: float | None) -> str:
    """Return a whole number with thin spaces by thousands, from ten million on in million, billion, 10^12."""
    if not _known(count):
        return DASH
    for size, name in ((1e12, "× 10¹²"), (1e9, "billion"), (1e6, "million")):  # noqa: RUF001
        if abs(count) >= max(size, 1e7):
            return f"{count / size:.3g} {name}"
    return f"{round(count):,}".replace(",", "\u202f")


def three_digits(value: float) -> str:
    """Return a number with three digits: 0.0823, 12.8, 43 700."""
    return f"{value:.3g}" if abs(value) < 100 else format_count(round(value, 2 - math.floor(math.log10(abs(value)))))


def format_percent(fraction: float | None) -> str:
    """Return a fraction in percent, with one decimal below 10 %, and from 10 on as a factor."""
    if not _known(fraction):
        return DASH
    if 0 < fraction < 0.0005:
        return "< 0.1 %"
    if abs(fraction) >= MOST_PERCENT / 100:
        return f"{three_digits(fraction)} times"
    return f"{100 * fraction:.1f} %" if abs(fraction) < 0.0995 else f"{100 * fraction:.0f} %"


def format_area(hectares: float) -> str:
    """Return an area in hectares, a small one in square metres."""
    return f"{hectares:.3g} ha" if hectares >= LEAST_HECTARES else f"{hectares * 1e4:.3g} m²"


def format_metres(length: float) -> str:
    """Return a length with three digits in m, cm or mm."""
    for unit, size in (("m", 1.0), ("cm", 0.01)):
        if length >= size:
            return f"{length / size:.3g} {unit}"
    return f"{length / 0.001:.3g} mm"


def format_days(days: float) -> str:
    """Return how long ago a capture was."""
    if days < 1:
        return f"{24 * days:.1f} hours earlier"
    return f"{days:.1f} days earlier" if days < 10 else f"{days:.0f} days earlier"


def format_points(score: float | None) -> str:
    """Return a score of 0..1 in points of 100 with one decimal."""
    return f"{100 * score:.1f}" if _known(score) else DASH


def spaced(name: str) -> str:
    """Return a name of a class or a figure in words."""
    return name.replace("_", " ")


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: 1 run, 2 runs, 0 runs."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def known_number(value: object) -> float | None:
    """Return a number of a weights' record; None for any other value."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _known(value: float | None) -> TypeGuard[float]:
    return value is not None and math.isfinite(value)

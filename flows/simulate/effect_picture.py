"""Lines with everything on, the same with the effects chosen, and their difference: one PNG with both times."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle
from numpy.typing import NDArray

from flows.publish.panels import INK, MUTED, STYLE, save_png
from flows.simulate.effect_comparison import Comparison, View
from flows.terminal.figures import format_count, format_seconds
from pipeline.simulator.effects.probe import Unit
from storage.arrays.quicklooks import develop, stretch

UNIT_SIGNS: dict[Unit, str] = {"sigma": "σ", "dn": "DN"}  # noqa: RUF001
_OF_KEY: dict[Unit, str] = {"sigma": "σ of the noise", "dn": "DN"}  # noqa: RUF001
_DPI, _PAGE_IN = 100, 16.0
_PANEL_IN = 4.8  # three px of the picture for one of the view
_MARGIN_IN, _HEAD_IN, _CAPTION_IN, _FOOT_IN = 0.4, 0.82, 0.92, 0.98
_LETTERS_IN = 13.4  # of the smallest words, on an inch
_TITLE: Any = {"loc": "left", "size": 15, "weight": "bold", "pad": 30}
_LINEAR = 0.01  # of the range, below which colours are even; beyond by its logarithm


@dataclass(frozen=True)
class Words:
    """What the figures do not tell: of what the scan is, and what was asked for."""

    scene: str
    asked: str


def draw_comparison(path: str | Path, found: Comparison, words: Words) -> None:
    """Draw the three panels as a PNG, 1600 px wide. Raises OSError: the file cannot be written."""
    with mpl.rc_context(STYLE):
        save_png(_compose(found, words), path, dpi=_DPI, pil_kwargs={"optimize": True})


def _compose(found: Comparison, words: Words) -> Figure:
    view, wide = found.view, _PANEL_IN
    tall = wide * min(max(len(view.lines) * view.sweep.step / len(view.samples), 0.2), 1.2)
    page = _HEAD_IN + _CAPTION_IN + tall + _FOOT_IN
    figure = Figure(figsize=(_PAGE_IN, page), dpi=_DPI)
    figure.text(_MARGIN_IN / _PAGE_IN, 1 - 0.45 / page, words.scene, size=22, weight="bold", va="center")
    right = 1 - _MARGIN_IN / _PAGE_IN
    which = "all" if found.lines == found.of_lines else f"{format_count(found.lines)} of"
    over = f"times and figures over {which} {format_count(found.of_lines)} lines"
    figure.text(right, 1 - 0.45 / page, over, size=12.5, color=MUTED, va="center", ha="right")
    gap = (_PAGE_IN - 2 * _MARGIN_IN - 3 * wide) / 2
    axes = [
        figure.add_axes(
            ((_MARGIN_IN + number * (wide + gap)) / _PAGE_IN, _FOOT_IN / page, wide / _PAGE_IN, tall / page)
        )
        for number in range(3)
    ]
    _draw_lines(axes[0], view.exact, view)
    spent, less = format_seconds(found.cpu_s), f"{found.ratio:.1f} times less"
    exact = f"{found.effects_exact} effects, {format_seconds(found.exact_cpu_s)} of CPU"
    _caption(axes[0], "Everything on, exact", exact)
    _draw_lines(axes[1], view.chosen, view)
    sign, asked = UNIT_SIGNS[found.unit], words.asked if len(words.asked) <= 12 else "As asked"
    title = f"{asked}, " + ("any tolerance" if found.tolerance is None else f"tolerance {found.tolerance:g} {sign}")
    _caption(axes[1], title, f"{found.effects_on} effects, {spent} of CPU: {less}")
    image = _draw_change(axes[2], found)
    bound = "without a bound" if found.bound is None else f"bound {found.bound:.2g} {sign}"
    most = f"at most {found.measured:.2g} {sign} (circle)" if found.measured else "none at all"
    _caption(axes[2], "Difference of their light", f"{most}; {bound}")
    _draw_key(figure, axes[2], image, found)
    _draw_foot(figure, found, page)
    return figure


def _draw_lines(axes: Axes, image: NDArray[np.float32], view: View) -> None:
    tones = stretch(image) if view.bands.startswith("grey") else develop(image, view.exact)
    axes.imshow(tones, interpolation="nearest", aspect="auto", extent=_extent(view))
    axes.set(xticks=[], yticks=[])


def _draw_change(axes: Axes, found: Comparison) -> AxesImage:
    """Of each sample the band that differs most, coloured up to the tolerance; the greatest is circled."""
    view, most = found.view, _most(found)
    # even near 0, logarithmic up to the tolerance; up to what was found where any or none is allowed
    norm = SymLogNorm(_LINEAR * most, linscale=0.5, vmin=-most, vmax=most)
    image = axes.imshow(
        view.change,
        cmap=mpl.colormaps["RdBu_r"],
        norm=norm,
        interpolation="nearest",
        aspect="auto",
        extent=_extent(view),
    )
    axes.set(xticks=[], yticks=[])
    place = found.place
    left, right, bottom, top = _extent(view)
    circle = Circle(
        (place.sample + 0.5, (place.line - view.lines.start + 0.5) * view.sweep.step),
        radius=0.03 * (right - left),
        facecolor="none",
        edgecolor=INK,
        linewidth=1.4,
    )
    if found.measured:
        axes.add_patch(circle)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    return image


def _extent(view: View) -> tuple[float, float, float, float]:
    return view.samples.start, view.samples.stop, len(view.lines) * view.sweep.step, 0.0


def _most(found: Comparison) -> float:
    return found.tolerance or found.measured or 1.0


def _caption(axes: Axes, title: str, words: str) -> None:
    axes.set_title(title, **_TITLE)
    axes.annotate(words, (0, 1), (0, 9), xycoords="axes fraction", textcoords="offset points", color=MUTED, size=12.5)


def _draw_key(figure: Figure, axes: Axes, image: AxesImage, found: Comparison) -> None:
    box = axes.get_position()
    height = figure.get_figheight()
    place = figure.add_axes((box.x0, box.y0 - 0.3 / height, box.width, 0.16 / height))
    most = _most(found)
    bar = figure.colorbar(image, cax=place, orientation="horizontal")
    ticks = [-most, -most / 10, -most / 100, 0.0, most / 100, most / 10, most]
    bar.set_ticks(ticks, labels=[f"{tick:.2g}".replace("-", "\u2212") for tick in ticks])
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=10.5, length=3, colors=INK)
    ends = "tolerance" if found.tolerance else "greatest"
    bar.set_label(f"{_OF_KEY[found.unit]}, the band that differs most; ends: {ends}", size=11, color=MUTED)


def _draw_foot(figure: Figure, found: Comparison, page: float) -> None:
    view = found.view
    lines, samples = view.lines, view.samples
    shown = (
        f"lines {lines.start} to {lines.stop - 1}, samples {samples.start} to {samples.stop - 1} of {view.sweep.name}"
    )
    equal = f"{100 * (1 - found.raw_unequal):.3g} %" if found.raw_unequal else "all"
    most = f", the others differ by {found.raw_most_dn} DN at most" if found.raw_most_dn else ""
    sentences = (
        f"{_joined('Left out', found.left_out)}. {_joined('Cheaper than exact', found.cheaper)}.",
        f"Read out with the same draws of noise, {equal} of the raw numbers are the same{most}.",
        f"Shown: {shown}, where the light differs most; {view.bands}.",
    )
    wide = int((2 * _PANEL_IN + 0.8) * _LETTERS_IN)
    for number, words in enumerate(sentences):
        height = (0.66 - 0.235 * number) / page
        short = textwrap.shorten(words, wide, placeholder=" ...")
        figure.text(_MARGIN_IN / _PAGE_IN, height, short, size=11, color=MUTED, va="center")


def _joined(what: str, names: tuple[str, ...]) -> str:
    return f"{what}: {', '.join(names) or 'nothing'}"

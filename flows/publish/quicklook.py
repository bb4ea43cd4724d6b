"""Draw the quicklook of a survey as one PNG: field, attention, class map, labels."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch, Rectangle
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from numpy.typing import NDArray

from flows.publish.panels import (
    MUTED,
    STYLE,
    UNLABELLED_COLOUR,
    boxes_for_letters,
    class_palette,
    class_rgb,
    grey_of,
    outline,
    png,
    thinned,
)
from flows.terminal.figures import format_percent
from pipeline.geometry.grid import UNLABELLED
from storage.arrays.class_maps import class_counts
from storage.arrays.mosaics import develop

HEAT_ALPHA = 0.72  # of scores over the field
TITLE_LETTERS, CAPTION_LETTERS, WORD_LETTERS = 7.5, 8.5, 9.5  # to an inch of a line
MOST_LETTERS = 60  # of a class in the legend


@dataclass(frozen=True)
class QuicklookData:
    """Data of the panels, as arrays. Pixels are scene pixels; patches are numbered row by row."""

    survey: str
    seed: int
    about: str  # how and when the field was captured
    policy: str | None  # of the choice of patches; None where all are segmented at full resolution
    rectified: NDArray[np.floating]  # (y, x, 3) of the pixels `thinned`, NaN where nothing was captured
    caption: str  # of these three bands, by `choose_bands`
    score: NDArray[np.floating]  # (row, column) of the padded grid's patches; NaN or -inf without a score
    patch_px: int
    patch_index: NDArray[np.integer]  # chosen, in order of rank
    blocks: tuple[tuple[int, int, int, int], ...]  # captured at full resolution: (y0, y1, x0, x1), half open [px]
    class_map: NDArray[np.integer]  # (y, x), 255 unlabelled
    class_names: tuple[str, ...]
    class_colours: NDArray[np.integer]  # (class, 3) 0..255
    truth: NDArray[np.integer] | None = None  # (y, x), 255 unlabelled
    confidence: NDArray[np.floating] | None = None  # (y, x) 0..1 of the pixels `thinned`, shown without labels
    changed: bool = False  # ``score`` is the fraction of a patch's pixels that the full network changed, NaN elsewhere
    scan: bool = False  # a uniform scan
    raster: bool = False  # without lines
    was: NDArray[np.integer] | None = None  # (y, x) previous class of captured pixels that differ, 255 elsewhere
    days: float = 0.0  # since the visit before


def draw_quicklook(panels: QuicklookData) -> bytes:
    """Draw the four panels as a PNG of about 1800 x 1400 px."""
    with mpl.rc_context(_STYLE):
        grey = np.rint(255 * np.array(UNLABELLED_COLOUR)).astype(np.uint8)
        return png(_compose(panels), np.vstack([panels.class_colours, grey]))


_STYLE: Any = {**STYLE, "axes.titlesize": 14, "axes.titleweight": "bold", "axes.titlelocation": "left"}
_DPI = 100
_PATCH_COLOUR = "#7df9ff"
_BLOCK: dict[str, Any] = {"facecolor": "none", "edgecolor": "white", "linewidth": 1.2, "linestyle": (0, (4, 2))}
_FLAT, _TALL = 0.3, 2.0  # height over width beyond which the panels are stacked, or stand abreast


def _compose(data: QuicklookData) -> Figure:
    height, width = data.class_map.shape
    tallness = height / width
    counts = (1,) * 4 if tallness < _FLAT else (4,) if tallness > _TALL else (2, 2)
    page = 18.0 if len(counts) != 2 else min(18.0, 12.5 / (tallness * sum(1 / count for count in counts)))
    tall = [min(max(page * tallness / count, 1.1), 12.0) + 0.55 for count in counts]  # with words above
    figure = Figure(figsize=(page, sum(tall) + 1.6), dpi=_DPI, layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08))
    about = [data.survey, f"{width} × {height} px", data.about, f"seed\u00a0{data.seed}"]  # noqa: RUF001
    title = fill("   ·   ".join(filter(None, about)), int(page * TITLE_LETTERS))
    figure.suptitle(title, x=0.01, ha="left", size=15, weight="bold")
    panels = iter((_draw_rectified, _draw_attention, _draw_classes, _draw_truth))
    rows = figure.subfigures(len(counts), 1, height_ratios=tall, squeeze=False).ravel()
    for row, count in zip(rows, counts, strict=True):
        for axes in row.subplots(1, count, squeeze=False).ravel():
            axes.set_anchor("NW")  # captions of a row are aligned, and as wide as their panel's part of the page
            next(panels)(axes, data)
    _draw_legend(figure, data, max(1, int(page / 2.9)))
    return figure


def _draw_rectified(axes: Axes, data: QuicklookData) -> None:
    """Draw the field; for a revisit the field in grey, with the present classes of differing pixels."""
    if data.was is not None:
        changed = data.was[thinned(data.was)] != UNLABELLED
        grey = np.repeat((0.25 + 0.6 * grey_of(data.rectified))[..., None], 3, axis=-1)
        shown = np.where(changed[..., None], class_rgb(data.class_map, data.class_colours), grey)
        _show(axes, data, shown.astype(np.float32), interpolation="nearest")
        words = f"{np.count_nonzero(data.was != UNLABELLED)} px have another class than {data.days:.3g} days before"
        return _caption(axes, "1  Captured, and differing from the prior map", words)
    _show(axes, data, develop(data.rectified, data.caption))
    return _caption(axes, "1  Raster" if data.raster else "1  Rectified", data.caption)


def _draw_attention(axes: Axes, data: QuicklookData) -> None:
    """Draw the score of every patch over the field in grey, with outlines of chosen patches and captured blocks.

    For a uniform scan draw the confidence of the map.
    """
    if data.policy is None:
        return _draw_confidence(axes, data, "2  Confidence")
    height, width = data.class_map.shape
    rows, columns = data.score.shape
    _show(axes, data, grey_of(data.rectified), cmap="gray", vmin=-0.4, vmax=1.4)
    scores, low, high = _score_range(data.score)
    heat = axes.imshow(
        scores,
        cmap=mpl.colormaps["inferno"].with_extremes(bad=(0, 0, 0, 0)),
        alpha=HEAT_ALPHA,
        vmin=low,
        vmax=high,
        interpolation="nearest",
        extent=(-0.5, columns * data.patch_px - 0.5, rows * data.patch_px - 0.5, -0.5),
    )
    for y0, y1, x0, x1 in data.blocks:
        axes.add_patch(Rectangle((x0 - 0.5, y0 - 0.5), x1 - x0, y1 - y0, **_BLOCK))
    chosen = np.zeros(rows * columns, bool)
    chosen[np.asarray(data.patch_index, np.intp)] = True
    segments = outline(chosen.reshape(rows, columns), data.patch_px, (height, width))
    for colour, thickness in (("black", 2.0), (_PATCH_COLOUR, 1.0)):
        axes.add_collection(LineCollection(segments, colors=colour, linewidths=thickness, capstyle="projecting"))
    _frame(axes, (height, width))
    if data.changed:
        _heat_key(heat, (f"{low:.0%}", f"{high:.0%}"))
        mean = float(np.nanmean(data.score)) if len(data.patch_index) else 0.0
        again = "; dashed: captured again" if data.blocks else ""
        words = f"{len(data.patch_index)} patches by {data.policy} (cyan); it changed {mean:.0%} of their pixels{again}"
        return _caption(axes, "2  Read by the full network", words)
    _heat_key(heat, ("low", "high"))
    words = f"{len(data.patch_index)} patches chosen by {data.policy} (cyan)"
    if data.scan:
        return _caption(axes, "2  Read by the full network", words)
    return _caption(axes, "2  Captured again", f"{words}; captured in detail (dashed)")


def _score_range(score: NDArray[np.floating]) -> tuple[NDArray[np.float64], float, float]:
    """Return scores to draw (the greatest for +inf, NaN without one) and the ends of their scale."""
    known = score[np.isfinite(score)].astype(np.float64)
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    shown = np.where(np.isposinf(score), high, np.where(np.isfinite(score), score, np.nan)).astype(np.float64)
    return shown, low, high if high > low else low + 1


def _draw_classes(axes: Axes, data: QuicklookData) -> None:
    _show(axes, data, class_rgb(data.class_map, data.class_colours), interpolation="nearest")
    most = max(data.class_map.shape[1] / 4, 1)  # of a bar of a round number of pixels
    length = max(step * 10 ** int(np.log10(most)) for step in (1, 2, 5) if step * 10 ** int(np.log10(most)) <= most)
    axes.add_artist(AnchoredSizeBar(axes.transData, length, f"{length} px", "lower left", borderpad=0.5))
    _caption(axes, "3  Class map", "by the model")


def _draw_truth(axes: Axes, data: QuicklookData) -> None:
    """Draw the labels; without labels the confidence."""
    if data.truth is not None:
        _show(axes, data, class_rgb(data.truth, data.class_colours), interpolation="nearest")
        labelled = (data.truth != UNLABELLED) & (data.class_map != UNLABELLED)
        right = np.count_nonzero(labelled & (data.truth == data.class_map)) / max(int(np.count_nonzero(labelled)), 1)
        words = f"labelled pixels correct: {100 * right:.1f} %" if labelled.any() else "no pixel is labelled"
        return _caption(axes, "4  Labels", words)
    if data.confidence is not None and data.policy is not None:
        return _draw_confidence(axes, data, "4  Confidence", " (no labels given)")
    axes.axis("off")
    return _caption(axes, "4  Labels", "no labels were given")


def _draw_confidence(axes: Axes, data: QuicklookData, title: str, why: str = "") -> None:
    if data.confidence is None:
        axes.axis("off")
        return _caption(axes, title, "the map has none")
    _heat_key(_show(axes, data, data.confidence, cmap="viridis", vmin=0, vmax=1), ("0", "1"))
    return _caption(axes, title, f"of the model{why}")


def _draw_legend(figure: Figure, data: QuicklookData, columns: int) -> None:
    palette = class_palette(data.class_colours)
    counts = class_counts(data.class_map, len(data.class_names))
    marks = [Patch(facecolor=tuple(colour), edgecolor="#555555", linewidth=0.6) for colour in palette]
    words = zip(data.class_names, map(format_percent, counts / max(int(counts.sum()), 1)), strict=True)
    names = [f"{name.replace('_', ' ')[:MOST_LETTERS]}  {fraction}" for name, fraction in words]
    others = [data.class_map] if data.truth is None else [data.class_map, data.truth]
    if any((image == UNLABELLED).any() for image in others):
        marks.append(Patch(facecolor=UNLABELLED_COLOUR, edgecolor="#555555", linewidth=0.6))
        names.append("unlabelled")
    for count in range(min(columns, len(names)), 0, -1):  # fewer columns for long names
        legend = figure.legend(marks, names, loc="outside lower center", ncol=count, frameon=False, fontsize=13)
        with boxes_for_letters():
            if legend.get_window_extent().width <= figure.bbox.width:
                return
        if count > 1:
            legend.remove()


def _show(axes: Axes, data: QuicklookData, image: NDArray[np.floating], **choices: Any) -> AxesImage:
    """Draw a thinned image over the whole field."""
    _frame(axes, data.class_map.shape)
    return axes.imshow(image, extent=(*axes.get_xlim(), *axes.get_ylim()), **choices)


def _frame(axes: Axes, shape: tuple[int, ...]) -> None:
    axes.set(xticks=[], yticks=[], xlim=(-0.5, shape[1] - 0.5), ylim=(shape[0] - 0.5, -0.5))


def _caption(axes: Axes, title: str, words: str) -> None:
    """Write a bold title over words, both in lines of the panel's part of the page."""
    grid: Any = axes.get_gridspec()
    width = axes.figure.bbox.width / _DPI / grid.ncols
    lines = fill(words, int(width * WORD_LETTERS))
    axes.set_title(fill(title, int(width * CAPTION_LETTERS)) + "\n" * (1 + lines.count("\n")))
    placed: Any = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "bottom"}
    # Long captions do not narrow the panel.
    axes.annotate(lines, (0, 1), (0, 4), color=MUTED, size=12, **placed).set_in_layout(False)


def _heat_key(image: AxesImage, ends: tuple[str, str]) -> None:
    """Draw a colour bar with the values of its ends in the lower right corner."""
    box = image.axes.inset_axes((0.62, 0.09, 0.3, 0.03))
    bar = image.axes.figure.colorbar(image, cax=box, orientation="horizontal")
    low, high = image.get_clim()
    bar.set_ticks([low or 0.0, high or 1.0], labels=list(ends))
    for label in box.get_xticklabels():
        label.set(bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1})

"""Draw the quicklook of a survey as one PNG: field, chosen patches, class map, labels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.publish.panels import STYLE, UNLABELLED_COLOUR, class_rgb, png
from spectralzoom.flows.terminal.figures import format_percent, spaced
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.arrays.class_maps import class_counts
from spectralzoom.storage.arrays.mosaics import develop

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLE_LETTERS, CAPTION_LETTERS = 7.5, 9.0  # to an inch of a line
LETTER_IN, MARK_IN = 0.15, 0.7  # of the legend
MOST_LETTERS = 60  # of a class in the legend
CHOSEN_RGB = (0.0, 0.8, 0.85)


@dataclass(frozen=True)
class QuicklookData:
    """Data of the panels, as arrays. Pixels are scene pixels."""

    survey: str
    seed: int
    about: str  # how the field was captured
    rectified: NDArray[np.floating]  # (y, x, 3) of the pixels `thinned`, NaN where nothing was captured
    caption: str  # of these three bands, by `choose_bands`
    class_map: NDArray[np.integer]  # (y, x), 255 unlabelled
    class_names: tuple[str, ...]
    class_colours: NDArray[np.integer]  # (class, 3) 0..255
    confidence: NDArray[np.floating]  # (y, x) 0..1 of the pixels `thinned`, shown without labels
    chosen: NDArray[np.bool_] | None = None  # (y, x) of the pixels `thinned` in chosen patches; None without a choice
    choice: str = ""  # what the patches were chosen for
    truth: NDArray[np.integer] | None = None  # (y, x), 255 unlabelled
    was: NDArray[np.integer] | None = None  # (y, x) previous class of captured pixels that differ, 255 elsewhere


def draw_quicklook(data: QuicklookData) -> bytes:
    """Draw the four panels as a PNG of about 1800 x 1400 px."""
    import matplotlib as mpl  # after its cache folder is placed

    with mpl.rc_context(STYLE):
        grey = np.rint(255 * np.array(UNLABELLED_COLOUR)).astype(np.uint8)
        return png(_compose(data), np.vstack([data.class_colours, grey]))


_DPI = 100
_FLAT, _TALL = 0.3, 2.0  # height over width beyond which the panels are stacked, or stand abreast


def _compose(data: QuicklookData) -> Figure:
    from matplotlib.figure import Figure

    height, width = data.class_map.shape
    tallness = height / width
    rows, columns = (4, 1) if tallness < _FLAT else (1, 4) if tallness > _TALL else (2, 2)
    page = min(18.0, 12.5 / tallness) if rows == columns else 18.0
    panel = min(max(page * tallness / columns, 1.1), 12.0) + 0.55  # with its title
    figure = Figure(figsize=(page, rows * panel + 1.6), dpi=_DPI, layout="constrained")
    about = (data.survey, f"{width} × {height} px", data.about, f"seed\u00a0{data.seed}")  # noqa: RUF001
    title = fill("   ·   ".join(filter(None, about)), int(page * TITLE_LETTERS))
    figure.suptitle(title, x=0.01, ha="left", size=15, weight="bold")
    for axes, (words, image) in zip(figure.subplots(rows, columns).flat, _panels(data), strict=True):
        axes.set_anchor("NW")
        axes.set_title(fill(words, int(page / columns * CAPTION_LETTERS)), loc="left", size=12)
        axes.set(xticks=[], yticks=[])
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        axes.imshow(image, extent=extent, cmap="viridis", vmin=0, vmax=1, interpolation="nearest")
    _draw_legend(figure, data, page)
    return figure


def _panels(data: QuicklookData) -> Iterator[tuple[str, NDArray[np.floating]]]:
    """Yield title and image (y, x) or (y, x, 3) of the four panels."""
    rectified = develop(data.rectified, data.caption)
    confidence = "Confidence of the model, dark 0 to bright 1", data.confidence
    yield f"1  Field: {data.caption}", rectified
    if data.chosen is None:
        yield f"2  {confidence[0]}", confidence[1]
    else:
        grey = np.repeat(rectified.mean(axis=-1, keepdims=True), 3, axis=-1)
        shown = np.where(data.chosen[..., None], (grey + np.array(CHOSEN_RGB)) / 2, grey)
        yield f"2  {data.choice} (cyan)", shown
    yield "3  Class map by the model", class_rgb(data.class_map, data.class_colours)
    if data.truth is None:
        yield f"4  {confidence[0]} (no labels given)", confidence[1]
        return
    labelled = (data.truth != UNLABELLED) & (data.class_map != UNLABELLED)
    right = np.count_nonzero(labelled & (data.truth == data.class_map)) / max(int(np.count_nonzero(labelled)), 1)
    words = f"labelled pixels correct: {100 * right:.1f} %" if labelled.any() else "no pixel is labelled"
    yield f"4  Labels: {words}", class_rgb(data.truth, data.class_colours)


def _draw_legend(figure: Figure, data: QuicklookData, page: float) -> None:
    from matplotlib.patches import Patch

    counts = class_counts(data.class_map, len(data.class_names))
    words = zip(data.class_names, map(format_percent, counts / max(int(counts.sum()), 1)), strict=True)
    names = [f"{spaced(name)[:MOST_LETTERS]}  {fraction}" for name, fraction in words]
    colours: list[Any] = [*np.asarray(data.class_colours) / 255]
    others = [data.class_map] if data.truth is None else [data.class_map, data.truth]
    if any((image == UNLABELLED).any() for image in others):
        names.append("unlabelled")
        colours.append(UNLABELLED_COLOUR)
    marks = [Patch(facecolor=tuple(colour), edgecolor="#555555", linewidth=0.6) for colour in colours]
    columns = max(1, int(page / (LETTER_IN * max(map(len, names)) + MARK_IN)))
    figure.legend(marks, names, loc="outside lower center", ncol=min(columns, len(names)), frameon=False, fontsize=13)

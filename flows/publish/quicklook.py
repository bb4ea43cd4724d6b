"""Draw the quicklook of a survey as one PNG (field, chosen patches, class map, labels), and parts of pictures."""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from spectralzoom.flows.terminal.figures import format_percent, spaced
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.arrays.class_maps import class_counts
from spectralzoom.storage.arrays.mosaics import develop

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = 256  # of a PNG
MOST_PX = 2048  # of a picture's longer side; larger fields are subsampled
INK = "#22241f"
STYLE: Any = {
    "font.size": 12,
    "text.parse_math": False,  # names of surveys and classes may hold dollar signs
    "font.family": "DejaVu Sans",
    "axes.edgecolor": "#b8b8b0",
    "axes.linewidth": 0.8,
    "text.color": INK,
    "axes.labelcolor": INK,
    "figure.facecolor": "#fbfaf7",
    "savefig.facecolor": "#fbfaf7",
}
UNLABELLED_RGB = (219, 219, 214)
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
        return png(_compose(data), np.vstack([data.class_colours, UNLABELLED_RGB]))


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


def _panels(data: QuicklookData) -> Iterator[tuple[str, NDArray[np.generic]]]:
    """Yield title and image (y, x) or (y, x, 3) of the four panels."""
    rectified = develop(data.rectified, data.caption)
    palette, thin = palette_of(data.class_colours), thinned(data.class_map)
    confidence = "Confidence of the model, dark 0 to bright 1", data.confidence
    yield f"1  Field: {data.caption}", rectified
    if data.chosen is None:
        yield f"2  {confidence[0]}", confidence[1]
    else:
        grey = np.repeat(rectified.mean(axis=-1, keepdims=True), 3, axis=-1)
        shown = np.where(data.chosen[..., None], (grey + np.array(CHOSEN_RGB)) / 2, grey)
        yield f"2  {data.choice} (cyan)", shown
    yield "3  Class map by the model", palette[data.class_map[thin]]
    if data.truth is None:
        yield f"4  {confidence[0]} (no labels given)", confidence[1]
        return
    labelled = (data.truth != UNLABELLED) & (data.class_map != UNLABELLED)
    right = np.count_nonzero(labelled & (data.truth == data.class_map)) / max(int(np.count_nonzero(labelled)), 1)
    words = f"labelled pixels correct: {100 * right:.1f} %" if labelled.any() else "no pixel is labelled"
    yield f"4  Labels: {words}", palette[data.truth[thin]]


def _draw_legend(figure: Figure, data: QuicklookData, page: float) -> None:
    from matplotlib.patches import Patch

    counts = class_counts(data.class_map, len(data.class_names))
    words = zip(data.class_names, map(format_percent, counts / max(int(counts.sum()), 1)), strict=True)
    names = [f"{spaced(name)[:MOST_LETTERS]}  {fraction}" for name, fraction in words]
    colours = [*np.asarray(data.class_colours)]
    others = [data.class_map] if data.truth is None else [data.class_map, data.truth]
    if any((image == UNLABELLED).any() for image in others):
        names.append("unlabelled")
        colours.append(np.array(UNLABELLED_RGB))
    marks = [Patch(facecolor=tuple(colour / 255), edgecolor="#555555", linewidth=0.6) for colour in colours]
    columns = max(1, int(page / (LETTER_IN * max(map(len, names)) + MARK_IN)))
    figure.legend(marks, names, loc="outside lower center", ncol=min(columns, len(names)), frameon=False, fontsize=13)


def thinned(image: NDArray[np.generic]) -> tuple[slice, slice]:
    """Return the rows and columns of a (y, x) field that pictures show."""
    return (slice(None, None, -(-max(image.shape) // MOST_PX)),) * 2


def png(figure: Figure, exact: ArrayLike = ()) -> bytes:
    """Return a figure as PNG of 256 colours, with these ``exact`` ones (n, 3) among them, at most half of all."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph", UserWarning)  # a letter that the font lacks is a box
        canvas.draw()  # type: ignore[no-untyped-call]
    drawn = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    kept = np.reshape(exact, (-1, 3))[: COLOURS // 2].astype(np.uint8)
    others = COLOURS - len(kept)
    rough = Image.fromarray(drawn).convert("RGB").quantize(others, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    numbers = np.array(rough)
    packed = drawn.view(np.uint32)[..., 0]
    for number, colour in enumerate(kept, others):
        numbers[packed == np.array([*colour, 255], np.uint8).view(np.uint32)] = number
    picture = Image.fromarray(numbers)
    palette = rough.getpalette() or []
    picture.putpalette([*palette, *[0] * (3 * others - len(palette)), *kept.ravel().tolist()])
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()


def webp(picture: Image.Image, **choices: Any) -> bytes:
    """Return a picture as WebP; ``choices`` are those of Pillow."""
    file = io.BytesIO()
    picture.save(file, "WEBP", **choices)
    return file.getvalue()


def data_address(content: bytes) -> str:
    """Return a PNG or WebP as a data address for a page."""
    kind = "webp" if content.startswith(b"RIFF") else "png"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def palette_of(colours: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Return the colour of each class number (256, 3); numbers without one are light grey."""
    palette = np.tile(np.array(UNLABELLED_RGB, np.uint8), (256, 1))
    palette[: len(colours)] = colours
    return palette

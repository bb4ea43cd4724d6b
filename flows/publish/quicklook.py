"""Draw the quicklook of a survey as one PNG (field, second pass, class map, labels), and parts of pictures."""

from __future__ import annotations

import base64
import io
import warnings
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
TITLE_LETTERS, CAPTION_LETTERS = 7.5, 8.5  # to an inch of a line
LETTER_IN, MARK_IN = 0.15, 0.7  # of the legend
MOST_LETTERS = 60  # of a class in the legend
AGAIN_RGB, READ_RGB = (0, 190, 200), (240, 150, 20)  # captured again, read in full


@dataclass(frozen=True)
class QuicklookData:
    """Data of the panels, as arrays. Pixels are scene pixels; (y, x) "thin" are those of `thinned`."""

    survey: str
    seed: int
    about: str  # how the field was captured
    rectified: NDArray[np.floating]  # (y, x, 3) thin, NaN where nothing was captured
    caption: str  # of these three bands, by `choose_bands`
    class_map: NDArray[np.integer]  # (y, x), 255 unlabelled
    class_names: tuple[str, ...]
    class_colours: NDArray[np.integer]  # (class, 3) 0..255
    confidence: NDArray[np.floating]  # (y, x) thin, 0..1
    again: NDArray[np.bool_] | None = None  # (y, x) thin, in the second pass; None without one
    read: NDArray[np.bool_] | None = None  # (y, x) thin, read by the full network; None without one
    gain: NDArray[np.floating] | None = None  # (y, x) thin, expected of the patch; None if it chose none
    truth: NDArray[np.integer] | None = None  # (y, x), 255 unlabelled
    was: NDArray[np.integer] | None = None  # (y, x) previous class of captured pixels that differ, 255 elsewhere
    pixel_m: float | None = None  # side of all pixels on the ground; None if it is unknown or varies


def draw_quicklook(data: QuicklookData) -> bytes:
    """Draw the panels, all of one size, as a PNG of about 1800 x 1400 px."""
    import matplotlib as mpl  # after its cache folder is placed

    with mpl.rc_context(STYLE):
        return png(_compose(data), np.vstack([data.class_colours, UNLABELLED_RGB]))


_DPI = 100
_WIDTH_IN, _HEIGHT_IN, _LEAST_IN = 18.0, 11.0, 12.0  # of all panels together, at most; and of the page
_GAP_IN, _LINE_IN = 0.15, 0.24  # between panels, and of a line of text


def _compose(data: QuicklookData) -> Figure:
    from matplotlib.figure import Figure

    height, width = data.class_map.shape
    panels = _panels(data)
    columns, page = _columns(len(panels), height / width)
    rows = -(-len(panels) // columns)
    cell = page / columns - _GAP_IN
    high = min(cell * height / width, _HEIGHT_IN / rows)
    about = (data.survey, f"{width} × {height} px", data.about, f"seed\u00a0{data.seed}")  # noqa: RUF001
    title = fill("   ·   ".join(filter(None, about)), int(page * TITLE_LETTERS))
    captions = [fill(f"{n}  {words}", int(cell * CAPTION_LETTERS)) for n, (words, _) in enumerate(panels, 1)]
    above = (1 + max(one.count("\n") for one in captions)) * _LINE_IN + _GAP_IN
    head = (1 + title.count("\n")) * _LINE_IN * 1.3
    entries = _legend_entries(data)
    abreast = min(len(entries), max(1, int(page / (LETTER_IN * max(len(name) for name, _ in entries) + MARK_IN))))
    total = head + rows * (above + high) + (2 - len(entries) // -abreast) * _LINE_IN
    figure = Figure(figsize=(page, total), dpi=_DPI)
    figure.suptitle(title, x=0.01, y=1 - 0.08 / total, ha="left", va="top", size=15, weight="bold")
    for number, (_, image) in enumerate(panels):
        row, column = divmod(number, columns)
        left, low = column * (cell + _GAP_IN) + _GAP_IN / 2, total - head - (row + 1) * (above + high)
        axes = figure.add_axes((left / page, low / total, cell / page, high / total), anchor="NW")
        axes.set_title(captions[number], loc="left", size=13)
        axes.set(xticks=[], yticks=[])
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        axes.imshow(image, extent=extent, cmap="viridis", vmin=0, vmax=1, interpolation="nearest")
    _draw_legend(figure, entries, abreast)
    return figure


def _columns(count: int, tallness: float) -> tuple[int, float]:
    """Return the columns of panels that make them largest, and the width of the page [inch]."""

    def width(columns: int) -> float:
        return min(_WIDTH_IN / columns, _HEIGHT_IN / -(-count // columns) / tallness)

    best = max(range(1, count + 1), key=lambda columns: (round(width(columns), 3), columns))
    return best, max(_LEAST_IN, best * width(best))


def _panels(data: QuicklookData) -> list[tuple[str, NDArray[np.generic]]]:
    """Return title and image (y, x) or (y, x, 3) of the panels; those without data are left out."""
    rectified = develop(data.rectified, data.caption)
    palette, thin = palette_of(data.class_colours), thinned(data.class_map)
    panels: list[tuple[str, NDArray[np.generic]]] = [(f"Field: {data.caption}", rectified)]
    if data.again is not None:
        panels.append((covered_title("Captured again", data.again), _tinted(rectified, data.again, AGAIN_RGB)))
    if data.gain is not None:
        panels.append((span_title("Expected gain", data.gain), stretched(data.gain)))
    if data.read is not None:
        panels.append((covered_title("Read in full", data.read), _tinted(rectified, data.read, READ_RGB)))
    panels.append(("Class map by the model", palette[data.class_map[thin]]))
    if data.truth is not None:
        labelled = (data.truth != UNLABELLED) & (data.class_map != UNLABELLED)
        right = np.count_nonzero(labelled & (data.truth == data.class_map)) / max(int(np.count_nonzero(labelled)), 1)
        words = f"labelled pixels correct: {100 * right:.1f} %" if labelled.any() else "no pixel is labelled"
        panels.append((f"Labels: {words}", palette[data.truth[thin]]))
    if data.truth is None or data.again is None:
        panels.append((span_title("Confidence", data.confidence), stretched(data.confidence)))
    return panels


def _tinted(picture: NDArray[np.floating], where: NDArray[np.bool_], rgb: tuple[int, int, int]) -> NDArray[np.floating]:
    grey = np.repeat(picture.mean(axis=-1, keepdims=True), 3, axis=-1)
    return np.where(where[..., None], (grey + np.array(rgb) / 255) / 2, grey)


def covered_title(name: str, where: NDArray[np.bool_]) -> str:
    """Return the title of a picture of chosen pixels, with their fraction."""
    return f"{name}: {'the whole field' if where.all() else format_percent(float(where.mean())) + ' of the field'}"


def span_title(name: str, values: NDArray[np.floating]) -> str:
    """Return the title of a picture of `stretched` values, with the values of its ends."""
    low, high = span_words(values)
    return f"{name}, dark {low} to bright {high}"


def span_words(values: NDArray[np.floating]) -> tuple[str, str]:
    """Return the ends of the span with two digits; a low end that is next to nothing is 0."""
    low, high = span_of(values)
    return "0" if abs(low) < 0.01 * high else f"{low:.2g}", f"{high:.2g}"


def span_of(values: NDArray[np.floating]) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the known values; 0 and 1 without any."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (1, 99)).tolist() if known.size else (0.0, 1.0)
    return low, high


def stretched(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return values as 0..1 over their own `span_of`; unknown ones stay NaN."""
    low, high = span_of(values)
    return np.asarray(np.clip((values - low) / ((high - low) or 1.0), 0, 1))


def _legend_entries(data: QuicklookData) -> list[tuple[str, NDArray[np.integer]]]:
    """Return name with fraction, and colour of each class that the map or the labels have."""
    others = [data.class_map] if data.truth is None else [data.class_map, data.truth]
    counts = class_counts(data.class_map, len(data.class_names))
    shown = np.sum([class_counts(image, len(data.class_names)) for image in others], axis=0)
    words = zip(data.class_names, counts / max(int(counts.sum()), 1), data.class_colours, shown, strict=True)
    entries = [
        (f"{spaced(name)[:MOST_LETTERS]}  {format_percent(fraction)}", colour)
        for name, fraction, colour, is_shown in words
        if is_shown
    ]
    if any((image == UNLABELLED).any() for image in others):
        entries.append(("unlabelled", np.array(UNLABELLED_RGB)))
    return entries


def _draw_legend(figure: Figure, entries: list[tuple[str, NDArray[np.integer]]], columns: int) -> None:
    from matplotlib.patches import Patch

    marks = [Patch(facecolor=tuple(colour / 255), edgecolor="#555555", linewidth=0.6) for _, colour in entries]
    names = [name for name, _ in entries]
    figure.legend(marks, names, loc="lower center", ncol=columns, frameon=False, fontsize=13)


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

"""Draw parts of pictures: palettes, outlines of patches, the map on the ground."""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from flows.terminal.figures import format_area
from pipeline.geometry.grid import UNLABELLED
from storage.arrays.ground_maps import GroundMap
from storage.arrays.mosaics import stretch

COLOURS = 256  # of a PNG
MOST_PX = 2048  # of a picture's longer side; larger fields are subsampled
GROUND_IN, GROUND_DPI, GROUND_MOST_PX = 9.0, 130, 1200
INK = "#22241f"
MUTED = "#6a6d64"
PAPER, GRID = "#fbfaf7", "#e3e1d8"  # of plots
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
UNLABELLED_COLOUR = (0.86, 0.86, 0.84)


def thinned(image: NDArray[np.generic]) -> tuple[slice, slice]:
    """Return the rows and columns of a (y, x) field that pictures show."""
    return (slice(None, None, -(-max(image.shape) // MOST_PX)),) * 2


@contextmanager
def boxes_for_letters() -> Iterator[None]:
    """Draw a box for a letter that the font lacks, without a warning."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph", UserWarning)
        yield


def png(figure: Figure, exact: ArrayLike = ()) -> bytes:
    """Return a figure as PNG of 256 colours, with these ``exact`` ones (n, 3) among them, at most half of all."""
    canvas = FigureCanvasAgg(figure)
    with boxes_for_letters():
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


def grey_of(image: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the brightness (y, x) of a field, 0..1: the mean of its bands, stretched."""
    known = np.isfinite(image)
    total, count = np.where(known, image, 0).sum(axis=-1, dtype=np.float32), known.sum(axis=-1)
    mean = np.divide(total, count, out=np.full(total.shape, np.nan, np.float32), where=count > 0)
    return stretch(mean[..., None])[..., 0]


def class_palette(colours: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return (class, 3) colours 0..255 as 0..1."""
    return np.asarray(colours, np.float32) / np.float32(255)


def class_rgb(classes: NDArray[np.integer], colours: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return the pixels `thinned` of a class map as a picture (y, x, 3); numbers without a colour are light grey."""
    table = np.tile(np.asarray(UNLABELLED_COLOUR, np.float32), (256, 1))
    table[: len(colours)] = class_palette(colours)
    return np.asarray(table[np.clip(classes[thinned(classes)], 0, UNLABELLED)])


def outline(chosen: NDArray[np.bool_], patch_px: int, shape: tuple[int, int]) -> list[list[tuple[float, float]]]:
    """Return the border of some patches as segments ((x, y), (x, y)) in scene px, clipped to the (y, x) ``shape``."""
    padded = np.pad(chosen, 1)
    limit = np.array([shape[1], shape[0]], np.float64)
    segments = []
    for axis in (0, 1):
        row, column = np.nonzero(np.diff(padded, axis=axis))
        start = np.stack([column - (axis == 0), row - (axis == 1)], axis=-1)
        end = start + ((1, 0) if axis == 0 else (0, 1))
        ends = np.minimum(np.stack([start, end], axis=1) * patch_px, limit) - 0.5
        segments += [[tuple(point) for point in pair] for pair in ends if (pair[0] != pair[1]).any()]
    return segments


def draw_ground(found: GroundMap) -> bytes:
    """Draw picture and class map side by side as PNG: north up, axes in metres, hectares in the legend."""
    box = found.geobox.boundingbox
    extent = (0.0, box.right - box.left, 0.0, box.top - box.bottom)
    figure = Figure(
        figsize=(GROUND_IN, GROUND_IN / 2 * min(max(extent[3] / extent[1], 0.4), 1.6) + 1.1),
        dpi=GROUND_DPI,
        layout="constrained",
    )
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    thin = slice(None, None, -(-max(found.classes.shape) // GROUND_MOST_PX))
    seen = found.picture[thin, thin].any(axis=-1, keepdims=True)
    left.imshow(np.where(seen, found.picture[thin, thin], 255), extent=extent)
    palette = np.vstack([found.legend.colours, np.full((256 - len(found.legend.colours), 3), 255, np.uint8)])
    right.imshow(palette[found.classes[thin, thin]], extent=extent, interpolation="nearest")
    for axes, title in ((left, "as seen, coarse"), (right, "classes")):
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("metres east", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.set_facecolor("white")
    left.set_ylabel("metres north", fontsize=9)
    present = set(np.unique(found.classes).tolist()) - {UNLABELLED}
    patches = [
        Patch(
            facecolor=found.legend.colours[number] / 255,
            edgecolor="0.4",
            linewidth=0.5,
            label=f"{name.replace('_', ' ')}  {format_area(found.areas.get(name, {}).get('ha', 0.0))}",
        )
        for number, name in enumerate(found.legend.names)
        if number in present
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return png(figure, found.legend.colours)

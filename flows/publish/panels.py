"""Draw parts of pictures: palettes, PNG and WebP files."""

from __future__ import annotations

import base64
import io
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from spectralzoom.pipeline.geometry.grid import UNLABELLED

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
UNLABELLED_COLOUR = (0.86, 0.86, 0.84)


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


def class_rgb(classes: NDArray[np.integer], colours: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return the pixels `thinned` of a class map as a picture (y, x, 3); numbers without a colour are light grey."""
    table = np.tile(np.asarray(UNLABELLED_COLOUR, np.float32), (256, 1))
    table[: len(colours)] = np.asarray(colours, np.float32) / np.float32(255)
    return np.asarray(table[np.clip(classes[thinned(classes)], 0, UNLABELLED)])

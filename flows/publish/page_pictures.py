"""Pictures as pages hold them: numbers with a palette that a page can read again, photographs as JPEG."""

from __future__ import annotations

import base64
import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Bytes = NDArray[np.uint8]
QUALITY = 84  # of photographs


def indexed_png(numbers: Bytes, colours: Bytes) -> bytes:
    """PNG of (y, x) numbers, each drawn in its row of ``colours``, (number, 3 or 4) red green blue and opacity.

    A reader of the PNG gets the numbers themselves; those without a row are black.
    """
    picture = Image.fromarray(np.ascontiguousarray(numbers, np.uint8))
    table = np.zeros((256, 4), np.uint8)
    table[:, 3] = 255
    table[: len(colours), : colours.shape[1]] = colours
    picture.putpalette(table[:, :3].tobytes())
    opaque = bool((table[:, 3] == 255).all())
    return _saved(picture, **({} if opaque else {"transparency": table[:, 3].tobytes()}))


def grey_png(values: Bytes) -> bytes:
    """PNG of (y, x) bytes as they are."""
    return _saved(Image.fromarray(np.ascontiguousarray(values, np.uint8)))


def _saved(picture: Image.Image, **choices: bytes) -> bytes:
    file = io.BytesIO()
    picture.save(file, "PNG", **choices)
    return file.getvalue()


def jpeg(picture: Bytes) -> bytes:
    """JPEG of a (y, x, 3) photograph."""
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture, np.uint8)).save(file, "JPEG", quality=QUALITY)
    return file.getvalue()


def in_base64(content: bytes) -> str:
    """Bytes as a page holds them."""
    return base64.b64encode(content).decode("ascii")

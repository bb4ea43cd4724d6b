"""What a page carries with it instead of loading it: scripts, a library for maps, pictures; and who may run in it.

Numbers go as PNG with a palette that a page can read again, photographs as JPEG.
"""

from __future__ import annotations

import base64
import hashlib
import io
from functools import cache
from importlib.resources import files

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image

LEAFLET = "vendor/leaflet-1.9.4"  # leafletjs.com, BSD-2-Clause: unchanged from npm's registry
SHA256 = {
    f"{LEAFLET}/leaflet.js": "db49d009c841f5ca34a888c96511ae936fd9f5533e90d8b2c4d57596f4e5641a",
    f"{LEAFLET}/leaflet.css": "a7837102824184820dfa198d1ebcd109ff6d0ff9a2672a074b9a1b4d147d04c6",
    f"{LEAFLET}/LICENSE": "53e8dc25862014e4324741ca18fbe3611e11d42ef69f59f86ea8c5389647d4cb",
}

Bytes = NDArray[np.uint8]
QUALITY = 84  # of photographs


@cache
def part(name: str) -> str:
    """A file beside this module as it stands in a page: without what would point at files elsewhere."""
    text = files("flows.publish").joinpath(name).read_text(encoding="utf-8").replace("\r\n", "\n")
    elsewhere = "url(" if name.endswith(".css") else "//# sourceMappingURL="  # pictures that no page uses; a debugger's
    return "\n".join(line for line in text.split("\n") if elsewhere not in line)


def scripts(names: tuple[str, ...]) -> Markup:
    """Scripts in their order, as the tags that hold them."""
    return Markup("\n").join(Markup("<script>{}</script>").format(Markup(part(name))) for name in names)


def policy(names: tuple[str, ...]) -> str:
    """The content security policy of a page with these scripts: they alone run, and nothing is loaded from anywhere."""
    sources = [f"'sha256-{base64.b64encode(hashlib.sha256(part(name).encode()).digest()).decode()}'" for name in names]
    allowed = " ".join(sources) or "'none'"
    return (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}; "
        "base-uri 'none'; form-action 'none'"
    )


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

"""Make the map of a report: the pictures of a run as layers, each embedded in the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from spectralzoom.flows.frame import Prior
from spectralzoom.flows.publish.quicklook import (
    AGAIN_RGB,
    READ_RGB,
    QuicklookData,
    covered_title,
    data_address,
    palette_of,
    span_title,
    span_words,
    stretched,
    thinned,
    webp,
)
from spectralzoom.flows.terminal.figures import format_days, format_percent, spaced
from spectralzoom.pipeline.errors import visible
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.arrays.class_maps import class_counts, load_class_map
from spectralzoom.storage.arrays.mosaics import develop

QUALITY = 80  # of a photograph as WebP
LEVELS = 50  # of a colour ramp; the next number is transparent
DIFFERS_RGB = (196, 38, 46)
NO_SECOND_PASS = "Captured again: nothing, there was no second pass"
NO_FULL_NETWORK = "Read in full: nothing, the weights have no full network"
NO_GAIN = "Expected gain: alike everywhere, or not computed"
NO_CLASS = "no class, of the field:"  # other fractions of the legend are of the pixels that have one
RIGHT_RGB, WRONG_RGB = (201, 211, 196), (196, 38, 46)  # of labelled pixels


@dataclass(frozen=True)
class MapLayer:
    """A layer of the map, a picture."""

    title: str
    picture: str  # as an address of data
    shown: bool = False
    opacity: float = 1.0


@dataclass(frozen=True)
class FieldMap:
    """Content of the map: size (width, height) [px], layers from the lowest up, classes with colour and fraction.

    ``ramps`` are the names of layers of values with those of their dark and bright end.
    """

    size: tuple[int, int]
    layers: Sequence[MapLayer]
    classes: Sequence[dict[str, str]]
    ramps: Sequence[dict[str, str]] = ()
    pixel_m: float | None = None  # None: the scale bar is in pixels

    @property
    def data(self) -> dict[str, Any]:
        """Return the data for the page's script."""
        return {
            "size": list(self.size),
            "pixel_m": self.pixel_m,
            "layers": [{**asdict(layer), "title": visible(layer.title)} for layer in self.layers],
        }


def prior_classes(prior: Prior) -> NDArray[np.uint8]:
    """Return the (y, x) class map of an earlier run by the class numbers of this run; 255 for other classes."""
    earlier = np.array(prior.classes)
    names = np.full(256, UNLABELLED, np.uint8)
    names[earlier[earlier >= 0]] = np.flatnonzero(earlier >= 0)
    before = load_class_map(prior.probabilities.path / "class_map.zarr").classes
    return np.asarray(names[before])


def field_map(shown: QuicklookData, prior: Prior | None) -> FieldMap:
    """Return the map of a run from the data of its quicklook and the prior map."""
    thin = thinned(shown.class_map)
    palette = palette_of(shown.class_colours)

    def classes(image: NDArray[np.integer]) -> str:
        return layer_address(image[thin], palette)

    picture = Image.fromarray(np.rint(255 * develop(shown.rectified, shown.caption)).astype(np.uint8))
    layers = [MapLayer(shown.caption.capitalize(), data_address(webp(picture, quality=QUALITY)), shown=True)]
    layers.append(MapLayer("Class map", classes(shown.class_map), shown=True))
    layers.append(MapLayer(span_title("Confidence", shown.confidence), _ramp_address(shown.confidence)))
    layers += _choices(shown)
    if shown.truth is not None:
        layers.append(MapLayer("Truth", classes(shown.truth)))
        errors = error_address(shown.class_map[thin], shown.truth[thin])
        layers.append(MapLayer("Errors: map and truth differ", errors, opacity=0.8))
    if prior is not None:
        layers.append(MapLayer(f"Before: {format_days(prior.days)}", classes(prior_classes(prior))))
    if shown.was is not None:
        differs = over_address(shown.was[thin] != UNLABELLED, DIFFERS_RGB)
        layers.append(MapLayer("Captured and differing", differs, opacity=0.8))
    counts = class_counts(shown.class_map, len(shown.class_names))
    covered = np.append(counts / max(counts.sum(), 1), 1 - counts.sum() / max(shown.class_map.size, 1))
    rows = [
        {"name": spaced(name), "fraction": format_percent(fraction), "colour": "#" + bytes(colour.tolist()).hex()}
        for name, fraction, colour in zip((*shown.class_names, NO_CLASS), covered, palette, strict=False)
        if fraction
    ]
    values = {"confidence": shown.confidence, **({} if shown.gain is None else {"expected gain": shown.gain})}
    ends = {name: span_words(one) for name, one in values.items()}
    ramps = [{"name": name, "low": low, "high": high} for name, (low, high) in ends.items()]
    return FieldMap((shown.class_map.shape[1], shown.class_map.shape[0]), layers, rows, ramps, shown.pixel_m)


def _choices(shown: QuicklookData) -> list[MapLayer]:
    """Return the layers of expected gain, second pass and full network; one without data says so in its title."""
    nothing = over_address(np.zeros((1, 1)))
    gain = MapLayer(NO_GAIN, nothing)
    if shown.gain is not None:
        gain = MapLayer(span_title("Expected gain", shown.gain), _ramp_address(shown.gain))
    found = [gain]
    for name, where, colour, without in (
        ("Read in full", shown.read, READ_RGB, NO_FULL_NETWORK),
        ("Captured again", shown.again, AGAIN_RGB, NO_SECOND_PASS),
    ):
        layer = MapLayer(without, nothing)
        if where is not None:
            layer = MapLayer(covered_title(name, where), over_address(where, colour), opacity=0.6)
        found.append(layer)
    return found


def error_address(class_map: NDArray[np.integer], labels: NDArray[np.integer]) -> str:
    """Return a picture of where (y, x) classes differ from labels; pixels without class or label are transparent."""
    judged = (class_map != UNLABELLED) & (labels != UNLABELLED)
    return over_address(np.where(judged, 1 + (class_map != labels), 0), RIGHT_RGB, WRONG_RGB)


def over_address(numbers: NDArray[np.generic], *colours: tuple[int, int, int]) -> str:
    """Return a picture of (y, x) numbers to lay over another: 0 is transparent, the others have these colours."""
    return layer_address(numbers.astype(np.uint8), [(0, 0, 0, 0), *((*colour, 255) for colour in colours)])


def layer_address(numbers: NDArray[np.integer], colours: ArrayLike) -> str:
    """Return the data address of a picture of (y, x) numbers, each in its row of ``colours`` (number, 3 or 4)."""
    table = np.asarray(colours, np.uint8)
    return data_address(webp(Image.fromarray(table[numbers]).convert("RGBA"), lossless=True, quality=0))


def _ramp_address(values: NDArray[np.floating]) -> str:
    """Draw (y, x) values over their own span from dark to bright; unknown ones are transparent."""
    from matplotlib import colormaps

    table = np.zeros((LEVELS + 2, 4), np.uint8)
    table[: LEVELS + 1] = np.rint(255 * colormaps["viridis"](np.linspace(0, 1, LEVELS + 1)))
    known = np.isfinite(values)
    levels = np.rint(LEVELS * np.where(known, stretched(values), 0))
    return layer_address(np.where(known, levels, LEVELS + 1).astype(np.uint8), table)

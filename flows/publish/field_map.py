"""The map of a report that one can move in: its layers, taken from the stores of a run, and how a page holds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from flows.publish.page_data import (
    NOTHING,
    PagePlaces,
    PageSpectra,
    class_means,
    grey_png,
    in_base64,
    indexed_png,
    jpeg,
)
from flows.publish.panels import UNLABELLED_COLOUR, class_palette
from pipeline.geometry.grid import UNLABELLED

MOST_PX = 2048  # of a map's longer side; of larger ones every n-th pixel is shown
PERCENT = 100
CHANGED_RGB, SEAT_RGB = (196, 38, 46), (0, 190, 200)
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class SweepShown:
    """A sweep as a rectangle of the field, rows and columns (y0, y1, x0, x1) half open [px], and what is said of it."""

    box: tuple[int, int, int, int]
    kind: str
    words: str


@dataclass(frozen=True)
class FieldMap:
    """What the map shows. Images are on the scene's pixels, those of seats on seats of ``patch_px``."""

    names: tuple[str, ...]
    colours: NDArray[np.integer] | None  # (class, 3); None for the palette of pages
    classes: Bytes  # (y, x), 255 none
    picture: Bytes  # (y, x, 3) true colour, or what stands for it
    picture_words: str
    patch_px: int
    confidence: NDArray[np.floating] | None = None  # (y, x) 0..1
    truth: NDArray[np.integer] | None = None  # (y, x), 255 none
    before: Bytes | None = None  # (y, x) classes as remembered, 255 none
    before_words: str = ""
    changed: NDArray[np.floating] | None = None  # (row, column) of seats, share of pixels of another class
    age_days: NDArray[np.floating] | None = None  # (y, x) since a pixel was looked at
    seats: NDArray[np.bool_] | None = None  # (row, column) looked at twice
    sweeps: Sequence[SweepShown] = ()
    spectra: PageSpectra | None = None
    places: PagePlaces | None = None


@dataclass(frozen=True)
class MapLayer:
    """A layer of the page: what its switch is called, whether it is on, and how opaque it is, in percent."""

    key: str
    title: str
    on: bool = False
    opacity: int = PERCENT


def map_facts(field: FieldMap) -> dict[str, Any]:
    """What the page's template needs: ``layers``, ``classes`` of the legend, ``still`` as PNG, ``notes``, ``data``."""
    height, width = field.classes.shape
    step = -(-max(height, width) // MOST_PX)
    thin = slice(None, None, step)
    shown = field.classes[thin, thin]
    palette = np.rint(255 * class_palette(len(field.names), field.colours)).astype(np.uint8)
    table = np.tile(np.rint(255 * np.array(UNLABELLED_COLOUR)).astype(np.uint8), (256, 1))
    table[: len(palette)] = palette
    images = {"classes": shown, "truth": field.truth, "before": field.before}
    data: dict[str, Any] = {
        "size": [width, height],
        "step": step,
        "patch": field.patch_px,
        "colours": table[[*range(len(palette)), UNLABELLED]].tolist(),
        "names": [name.replace("_", " ") for name in field.names],
        "colour": in_base64(jpeg(field.picture[thin, thin])),
        "sweeps": [{"box": list(one.box), "kind": one.kind, "words": one.words} for one in field.sweeps],
    }
    for key in ("truth", "before"):
        if (image := images[key]) is not None:
            data[key] = in_base64(indexed_png(image[thin, thin].astype(np.uint8), table))
    if field.confidence is not None:
        data["confidence"] = in_base64(_percent_png(field.confidence[thin, thin]))
    data |= _seat_layers(field)
    if field.spectra is not None:
        data["spectra"] = _spectra_facts(field.spectra, field.classes, len(field.names))
    if field.places is not None:
        data["places"] = _places_facts(field.places)
    return {
        "layers": _layers(field),
        "classes": _legend(field, table),
        "still": in_base64(indexed_png(shown, table)),
        "notes": _notes(field, step),
        "data": data,
    }


def _layers(field: FieldMap) -> list[MapLayer]:
    """The switches of what there is, in the order in which they lie upon each other, the uppermost first."""
    there = {
        "sweeps": MapLayer("sweeps", "Sweeps, in their order") if field.sweeps else None,
        "seats": MapLayer("seats", "Looked at twice", opacity=60) if field.seats is not None else None,
        "changed": MapLayer("changed", "Changed since", opacity=80) if field.changed is not None else None,
        "age": MapLayer("age", "Days since it was looked at", opacity=80) if field.age_days is not None else None,
        "before": MapLayer("before", f"Before: {field.before_words}") if field.before is not None else None,
        "truth": MapLayer("truth", "Truth") if field.truth is not None else None,
        "confidence": MapLayer("confidence", "Confidence") if field.confidence is not None else None,
        "classes": MapLayer("classes", "Class map", on=True),
        "colour": MapLayer("colour", field.picture_words, on=True),
    }
    return [layer for layer in there.values() if layer is not None]


def _legend(field: FieldMap, table: Bytes) -> list[dict[str, Any]]:
    counts = np.bincount(field.classes.ravel(), minlength=256)
    shares = counts / max(field.classes.size, 1)
    rows = [
        {"number": number, "name": name.replace("_", " "), "share": float(share), "colour": _css(colour)}
        for number, (name, share, colour) in enumerate(zip(field.names, shares, table, strict=False))
    ]
    others = [image for image in (field.truth, field.before) if image is not None]
    if counts[len(field.names) :].any() or any((image >= len(field.names)).any() for image in others):
        share = float(shares[len(field.names) :].sum())
        none = {"number": len(field.names), "name": "no class", "share": share, "colour": _css(table[UNLABELLED])}
        rows.append(none)
    return rows


def _css(colour: Bytes) -> str:
    return "#" + bytes(colour.tolist()).hex()


def _percent_png(confidence: NDArray[np.floating]) -> bytes:
    """Confidence in whole percent, 255 where there is none."""
    known = np.isfinite(confidence)
    numbers = np.where(known, np.rint(PERCENT * np.clip(np.where(known, confidence, 0), 0, 1)), NOTHING)
    return indexed_png(numbers.astype(np.uint8), _ramp(PERCENT + 1))


def _ramp(count: int) -> Bytes:
    """(256, 4) colours of numbers 0 to ``count`` - 1 from dark to bright, others see-through."""
    table = np.zeros((256, 4), np.uint8)
    table[:count] = np.rint(255 * colormaps["viridis"](np.linspace(0, 1, count))).astype(np.uint8)
    return table


def _seat_layers(field: FieldMap) -> dict[str, Any]:
    rows, columns = (-(-size // field.patch_px) for size in field.classes.shape)
    found: dict[str, Any] = {}
    if field.seats is not None:
        table = np.array([(0, 0, 0, 0), (*SEAT_RGB, 255)], np.uint8)
        found["seats"] = in_base64(indexed_png(field.seats[:rows, :columns].astype(np.uint8), table))
    if field.changed is not None:
        table = np.array([(*CHANGED_RGB, round(255 * share / PERCENT)) for share in range(PERCENT + 1)], np.uint8)
        shares = np.nan_to_num(field.changed[:rows, :columns])
        found["changed"] = in_base64(indexed_png(np.rint(PERCENT * np.clip(shares, 0, 1)).astype(np.uint8), table))
    if field.age_days is not None:
        ages = field.age_days[field.patch_px // 2 :: field.patch_px, field.patch_px // 2 :: field.patch_px]
        known = np.isfinite(ages)
        most = float(ages[known].max()) if known.any() else 0.0
        levels = np.where(known, np.rint(PERCENT * np.where(known, ages, 0) / (most or 1.0)), NOTHING)
        found["age"] = in_base64(indexed_png(levels.astype(np.uint8), _ramp(PERCENT + 1)))
        found["oldest"] = most
    return found


def _spectra_facts(spectra: PageSpectra, classes: Bytes, count: int) -> dict[str, Any]:
    means, sizes = class_means(spectra, classes, count)
    height, width, bands = spectra.levels.shape
    return {
        "png": in_base64(grey_png(spectra.levels.reshape(height, width * bands))),  # bands of a pixel lie side by side
        "shape": [height, width, bands],
        "low": spectra.low.tolist(),
        "step": spectra.step.tolist(),
        "nm": np.round(spectra.wavelength_nm, 2).tolist(),
        "pixel": spectra.pixel_px,
        "means": [_listed(row, 5) if size else None for row, size in zip(means, sizes, strict=True)],
        "sizes": sizes.tolist(),
    }


def _listed(values: NDArray[np.floating], digits: int) -> list[float | None]:
    """Numbers one after the other, None where there is none."""
    return [round(value, digits) if np.isfinite(value) else None for value in values.ravel().tolist()]


def _places_facts(places: PagePlaces) -> dict[str, Any]:
    rows, columns = places.on_map.shape[:2]
    return {
        "crs": places.crs,
        "nodes": [rows, columns],
        "map": _listed(places.on_map, 3),
        "lonlat": _listed(places.lon_lat, 8),
    }


def _notes(field: FieldMap, step: int) -> list[str]:
    """What has to be known to read the map, a sentence each."""
    found = [] if step == 1 else [f"The map is large: one of {step} x {step} px is shown."]
    spectra = field.spectra
    if spectra is not None:
        bands = f"{len(spectra.wavelength_nm)} bands"
        if spectra.bands_each > 1:
            bands += f", each the mean of {spectra.bands_each} of the camera's"
        found.append(
            f"A spectrum is the mean over {spectra.pixel_px} x {spectra.pixel_px} px of the coarse look, in {bands}, "
            f"each kept in {NOTHING} steps from its least to its greatest value. A class's mean is over those of which "
            "it covers half or more."
        )
    if field.places is not None:
        found.append(f"Map coordinates are {field.places.crs}.")
    return found

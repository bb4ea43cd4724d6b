"""Say in one sentence what the map of a field shows: area and place of its classes, or their changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.flows.publish.quicklook import thinned
from spectralzoom.flows.terminal.figures import format_area, format_days, format_percent, spaced

MOST, MORE = 0.7, 0.2  # of a class in a part of the field, and above the fraction of all classes there
RAREST = 3  # classes of a sentence besides the largest one
LEAST_CLASS, LEAST_CHANGE = 0.001, 0.001  # of the field; smaller ones are likely errors of the map
CHANGED = 2  # classes of a sentence on changes


def main_places(classes: NDArray[np.integer], names: Sequence[str], geobox: GeoBox | None) -> dict[str, str]:
    """Return the part of the field with most pixels of a class, in words; classes that are spread have none.

    ``classes`` (y, x) are indices of ``names``, others have no class. With a ``geobox`` whose axes point east and
    north, the words are those of the compass.
    """
    thin = classes[thinned(classes)]
    y, x = np.nonzero(thin < len(names))
    numbers = thin[y, x]
    if not numbers.size:
        return {}
    compass = False
    if geobox is not None and geobox.crs is not None:
        compass = {axis.direction for axis in geobox.crs.proj.axis_info} >= {"east", "north"}
        a, b, _, d, e, _ = geobox.affine[:6]
        x, y = (a * x + b * y, -d * x - e * y) if compass else (x, y)
    across, down = (2 * (at - at.min()) / (np.ptp(at) or 1) - 1 for at in (x, y))  # -1 to 1
    middle = (abs(across) < 0.5) & (abs(down) < 0.5)
    parts = np.stack([down < 0, down >= 0, across < 0, across >= 0, middle])
    usual = parts.mean(axis=1)
    found = {}
    for number, name in enumerate(names):
        if (here := numbers == number).any():
            share = parts[:, here].mean(axis=1)
            if words := _words((share >= MOST) & (share >= usual + MORE), compass=compass):
                found[name] = words
    return found


def _words(most: NDArray[np.bool_], *, compass: bool) -> str:
    """Return a place in words by whether most lies above, below, left, right, or in the middle."""
    *sides, middle = most.tolist()
    words = ("north", "south", "west", "east") if compass else ("top", "bottom", "left", "right")
    named = [word for word, is_there in zip(words, sides, strict=True) if is_there]
    if not named:
        return "in the middle" if middle else ""
    if compass:
        return f"in the {'-'.join(named)}"
    return f"{'at' if any(sides[:2]) else 'on'} the {' '.join(named)}"


def class_sentence(receipt: Mapping[str, Any]) -> str:
    """Return area and place of the rarest classes and of the largest one; after a prior map the largest changes."""
    areas = receipt["areas"]
    sizes: Mapping[str, float] = areas.get("ha") or areas["px"]
    total = sum(sizes.values())
    if not total:
        return "No pixel has a class."

    def words_of(size: float, field: str = "") -> str:
        fraction = f"{format_percent(size / total)}{field}"
        return f"{format_area(size)} ({fraction})" if "ha" in areas else fraction

    def state_of(name: str, field: str = " of the field") -> str:
        place = areas.get("place", {}).get(name)
        return words_of(sizes[name], field) + (f", mostly {place}" if place else "")

    since = ""
    if (prior := receipt.get("prior_map")) is not None:
        since = f"Since the visit {format_days(prior['days'])}"
        changes = _net_changes(receipt, areas)
        named = [name for name, size in changes.items() if abs(size) >= LEAST_CHANGE * total][:CHANGED]
        if named:
            show = format_area if "ha" in areas else lambda size: format_percent(size / total)
            signed = {name: f"{'+' if changes[name] > 0 else '-'}{show(abs(changes[name]))}" for name in named}
            return f"{since}: {'; '.join(f'{spaced(one)} {signed[one]}, now {state_of(one)}' for one in named)}."
        since += " no class has changed. "
    ordered = sorted((name for name in sizes if sizes[name]), key=lambda name: sizes[name])
    rare = [name for name in ordered[:-1] if sizes[name] >= LEAST_CLASS * total][:RAREST]
    named = [f"{spaced(name)} {state_of(name, '' if number else ' of the field')}" for number, name in enumerate(rare)]
    largest = f"{spaced(ordered[-1])} {words_of(sizes[ordered[-1]], '' if rare else ' of the field')}"
    text = "; ".join([*named, f"largest: {largest}" if rare else largest])
    return f"{since}{text[:1].upper()}{text[1:]}."


def _net_changes(receipt: Mapping[str, Any], areas: Mapping[str, Any]) -> dict[str, float]:
    """Return gain minus loss of each class that changed, [ha] or [px]; the largest first, and gain before loss."""
    pairs = (receipt.get("ground") or {}).get("changes_ha")
    scale = 1.0
    if pairs is None:
        pairs = receipt["prior_map"].get("changes", ())
        scale = sum(areas["ha"].values()) / sum(areas["px"].values()) if "ha" in areas else 1.0
    found: dict[str, float] = {}
    for size, *_, old, new in pairs:
        found[old] = found.get(old, 0.0) - scale * size
        found[new] = found.get(new, 0.0) + scale * size
    return dict(sorted(found.items(), key=lambda one: (-abs(one[1]), -one[1])))

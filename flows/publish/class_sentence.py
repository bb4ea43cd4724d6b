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
MIDDLE_THIRD, AROUND_MIDDLE = 1 / 6, 0.3  # of the centre of area, and of the class around the middle; sides end at 1/2
RAREST = 3  # classes of a sentence besides the largest one
LEAST_CLASS, LEAST_CHANGE = 0.001, 0.001  # of the field; smaller ones are likely errors of the map
CHANGED = 2  # classes of a sentence on changes


def main_places(classes: NDArray[np.integer], names: Sequence[str], geobox: GeoBox | None) -> dict[str, str]:
    """Return the part of the field with most pixels of a class, in words; classes that are spread have none.

    ``classes`` (y, x) are indices of ``names``, others have no class: places are those within the pixels with a class.
    The third of the field with the centre of area names the place, if most of the class lies on that side. With a
    ``geobox`` whose axes point east and north, the words are those of the compass.
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
    extents = ((at - (at.min() + at.max()) / 2, np.ptp(at)) for at in (x, y))
    at = np.stack([off / (size or 1) for off, size in extents])  # across and down, -1/2 to 1/2
    found = {}
    for number, name in enumerate(names):
        if (here := numbers == number).any():
            centre = at[:, here].mean(axis=1)
            side = np.where(abs(centre) > MIDDLE_THIRD, np.sign(centre), 0)
            inside = np.all(side[:, None] * at >= 0 if side.any() else abs(at) <= AROUND_MIDDLE, axis=0)
            if inside[here].mean() >= max(MOST, inside.mean() + MORE):
                found[name] = _words(*side.tolist(), compass=compass)
    return found


def _words(across: float, down: float, *, compass: bool) -> str:
    """Return a place in words by its side across and down: -1, 1, or 0 for the middle."""
    words = (("north", "south"), ("west", "east")) if compass else (("top", "bottom"), ("left", "right"))
    named = [pair[side > 0] for pair, side in zip(words, (down, across), strict=True) if side]
    if not named:
        return "in the middle"
    if compass:
        return f"in the {'-'.join(named)}"
    return f"{'at' if down else 'on'} the {' '.join(named)}"


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

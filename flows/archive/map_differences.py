"""The picture of where two maps of one field differ: both maps, and the changed pixels by their pair of classes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from flows.publish.panels import UNLABELLED_COLOUR, class_palette, class_rgb, save_png
from flows.terminal.figures import format_count
from pipeline.geometry.grid import UNLABELLED

DPI, PANEL_IN, MOST_PX, MOST_PAIRS = 130, 4.6, 1200, 10
SAME, OTHER = (0.96, 0.96, 0.95), (0.35, 0.36, 0.34)
TITLES = ("A", "B", "where B differs from A")


@dataclass(frozen=True)
class MapPair:
    """Two maps with one list of classes. 255 is no class."""

    old: NDArray[np.uint8]  # (y, x)
    new: NDArray[np.uint8]  # (y, x)
    names: tuple[str, ...]
    colours: NDArray[np.uint8]  # (class, 3)
    pairs: Sequence[tuple[int, int, int]]  # class of A, class of B, pixels: the largest first

    def name(self, number: int) -> str:
        return self.names[number].replace("_", " ") if number < len(self.names) else "no class"


def draw_difference(maps: MapPair, titles: Sequence[str]) -> bytes:
    """Draw map A, map B and the changed pixels coloured by their pair of classes, PNG."""
    height, width = maps.old.shape
    tall = PANEL_IN * min(max(height / width, 0.3), 2.0)
    present = sorted(set(np.unique(maps.old).tolist()) | set(np.unique(maps.new).tolist()))
    rows = max(-(-len(present) // 2), -(-len(maps.pairs[:MOST_PAIRS]) // 2) + 1)
    with mpl.rc_context({"text.parse_math": False}):  # names may hold dollar signs
        figure = Figure(figsize=(3 * PANEL_IN, tall + 0.6 + 0.17 * rows), dpi=DPI, layout="constrained")
        step = -(-max(height, width) // MOST_PX)
        thin = slice(None, None, step)
        palette = class_palette(len(maps.names), maps.colours)
        seen = [class_rgb(found[thin, thin], palette) for found in (maps.old, maps.new)]
        pictures = (*seen, change_rgb(thin_changes(maps, step)))
        for axes, picture, title, words in zip(figure.subplots(1, 3), pictures, TITLES, titles, strict=True):
            axes.imshow(picture, interpolation="nearest")
            axes.set_title(f"{title}\n{words}", fontsize=9, loc="left")
            axes.set_axis_off()
        _draw_legends(figure, maps, palette, present)
        buffer = io.BytesIO()
        save_png(figure, buffer)
    return buffer.getvalue()


def thin_changes(maps: MapPair, step: int) -> MapPair:
    """One pixel of every ``step`` x ``step``: one that differs where there is any, so that no change is left out."""
    height, width = maps.old.shape
    beyond = ((0, -height % step), (0, -width % step))
    blocks = [
        np.pad(found, beyond).reshape(-(-height // step), step, -(-width // step), step).swapaxes(1, 2)
        for found in (maps.old, maps.new)
    ]
    old, new = (block.reshape(*block.shape[:2], step * step) for block in blocks)
    place = (old != new).argmax(axis=-1)[..., None]
    old, new = (np.take_along_axis(found, place, axis=-1)[..., 0] for found in (old, new))
    return replace(maps, old=old, new=new)


def change_rgb(maps: MapPair) -> NDArray[np.float32]:
    """(y, x, 3) picture 0..1: the largest pairs in colours of their own, other changes dark, what is the same light."""
    picture = np.empty((*maps.old.shape, 3), np.float32)
    picture[:] = SAME
    picture[maps.old != maps.new] = OTHER
    for (old, new, _), colour in zip(maps.pairs[:MOST_PAIRS], class_palette(MOST_PAIRS), strict=False):
        picture[(maps.old == old) & (maps.new == new)] = colour
    return picture


def _draw_legends(figure: Figure, maps: MapPair, palette: NDArray[np.float32], present: list[int]) -> None:
    def patch(colour: Any, label: str) -> Patch:
        return Patch(facecolor=colour, edgecolor="0.4", linewidth=0.5, label=label)

    classes = [
        patch(UNLABELLED_COLOUR if number == UNLABELLED else palette[number], maps.name(number)) for number in present
    ]
    pairs = [
        patch(colour, f"{maps.name(old)} to {maps.name(new)}: {format_count(count)} px")
        for (old, new, count), colour in zip(maps.pairs, class_palette(MOST_PAIRS), strict=False)
    ]
    ends = [patch(SAME, "the same"), *([patch(OTHER, "other changes")] if len(maps.pairs) > MOST_PAIRS else [])]
    right = [*pairs, *ends]
    low, high = sorted((("left", classes), ("right", right)), key=lambda side: len(side[1]))
    style: dict[str, Any] = {"fontsize": 8, "frameon": False, "ncols": 2}
    for place, handles in ((f"lower {low[0]}", low[1]), (f"outside lower {high[0]}", high[1])):  # room for the taller
        figure.legend(handles=handles, **style, loc=cast("Any", place))

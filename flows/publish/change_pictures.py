"""Pictures of what changed: today's map beside the one that is remembered, and where two maps of one field differ."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from flows.publish.panels import UNLABELLED_COLOUR, class_palette, class_rgb, outline, save_png
from flows.publish.receipt import Receipt
from flows.publish.receipt_words import days_words
from flows.publish.report import Picture
from flows.tasks.memory import Prior
from flows.terminal.figures import counted, format_count
from pipeline.geometry.grid import UNLABELLED
from storage.archive.keys import StageRef
from storage.arrays.class_maps import BeliefStore, ClassNames
from storage.arrays.layout import open_group, read_array

CHANGED_SHARE = 0.25  # of a seat's pixels, from which it is said to have changed
WIDTH_IN, DPI, MOST_PX = 9.0, 130, 1200
CHANGED = "#c4262e"
PANEL_IN, MOST_PAIRS = 4.6, 10
SAME, OTHER = (0.96, 0.96, 0.95), (0.35, 0.36, 0.34)
TITLES = ("A", "B", "where B differs from A")


@dataclass(frozen=True)
class RememberedField:
    """What a map that goes on from an earlier run remembers of it."""

    run: str
    days: float  # between that look and this one
    classes: NDArray[np.uint8]  # (y, x) of that run's map, by the numbers of today's; 255 for those that today has not
    changed: NDArray[np.float32]  # (seat_y, seat_x) shares of pixels of another class
    age_days: NDArray[np.float32]  # (y, x) since a pixel was looked at, NaN where it never was


def remembered(prior: Prior | None, drawn: StageRef, receipt: Receipt) -> RememberedField | None:
    """What is remembered, None where a map goes on from no other run or put its memory aside.

    ``drawn`` is the store of the class map and of what is believed.
    """
    memory = receipt.get("memory")
    if memory is None or prior is None or memory["put_aside"]:
        return None
    names = np.full(256, UNLABELLED, np.uint8)
    for number, earlier in enumerate(prior.classes):
        if earlier >= 0:
            names[earlier] = number
    belief = BeliefStore(drawn.path / "belief.zarr")
    changed = belief.changed()
    assert changed is not None
    before = read_array(open_group(prior.belief.path / "class_map.zarr"), "classes")
    return RememberedField(prior.run, prior.days, names[before], changed, belief.age())


def change_pictures(
    before: RememberedField | None, now: NDArray[np.uint8], legend: ClassNames, patch_px: int
) -> list[Picture]:
    """What changed since the run that a map goes on from, with its caption; nothing where it goes on from none.

    ``now`` is the (y, x) class map of today.
    """
    if before is None:
        return []
    seats = before.changed >= CHANGED_SHARE
    png = draw_changes(before.classes, now, legend, seats, patch_px, days_words(before.days))
    caption = f"What changed since {before.run}: {counted(int(np.count_nonzero(seats)), 'place')} of another class."
    return [Picture(png, caption)]


def draw_changes(
    before: NDArray[np.uint8],
    now: NDArray[np.uint8],
    legend: ClassNames,
    changed: NDArray[np.bool_],
    patch_px: int,
    earlier: str,
) -> bytes:
    """PNG of two class maps of one field; ``changed`` (seat_y, seat_x) are outlined in the later one."""
    tall = now.shape[0] / now.shape[1]
    figure = Figure(figsize=(WIDTH_IN, WIDTH_IN / 2 * min(max(tall, 0.4), 1.6) + 0.9), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    palette, (y, x) = class_palette(len(legend.names), legend.colours), now.shape
    thin = slice(None, None, -(-max(y, x) // MOST_PX))
    for axes, classes, title in ((left, before, f"as remembered, {earlier}"), (right, now, "now")):
        axes.imshow(
            class_rgb(classes[thin, thin], palette), extent=(-0.5, x - 0.5, y - 0.5, -0.5), interpolation="nearest"
        )
        axes.set_title(title, fontsize=10)
        axes.set_xticks([])
        axes.set_yticks([])
    right.add_collection(LineCollection(outline(changed, patch_px, (y, x)), colors=CHANGED, linewidths=1.4))
    present = sorted((set(np.unique(before).tolist()) | set(np.unique(now).tolist())) - {UNLABELLED})
    patches = [
        Patch(facecolor=palette[number], edgecolor="0.4", linewidth=0.5, label=legend.names[number].replace("_", " "))
        for number in present
        if number < len(legend.names)
    ]
    patches.append(Patch(facecolor="none", edgecolor=CHANGED, linewidth=1.4, label="another class than remembered"))
    figure.legend(handles=patches, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    buffer = io.BytesIO()
    save_png(figure, buffer)
    return buffer.getvalue()


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

"""The picture of what changed: the map that is remembered beside today's, seats with another class outlined."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from flows.publish.panels import class_palette, class_rgb, outline, save_png
from flows.publish.receipt import Receipt
from flows.publish.receipt_words import days_words
from flows.publish.report import Picture
from flows.survey.memory import Prior
from flows.terminal.figures import counted
from pipeline.geometry.grid import UNLABELLED
from storage.archive.keys import StageRef
from storage.arrays.beliefs import BeliefStore
from storage.arrays.class_maps import ClassNames
from storage.arrays.layout import open_group, read_array

CHANGED_SHARE = 0.25  # of a seat's pixels, from which it is said to have changed
WIDTH_IN, DPI, MOST_PX = 9.0, 130, 1200
CHANGED = "#c4262e"


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

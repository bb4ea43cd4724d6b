"""The picture of what changed: the map that is remembered beside today's, seats with another class outlined."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from flows.publish.panels import class_palette, class_rgb, outline, save_png
from flows.publish.receipt import Receipt
from flows.publish.receipt_table import days_words
from flows.publish.report import Picture
from flows.survey.memory import Prior
from flows.terminal.figures import counted
from pipeline.geometry.grid import UNLABELLED
from storage.archive.keys import StageRef
from storage.arrays.beliefs import BeliefStore
from storage.arrays.class_maps import ClassMap, load_class_map

CHANGED_SHARE = 0.25  # of a seat's pixels, from which it is said to have changed
WIDTH_IN, DPI, MOST_PX = 9.0, 130, 1200
CHANGED = "#c4262e"


def change_pictures(prior: Prior | None, drawn: StageRef, receipt: Receipt, patch_px: int) -> list[Picture]:
    """What changed since the run that a map goes on from, with its caption; nothing where it goes on from none.

    ``drawn`` is the store of the class map and of what is believed.
    """
    memory = receipt.get("memory")
    if memory is None or prior is None or memory["put_aside"]:
        return []
    before, now = (load_class_map(path / "class_map.zarr") for path in (prior.belief.path, drawn.path))
    names = np.full(256, UNLABELLED, np.uint8)  # classes of before by the weights' numbers of today
    for number, earlier in enumerate(prior.classes):
        if earlier >= 0:
            names[earlier] = number
    changed = BeliefStore(drawn.path / "belief.zarr").changed()
    assert changed is not None
    seats = changed >= CHANGED_SHARE
    png = draw_changes(names[before.classes], now, seats, patch_px, days_words(prior.days))
    caption = f"What changed since {prior.run}: {counted(int(np.count_nonzero(seats)), 'place')} of another class."
    return [Picture(png, caption)]


def draw_changes(
    before: NDArray[np.uint8], now: ClassMap, changed: NDArray[np.bool_], patch_px: int, earlier: str
) -> bytes:
    """PNG of two class maps of one field; ``changed`` (seat_y, seat_x) are outlined in the later one."""
    tall = now.classes.shape[0] / now.classes.shape[1]
    figure = Figure(figsize=(WIDTH_IN, WIDTH_IN / 2 * min(max(tall, 0.4), 1.6) + 0.9), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    palette, (y, x) = class_palette(len(now.names), now.colours), now.classes.shape
    thin = slice(None, None, -(-max(y, x) // MOST_PX))
    for axes, classes, title in ((left, before, f"as remembered, {earlier}"), (right, now.classes, "now")):
        axes.imshow(
            class_rgb(classes[thin, thin], palette), extent=(-0.5, x - 0.5, y - 0.5, -0.5), interpolation="nearest"
        )
        axes.set_title(title, fontsize=10)
        axes.set_xticks([])
        axes.set_yticks([])
    right.add_collection(LineCollection(outline(changed, patch_px, (y, x)), colors=CHANGED, linewidths=1.4))
    present = sorted((set(np.unique(before).tolist()) | set(np.unique(now.classes).tolist())) - {UNLABELLED})
    patches = [
        Patch(facecolor=palette[number], edgecolor="0.4", linewidth=0.5, label=now.names[number].replace("_", " "))
        for number in present
        if number < len(now.names)
    ]
    patches.append(Patch(facecolor="none", edgecolor=CHANGED, linewidth=1.4, label="another class than remembered"))
    figure.legend(handles=patches, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    buffer = io.BytesIO()
    save_png(figure, buffer)
    return buffer.getvalue()

"""A frame of an evaluation as a picture: what the camera saw, the labels, the map, and the seats it was drawn from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from flows.evaluate.frames import Look
from flows.evaluate.rows import Trial, placings
from flows.publish.panels import INK, class_palette, class_rgb, outline
from flows.terminal.figures import format_percent
from models.evaluation.metrics import confusion, mean_iou, overall_accuracy
from models.reading.inference import segment
from models.weights.files import Weights
from pipeline.geometry.grid import UNLABELLED
from pipeline.planning.selection import frame_seats
from storage.arrays.quicklooks import choose_bands, stretch

LONG_SIDE = 900  # of a panel [px]; larger frames are thinned


def draw_frame(path: Path, title: str, look: Look, weights: Weights, policy: str, share: float) -> None:
    """Draw one frame at one share of the seats into a PNG file."""
    figure = frame_figure(title, look, weights, policy, share)
    FigureCanvasAgg(figure)
    figure.savefig(path, format="png")


def frame_figure(title: str, look: Look, weights: Weights, policy: str, share: float) -> Figure:
    """Give the figure of four panels: image, labels, map, and where map and labels differ with the seats."""
    seats = chosen_seats(look, weights, policy, share)
    drawn = segment(weights, look.seen, look.fine[seats], seats).classes
    counts = confusion(look.labels, drawn, weights.config.classes)
    scores = f"mIoU {100 * mean_iou(counts):.1f}, overall {100 * overall_accuracy(counts):.1f}"
    palette = class_palette(weights.config.classes, weights.class_colours)
    height, width = look.labels.shape
    step = max(1, max(height, width) // LONG_SIDE)
    figure = Figure(figsize=(12, 12 * height / width + 1.2), dpi=100, layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    known = look.labels != UNLABELLED
    wrong = np.where(known & (drawn != look.labels), 1.0, 0.0)[..., None]
    faded = 0.25 + 0.6 * _image(look, weights).mean(axis=-1, keepdims=True)
    error = np.concatenate([np.maximum(faded, wrong), faded * (1 - wrong), faded * (1 - wrong)], axis=-1)
    pictures = {
        "image": _image(look, weights),
        "labels": class_rgb(look.labels, palette),
        f"map: {policy}, K = {format_percent(share)}, {scores}": class_rgb(drawn, palette),
        f"{len(seats)} of {len(look.seen.grid.valid_seats())} seats; red: not the label": error,
    }
    for axes, (name, picture) in zip(panels, pictures.items(), strict=True):
        _draw_panel(axes, name, picture[::step, ::step], (height, width))
    chosen = np.zeros(look.seen.grid.seat_shape, bool)
    chosen.ravel()[seats] = True
    lines = outline(chosen, look.seen.grid.patch, (height, width))
    for axes in panels[[0, 3]]:
        axes.add_collection(LineCollection(lines, colors="#FFD23F", linewidths=1.0))
    handles = [Patch(color=tuple(c), label=n) for n, c in zip(weights.class_names, palette, strict=True)]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False, labelcolor=INK)
    figure.suptitle(f"{title}: {look.name}", x=0.01, ha="left", color=INK, weight="bold")
    return figure


def chosen_seats(look: Look, weights: Weights, policy: str, share: float) -> NDArray[np.intp]:
    """Seats of a policy, the ones that were judged."""
    if policy == "none":
        return np.empty(0, np.intp)
    one = placings(Trial((share,), (policy,)), look, weights)[0]
    return frame_seats(one.scores, share, look.seen.grid.valid_share().ravel() > 0).seats


def _image(look: Look, weights: Weights) -> NDArray[np.float32]:
    """The frame in natural or false colour, from the spectral columns."""
    basis = weights.basis
    bands, _ = choose_bands(np.linspace(basis.low_nm, basis.high_nm, basis.columns))
    return stretch(look.picture[..., list(bands)])


def _draw_panel(axes: Axes, name: str, picture: NDArray[np.floating], shape: tuple[int, int]) -> None:
    height, width = shape
    axes.imshow(np.clip(picture, 0, 1), extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="nearest")
    axes.set_title(name, loc="left", color=INK, size=11)
    axes.set_axis_off()

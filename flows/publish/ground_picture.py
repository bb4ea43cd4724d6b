"""The class map on the ground as a picture: north up, metres on the axes, hectares in the legend."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from flows.publish.finding_words import area_words
from pipeline.geometry.grid import UNLABELLED
from storage.arrays.ground_maps import GroundMap

WIDTH_IN, DPI, MOST_PX = 9.0, 130, 1200


def draw_ground(found: GroundMap) -> bytes:
    """Draw picture and class map side by side, PNG. Axes are metres from the map's lower left corner."""
    box = found.geobox.boundingbox
    extent = (0.0, box.right - box.left, 0.0, box.top - box.bottom)
    tall = extent[3] / extent[1]
    figure = Figure(figsize=(WIDTH_IN, WIDTH_IN / 2 * min(max(tall, 0.4), 1.6) + 1.1), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    thin = slice(None, None, -(-max(found.classes.shape) // MOST_PX))
    seen = found.picture[thin, thin].any(axis=-1, keepdims=True)
    left.imshow(np.where(seen, found.picture[thin, thin], 255), extent=extent)
    palette = np.vstack([found.legend.colours, np.full((256 - len(found.legend.colours), 3), 255, np.uint8)])
    right.imshow(palette[found.classes[thin, thin]], extent=extent, interpolation="nearest")
    for axes, title in ((left, "as seen, coarse"), (right, "classes")):
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("metres east", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.set_facecolor("white")
    left.set_ylabel("metres north", fontsize=9)
    present = set(np.unique(found.classes).tolist()) - {UNLABELLED}
    patches = [
        Patch(facecolor=found.legend.colours[number] / 255, edgecolor="0.4", linewidth=0.5, label=_label(found, name))
        for number, name in enumerate(found.legend.names)
        if number in present
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _label(found: GroundMap, name: str) -> str:
    return f"{name.replace('_', ' ')}  {area_words(found.areas.get(name, {}).get('ha', 0.0))}"

"""The picture of a plan: sweeps and zones over the field's last map or its outline, as the camera sees it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as DrawnPath
from shapely.geometry.base import BaseGeometry

from flows.publish.panels import STYLE, UNLABELLED_COLOUR, class_palette, class_rgb, save_png
from flows.tasks.run import SurveyRun
from pipeline.geometry.grid import UNLABELLED
from pipeline.planning.coverage import sweep_outline
from pipeline.planning.fine_pass import FinePlan
from storage.arrays.class_maps import ClassMap

MOST_PX = 1600
COARSE, FINE = "#0072B2", "#D55E00"
# of what is drawn, from the lowest up: outline, filling, hatching
STYLES: dict[str, dict[str, Any]] = {
    "sweeps": {"edgecolor": COARSE, "facecolor": f"{COARSE}12", "linewidth": 1.4},
    "fine runs": {"edgecolor": FINE, "facecolor": f"{FINE}48", "linewidth": 1.2},
    "plots": {"edgecolor": "#555555", "facecolor": "none", "linewidth": 1.0},
    "area of interest": {"edgecolor": "#111111", "facecolor": "none", "linewidth": 2.0},
    "no-go": {"edgecolor": "#cc2222", "facecolor": "none", "linewidth": 1.6, "hatch": "////"},
}


def draw_preview(
    path: Path, run: SurveyRun, fine: FinePlan | None, last: ClassMap | None, words: Sequence[str]
) -> None:
    """Draw a plan as a PNG, ``words`` below it; without a ``fine`` pass or a ``last`` map what is known (OSError)."""
    rows, columns = run.zones.place.shape
    tall = min(max(rows / columns, 0.35), 1.6) * 10
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10, tall + 2 + 0.24 * len(words)), dpi=110, layout="constrained")
        axes = figure.subplots()
        marks = _draw_map(axes, run.zones.place.shape, last)
        for name, shapes in _shapes(run, fine).items():
            for shape in shapes:
                axes.add_patch(PathPatch(_path(shape), **STYLES[name]))
            if shapes:
                marks.append(Patch(label=name, **STYLES[name]))
        for name, shape in (run.zones.plots or {}).items():
            if not shape.is_empty:
                inside = shape.representative_point()
                axes.text(inside.x, inside.y, name, size=9, ha="center", va="center", clip_on=True)
        margin = 0.03 * max(rows, columns)
        axes.set(xlim=(-margin, columns + margin), ylim=(rows + margin, -margin), aspect="equal")
        axes.set_ylabel("pixels from the top")
        axes.set_xlabel("\n".join(("pixels from the left", "", *words)), loc="left", size=10.5)
        over = "its outline: the archive has no map of it" if last is None else "its last map"
        axes.set_title(f"{run.name}: the plan over {over}", loc="left")
        figure.legend(handles=marks, loc="outside lower left", ncols=5, frameon=False, fontsize=10)
        save_png(figure, path)


def _draw_map(axes: Axes, shape: tuple[int, int], last: ClassMap | None) -> list[Patch]:
    """Draw the last map in pale colours, or the outline of a field without one; return the legend of its classes."""
    rows, columns = shape
    if last is None:
        outline = {"facecolor": "#e9ebe2", "edgecolor": "#8a8d84"}
        axes.add_patch(PathPatch(_path(shapely.box(0, 0, columns, rows)), **outline))
        return []
    palette, present = class_palette(last.colours), set(np.unique(last.classes).tolist())
    thin = slice(None, None, -(-max(rows, columns) // MOST_PX))
    pale = 0.45 + 0.55 * class_rgb(last.classes[thin, thin], palette)
    axes.imshow(pale, extent=(0, columns, rows, 0), interpolation="nearest")
    named = zip(range(len(palette)), last.names, (0.45 + 0.55 * palette).tolist(), strict=True)
    marks = [Patch(facecolor=tuple(one), label=name.replace("_", " ")) for n, name, one in named if n in present]
    return marks + ([Patch(facecolor=UNLABELLED_COLOUR, label="no class")] if UNLABELLED in present else [])


def _shapes(run: SurveyRun, fine: FinePlan | None) -> dict[str, list[BaseGeometry]]:
    """Return what is drawn over the field, by its name in the legend, in the field's pixels."""
    rows, columns = run.zones.place.shape
    field, passes = (
        shapely.box(0, 0, columns, rows),
        {"sweeps": run.plan.coarse, "fine runs": fine.sweeps if fine else ()},
    )
    middle = np.array([columns, rows]) / 2
    found: dict[str, list[BaseGeometry]] = {
        name: [
            shapely.intersection(shapely.make_valid(shapely.Polygon(sweep_outline(one, run.camera) + middle)), field)
            for one in sweeps
        ]
        for name, sweeps in passes.items()
    }
    plots = list((run.zones.plots or {}).values())
    return found | {"plots": plots, "area of interest": list(run.zones.area), "no-go": list(run.zones.no_go)}


def _path(shape: BaseGeometry) -> DrawnPath:
    """A polygon, or several, with their holes."""
    parts = [one for one in shapely.get_parts(shape) if one.geom_type == "Polygon"]
    rings = [ring for one in parts for ring in (one.exterior, *one.interiors)]
    paths = [DrawnPath(shapely.get_coordinates(ring), closed=True) for ring in rings]
    return DrawnPath.make_compound_path(*paths) if paths else DrawnPath(np.zeros((0, 2)))

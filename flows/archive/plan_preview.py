"""Draw the preview of a plan: sweeps and zones over the field's last map or its outline, as the camera sees it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from shapely.geometry.base import BaseGeometry
from shapely.plotting import plot_polygon

from flows.publish.panels import STYLE, class_palette, class_rgb, save_png
from flows.tasks.run import SurveyRun
from pipeline.planning.coverage import sweep_outline
from pipeline.planning.fine_pass import FinePlan
from storage.arrays.class_maps import ClassMap

MOST_PX = 1600
COARSE, FINE = "#0072B2", "#D55E00"
OUTLINE = {"facecolor": "#e9ebe2", "edgecolor": "#8a8d84"}
STYLES: dict[str, dict[str, Any]] = {  # from the lowest layer to the highest
    "sweeps": {"edgecolor": COARSE, "facecolor": f"{COARSE}12", "linewidth": 1.4},
    "fine runs": {"edgecolor": FINE, "facecolor": f"{FINE}48", "linewidth": 1.2},
    "plots": {"edgecolor": "#555555", "facecolor": "none", "linewidth": 1.0},
    "area of interest": {"edgecolor": "#111111", "facecolor": "none", "linewidth": 2.0},
    "no-go": {"edgecolor": "#cc2222", "facecolor": "none", "linewidth": 1.6, "hatch": "////"},
}


def draw_preview(
    path: Path, run: SurveyRun, fine: FinePlan | None, last: ClassMap | None, lines: Sequence[str]
) -> None:
    """Draw a plan as a PNG with ``lines`` of text below it; ``fine`` and ``last`` are None where there are none."""
    rows, columns = run.zones.place.shape
    tall = min(max(rows / columns, 0.35), 1.6) * 10
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10, tall + 2 + 0.24 * len(lines)), dpi=110, layout="constrained")
        axes, marks = figure.subplots(), []
        if last is None:
            plot_polygon(shapely.box(0, 0, columns, rows), axes, add_points=False, **OUTLINE)
        else:
            thin = slice(None, None, -(-max(rows, columns) // MOST_PX))
            colours = class_rgb(last.classes[thin, thin], class_palette(last.colours))
            axes.imshow(0.45 + 0.55 * colours, extent=(0, columns, rows, 0), interpolation="nearest")
        for name, shapes in _shapes(run, fine).items():
            drawn = [part for one in shapes for part in shapely.get_parts(one) if part.geom_type == "Polygon"]
            for part in drawn:
                plot_polygon(part, axes, add_points=False, **STYLES[name])
            marks += [Patch(label=name, **STYLES[name])] if drawn else []
        for name, shape in (run.zones.plots or {}).items():
            if not shape.is_empty:
                inside = shape.representative_point()
                axes.text(inside.x, inside.y, name, size=9, ha="center", va="center", clip_on=True)
        margin = 0.03 * max(rows, columns)
        axes.set(xlim=(-margin, columns + margin), ylim=(rows + margin, -margin), aspect="equal")
        axes.set_ylabel("pixels from the top")
        axes.set_xlabel("\n".join(("pixels from the left", "", *lines)), loc="left", size=10.5)
        over = "its outline: the archive has no map of it" if last is None else "its last map"
        axes.set_title(f"{run.name}: the plan over {over}", loc="left")
        figure.legend(handles=marks, loc="outside lower left", ncols=5, frameon=False, fontsize=10)
        save_png(figure, path)


def _shapes(run: SurveyRun, fine: FinePlan | None) -> dict[str, list[BaseGeometry]]:
    """Return the shapes over the field in its pixels, by their name in the legend."""
    rows, columns = run.zones.place.shape
    middle, field = np.array([columns, rows]) / 2, shapely.box(0, 0, columns, rows)
    passes = {"sweeps": run.plan.coarse, "fine runs": fine.sweeps if fine else ()}
    found: dict[str, list[BaseGeometry]] = {
        name: [shapely.make_valid(shapely.Polygon(sweep_outline(one, run.camera) + middle)) & field for one in sweeps]
        for name, sweeps in passes.items()
    }
    plots = list((run.zones.plots or {}).values())
    return found | {"plots": plots, "area of interest": list(run.zones.area), "no-go": list(run.zones.no_go)}

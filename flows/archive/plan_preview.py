"""The picture of a plan: sweeps over the field's last map or its outline, as the camera sees it and on the ground."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as DrawnPath
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from flows.publish.panels import MUTED, STYLE, UNLABELLED_COLOUR, class_palette, class_rgb, save_png
from flows.tasks.run import SurveyRun
from pipeline.geometry.grid import UNLABELLED
from pipeline.geometry.scan import Sweep
from pipeline.ground.field_places import PosedField
from pipeline.planning.coverage import sweep_outline
from pipeline.planning.fine_pass import FinePlan
from storage.arrays.class_maps import ClassMap

MOST_AWAY = 2.0  # sizes of the field that the rig may be away to be drawn beside it
DPI, WIDE_IN, MOST_CELLS, MOST_PX = 110, 14.0, 220, 1600
COARSE, FINE, AREA, NO_GO, PLOT = "#0072B2", "#D55E00", "#111111", "#cc2222", "#555555"
FIELD: Any = {"facecolor": "#e9ebe2", "edgecolor": "#8a8d84", "linewidth": 1.0}


@dataclass(frozen=True)
class PlanPicture:
    """What the preview shows."""

    run: SurveyRun
    fine: FinePlan | None  # None where it is not planned yet
    last: ClassMap | None  # the field's last map; None where it was never surveyed
    words: Sequence[str]  # below the panels


def draw_preview(path: Path, shown: PlanPicture) -> None:
    """Draw the plan as a PNG: one panel in pixels, and where the rig's place is known one in metres. OSError."""
    place = shown.run.zones.place
    posed = place if isinstance(place, PosedField) else None
    rows, columns = place.shape
    panels = 2 if posed else 1
    tall = min(max(rows / columns, 0.35), 1.6) * WIDE_IN / 2
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDE_IN if posed else 0.72 * WIDE_IN, tall + 2.1 + 0.24 * len(shown.words)), dpi=DPI)
        figure.subplots_adjust(
            0.06,
            (1.25 + 0.24 * len(shown.words)) / figure.get_figheight(),
            0.98,
            1 - 0.75 / figure.get_figheight(),
            0.16,
        )
        axes = figure.subplots(1, panels, squeeze=False)[0]
        _draw_scene(axes[0], shown)
        if posed:
            _draw_ground(axes[1], shown, posed)
        _write_words(figure, shown)
        save_png(figure, path)


def _draw_scene(axes: Axes, shown: PlanPicture) -> None:
    """As the camera sees it, in pixels."""
    rows, columns = shown.run.zones.place.shape
    if shown.last is None:
        axes.add_patch(PathPatch(_path(shapely.box(0, 0, columns, rows)), **FIELD))
    else:
        thin = slice(None, None, -(-max(rows, columns) // MOST_PX))
        axes.imshow(_picture(shown.last)[thin, thin], extent=(0, columns, rows, 0), interpolation="nearest")
    _draw_plan(axes, shown, lambda shape: shape)
    margin = 0.03 * max(rows, columns)
    axes.set(xlim=(-margin, columns + margin), ylim=(rows + margin, -margin), aspect="equal")
    axes.set(xlabel="pixels from the left", ylabel="pixels from the top")
    axes.set_title(f"As the camera sees it, over {_over(shown)}", size=12, loc="left")


def _draw_ground(axes: Axes, shown: PlanPicture, place: PosedField) -> None:
    """On the ground, in metres east and north of the rig."""
    rows, columns = place.shape
    axes.add_patch(PathPatch(_path(place.on_ground(shapely.box(0, 0, columns, rows))), **FIELD))
    if shown.last is not None:
        cut = [np.unique(np.linspace(0, size, min(size, MOST_CELLS) + 1).round().astype(int)) for size in place.shape]
        x, y = np.meshgrid(cut[1].astype(float), cut[0].astype(float))
        points = place.ground_points(np.stack([x, y], axis=-1))
        colours = _picture(shown.last)[cut[0][:-1][:, None], cut[1][:-1]]
        seen = np.isfinite(points[..., 0])
        whole = seen[1:, 1:] & seen[:-1, 1:] & seen[1:, :-1] & seen[:-1, :-1]
        known = np.nan_to_num(points)
        cells = np.concatenate([colours, whole[..., None]], axis=-1)
        axes.pcolormesh(known[..., 0], known[..., 1], cells, shading="flat", edgecolors="none")
    _draw_plan(axes, shown, place.on_ground)
    corners = shapely.get_coordinates(place.on_ground(shapely.box(0, 0, columns, rows)))
    low, high = corners.min(axis=0), corners.max(axis=0)
    if float(np.hypot(*(low + high)) / 2) < MOST_AWAY * float((high - low).max()):
        axes.plot(0, 0, marker="^", color="black", markersize=9, zorder=6)
        axes.annotate("rig", (0, 0), (7, 3), textcoords="offset points", size=10)
        low, high = np.minimum(low, 0), np.maximum(high, 0)
    else:
        _point_to_rig(axes, low, high)
    margin = 0.06 * float((high - low).max())
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    axes.set(xlabel="metres east of the rig", ylabel="metres north")
    axes.set_title("On the ground, north up", size=12, loc="left")


def _point_to_rig(axes: Axes, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
    """An arrow at the field's border to a rig that stands far beyond it."""
    (x, y), size = ((low + high) / 2).tolist(), float((high - low).max())
    away = float(np.hypot(x, y))
    begin, end = ((x * (1 - fraction * size / away), y * (1 - fraction * size / away)) for fraction in (0.25, 0.42))
    axes.annotate("", end, begin, arrowprops={"arrowstyle": "-|>", "color": "black"}, zorder=6)
    axes.annotate(f"rig, {away:.3g} m", end, (6, 0), textcoords="offset points", size=10, zorder=6)


def _draw_plan(axes: Axes, shown: PlanPicture, onto: Any) -> None:
    """Sweeps and zones, brought from pixels onto the white reference."""
    run, camera = shown.run, shown.run.camera
    rows, columns = run.zones.place.shape
    field = shapely.box(0, 0, columns, rows)

    def outlines(sweeps: Iterable[Sweep]) -> list[BaseGeometry]:
        polygons = (shapely.Polygon(sweep_outline(sweep, camera) + np.array([columns, rows]) / 2) for sweep in sweeps)
        return [onto(shapely.intersection(shapely.make_valid(one), field)) for one in polygons]

    for shape in outlines(run.plan.coarse):
        axes.add_patch(PathPatch(_path(shape), facecolor=COARSE, edgecolor="none", alpha=0.07, zorder=2))
        axes.add_patch(PathPatch(_path(shape), facecolor="none", edgecolor=COARSE, linewidth=1.4, zorder=3))
    for shape in outlines([] if shown.fine is None else shown.fine.sweeps):
        axes.add_patch(PathPatch(_path(shape), facecolor=FINE, edgecolor="none", alpha=0.28, zorder=3))
        axes.add_patch(PathPatch(_path(shape), facecolor="none", edgecolor=FINE, linewidth=1.2, zorder=4))
    for shape in map(onto, run.zones.area):
        axes.add_patch(PathPatch(_path(shape), facecolor="none", edgecolor=AREA, linewidth=2.0, zorder=5))
    for shape in map(onto, run.zones.no_go):
        style: Any = {"facecolor": "none", "edgecolor": NO_GO, "linewidth": 1.6, "hatch": "////", "zorder": 5}
        axes.add_patch(PathPatch(_path(shape), **style))
    for name, shape in ((name, onto(shape)) for name, shape in (run.zones.plots or {}).items()):
        if not shape.is_empty:
            axes.add_patch(PathPatch(_path(shape), facecolor="none", edgecolor=PLOT, linewidth=1.0, zorder=4))
            inside = shape.representative_point()
            axes.text(inside.x, inside.y, name, size=9, ha="center", va="center", zorder=6, clip_on=True)


def _path(shape: BaseGeometry) -> DrawnPath:
    """A polygon, or several, with their holes."""
    rings = [
        ring
        for one in shapely.get_parts(shape)
        if one.geom_type == "Polygon"
        for ring in (one.exterior, *one.interiors)
    ]
    paths = [DrawnPath(shapely.get_coordinates(ring), closed=True) for ring in rings]
    return DrawnPath.make_compound_path(*paths) if paths else DrawnPath(np.zeros((0, 2)))


def _picture(last: ClassMap) -> NDArray[np.float32]:
    """The last map in pale colours, so that what lies on it is seen."""
    return 0.45 + 0.55 * class_rgb(last.classes, class_palette(len(last.names), last.colours))


def _over(shown: PlanPicture) -> str:
    return "its outline: the archive has no map of it" if shown.last is None else "its last map"


def _write_words(figure: Figure, shown: PlanPicture) -> None:
    run, high = shown.run, figure.get_figheight()
    figure.text(0.06, 1 - 0.3 / high, f"{run.name}: the plan", size=17, weight="bold", va="center")
    scans = "the scan" if run.plan.plain else "coarse sweeps"
    marks: list[Any] = [Line2D([], [], color=COARSE, label=scans)] if run.plan.coarse else []
    if shown.fine is not None and shown.fine.sweeps:
        marks.append(Patch(facecolor=FINE, alpha=0.5, label="fine runs"))
    if run.zones.area:
        marks.append(Line2D([], [], color=AREA, linewidth=2, label="area of interest"))
    if run.zones.no_go:
        marks.append(Patch(facecolor="none", edgecolor=NO_GO, hatch="////", label="no-go"))
    if run.zones.plots:
        marks.append(Line2D([], [], color=PLOT, linewidth=1, label="plots"))
    if shown.last is not None:
        colours = 0.45 + 0.55 * class_palette(len(shown.last.names), shown.last.colours)
        present = np.unique(shown.last.classes)
        names = zip(range(len(colours)), shown.last.names, strict=True)
        marks += [
            Patch(facecolor=tuple(colours[number]), label=name.replace("_", " "))
            for number, name in names
            if number in present
        ]
        if UNLABELLED in present:
            marks.append(Patch(facecolor=UNLABELLED_COLOUR, label="no class"))
    bottom = (0.25 + 0.24 * len(shown.words)) / high
    figure.legend(handles=marks, loc="lower left", bbox_to_anchor=(0.055, bottom), ncols=7, frameon=False, fontsize=10)
    for number, line in enumerate(shown.words):
        figure.text(
            0.06, (0.14 + 0.24 * (len(shown.words) - number - 0.5)) / high, line, size=10.5, color=MUTED, va="center"
        )

"""An evaluation as plots (mIoU over costs and over capture seconds), and a frame of it as a picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from flows.evaluate.frames import Look
from flows.evaluate.rows import Trial, placings
from flows.publish.panels import GRID, INK, MUTED, PAPER, class_palette, class_rgb, outline
from flows.terminal.figures import format_percent
from models.evaluation.metrics import confusion, mean_iou, overall_accuracy
from models.reading.inference import segment
from models.weights.files import Weights
from pipeline.geometry.grid import UNLABELLED
from pipeline.planning.selection import frame_seats
from storage.arrays.quicklooks import choose_bands, stretch

_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#882255", "#332288", "#999933")


def evaluation_figure(content: dict[str, Any]) -> Figure:
    """mIoU over CPU seconds and over bytes, one line a policy; where no frame was timed the seconds are left out."""
    timed = any(row["cost"]["cpu_s"]["done"] is not None for row in content["rows"])
    wanted = [("cpu_s", "CPU seconds a frame, one thread", 1.0)] if timed else []
    wanted.append(("bytes", "MB a frame, estimated from samples", 1e6))
    figure = Figure(figsize=(7.0 * len(wanted), 5.4), dpi=110, layout="constrained", facecolor=PAPER)
    for number, (panel, (what, label, unit)) in enumerate(
        zip(figure.subplots(1, len(wanted), squeeze=False).ravel(), wanted, strict=True)
    ):
        _draw_costs(panel, content, what, unit)
        panel.set_xlabel(label, color=INK)
        panel.set_ylabel("mIoU [%]", color=INK)
        if not number:
            panel.set_title(_title(content), loc="left", color=INK, weight="bold")
    figure.legend(
        *panel.get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False, labelcolor=INK
    )
    return figure


def _draw_costs(axes: Axes, content: dict[str, Any], what: str, unit: float) -> None:
    rows = [row for row in content["rows"] if row["miou"] is not None]
    # the axis ends with the weights' own rows, and with controls that are no further below than these span
    own = [100 * row["miou"] for row in rows if not row["control"]]
    span = max(max(own) - min(own), 1.0)
    shown = [100 * row["miou"] for row in rows if 100 * row["miou"] >= min(own) - span]
    low, high = min(shown) - 0.25 * span, max(shown) + 0.15 * span
    far = [row for row in rows if 100 * row["miou"] < low]
    rows = [row for row in rows if 100 * row["miou"] >= low]
    single = {row["policy"]: row for row in rows if row["share"] in (0.0, 1.0)}
    base = single[content["baseline"]["policy"]]
    lines = {"none": ("none", (0, (2, 2))), base["policy"]: (f"baseline: {base['policy']}", "-")}
    for name, row in single.items():
        if name in lines:
            label, style = lines[name]
            axes.axhline(100 * row["miou"], color=MUTED, linewidth=1.1, linestyle=style, label=label, zorder=1)
        x = row["cost"][what]["done"]
        if x is not None:  # a square for a row without a curve, and its name where no line across has it
            place = (x / unit, 100 * row["miou"])
            axes.plot(*place, "s", color=MUTED, zorder=2)
            if name not in lines:
                _write_at(axes, name, place, 7)
    policies = list(dict.fromkeys(row["policy"] for row in rows if row["policy"] not in single))
    for number, policy in enumerate(policies):
        own = sorted((row for row in rows if row["policy"] == policy), key=lambda row: row["share"])
        known = [row for row in own if row["cost"][what]["done"] is not None]
        if known:
            _draw_line(axes, known, what, unit, _COLOURS[number % len(_COLOURS)], base["miou"])
    _name_shares(axes, [row for row in rows if row["policy"] not in single], what, unit)
    axes.set_xscale("log")
    axes.set_ylim(low, high)
    _point_down(axes, far, what, unit)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    _ruled(axes)


def _ruled(axes: Axes) -> None:
    axes.set_facecolor(PAPER)
    axes.grid(visible=True, which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _point_down(axes: Axes, far: list[dict[str, Any]], what: str, unit: float) -> None:
    """Arrows at the lower edge for controls below it, the best row of each, with name and mIoU [%]."""
    best = {row["policy"]: row for row in sorted(far, key=lambda row: float(row["miou"]))}
    known = [row for row in best.values() if row["cost"][what]["done"] is not None]
    edge = axes.get_xaxis_transform()
    for row in known:
        axes.plot(row["cost"][what]["done"] / unit, 0.025, "v", color=MUTED, transform=edge, zorder=2)
    left, right = axes.get_xlim()
    for number, row in enumerate(known):
        x = row["cost"][what]["done"] / unit
        side, away = ("left", 7) if x**2 < left * right else ("right", -7)  # towards the middle of the axis
        axes.annotate(
            f"{row['policy']} {100 * row['miou']:.1f}",
            (x, 0.025),
            (away, 13 * number - 3),
            xycoords=edge,
            textcoords="offset points",
            color=INK,
            size=9,
            ha=side,
            arrowprops={"arrowstyle": "-", "color": MUTED, "linewidth": 0.6, "shrinkB": 4},
        )


def _title(content: dict[str, Any], mode: str = "") -> str:
    frames = len(content["frames"])
    return f"{content['dataset']}{mode}: {frames} frame{'' if frames == 1 else 's'}"


def _draw_line(axes: Axes, own: list[dict[str, Any]], what: str, unit: float, colour: str, base: float) -> None:
    x = [row["cost"][what]["done"] / unit for row in own]
    oracle, control = own[0]["uses_labels"], own[0]["control"]
    named = f"{own[0]['policy']} (uses labels)" if oracle else own[0]["policy"]
    axes.plot(
        x,
        [100 * row["miou"] for row in own],
        marker="x" if control else "o",
        markersize=5,
        linewidth=1.5,
        zorder=3,
        linestyle="--" if oracle else ":" if control else "-",
        color=INK if oracle else colour,
        label=named,
    )
    bounds = [row["against_baseline"] for row in own]
    if oracle or any(one is None or one["low"] is None for one in bounds):
        return
    low, high = ([100 * (base + one[end]) for one in bounds] for end in ("low", "high"))
    axes.fill_between(x, low, high, color=colour, alpha=0.12, linewidth=0, zorder=0)


def _name_shares(axes: Axes, rows: list[dict[str, Any]], what: str, unit: float) -> None:
    for share in sorted({row["share"] for row in rows}):
        lowest = min(
            (row for row in rows if row["share"] == share and row["cost"][what]["done"] is not None),
            key=lambda row: row["miou"],
        )
        _write_at(axes, format_percent(share), (lowest["cost"][what]["done"] / unit, 100 * lowest["miou"]), -14)


def _write_at(axes: Axes, name: str, place: tuple[float, float], points: int) -> None:
    axes.annotate(name, place, (0, points), textcoords="offset points", color=INK, size=9, ha="center")


_STYLES = {
    "gain": ("#0072B2", "-", "o"),
    "entropy": ("#E69F00", "-", "o"),
    "uniform lines": (INK, "--", "s"),
    "random lines": ("#CC79A7", "--", "^"),
}


def rig_figure(content: dict[str, Any]) -> Figure:
    """mIoU over capture seconds, one line a plan; its band is the interval of its difference to uniform lines."""
    rows = [row for row in content["rig"]["rows"] if row["miou"] is not None]
    figure = Figure(figsize=(7.4, 5.2), dpi=110, layout="constrained", facecolor=PAPER)
    axes = figure.subplots()
    ends = {row["policy"]: row for row in content["rows"] if row["policy"] in ("none", "all")}
    for name, style in (("none", (0, (2, 2))), ("all", "-")):
        label = f"{name}: {'coarse pass alone' if name == 'none' else 'every seat'}"
        axes.axhline(100 * ends[name]["miou"], color=MUTED, linewidth=1.1, linestyle=style, label=label, zorder=1)
    even = {row["budget"]: row["miou"] for row in rows if row["policy"] == "uniform lines"}
    for plan in dict.fromkeys(row["policy"] for row in rows):
        own = sorted((row for row in rows if row["policy"] == plan), key=lambda row: row["budget"])
        colour, line, marker = _STYLES[plan]
        seconds = [row["seconds"] for row in own]
        drawn: dict[str, Any] = {
            "color": colour,
            "linestyle": line,
            "marker": marker,
            "markersize": 5,
            "linewidth": 1.6,
        }
        axes.plot(seconds, [100 * row["miou"] for row in own], label=plan, zorder=3, **drawn)
        bounds = [row["against_uniform"] for row in own]
        if all(one is not None and one["low"] is not None for one in bounds):
            low, high = (
                [100 * (even[row["budget"]] + one[end]) for row, one in zip(own, bounds, strict=True)]
                for end in ("low", "high")
            )
            axes.fill_between(seconds, low, high, color=colour, alpha=0.12, linewidth=0, zorder=0)
    axes.set_xlabel("capture seconds a frame, coarse pass included", color=INK)
    axes.set_ylabel("mIoU [%]", color=INK)
    axes.set_title(_title(content, ", rig mode"), loc="left", color=INK, weight="bold")
    _ruled(axes)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, labelcolor=INK)
    return figure


LONG_SIDE = 900  # of a panel [px]; larger frames are thinned


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
    basis = weights.basis
    bands, _ = choose_bands(np.linspace(basis.low_nm, basis.high_nm, basis.columns))
    image = stretch(look.picture[..., list(bands)])  # in natural or false colour, from the spectral columns
    faded = 0.25 + 0.6 * image.mean(axis=-1, keepdims=True)
    error = np.concatenate([np.maximum(faded, wrong), faded * (1 - wrong), faded * (1 - wrong)], axis=-1)
    pictures = {
        "image": image,
        "labels": class_rgb(look.labels, palette),
        f"map: {policy}, K = {format_percent(share)}, {scores}": class_rgb(drawn, palette),
        f"{len(seats)} of {len(look.seen.grid.valid_seats())} seats; red: not the label": error,
    }
    for axes, (name, picture) in zip(panels, pictures.items(), strict=True):
        shown = np.clip(picture[::step, ::step], 0, 1)
        axes.imshow(shown, extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="nearest")
        axes.set_title(name, loc="left", color=INK, size=11)
        axes.set_axis_off()
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

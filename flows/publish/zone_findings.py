"""What a run says of its zones and plots: findings of the receipt, a table a plot, and the same as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flows.terminal.figures import area_words, format_count, format_percent
from pipeline.ground.field_scale import M2_PER_HECTARE
from pipeline.ground.plot_figures import figures_of_plots
from storage.arrays.class_maps import ClassMap

if TYPE_CHECKING:
    from flows.survey.run import SurveyRun

PLOTS_FILE = "plots.csv"
LEADING = 3  # classes of a plot that are told in words


def find_zones(run: SurveyRun, drawn: ClassMap) -> dict[str, Any]:
    """``zones``: how much of the field is kept to; ``plots``: a row each. Empty for a survey without either."""
    zones, found = run.zones, dict[str, Any]()
    if zones.kept is not None:
        kept = zones.kept.kept
        found["zones"] = {
            "kept_px": int(np.count_nonzero(kept)),
            "field_px": kept.size,
            "no_go_px": 0 if zones.kept.no_go is None else int(np.count_nonzero(zones.kept.no_go)),
            "kept_m2": _ground_m2(run, kept),
        }
    if zones.plots is not None:
        rows = figures_of_plots(zones.plots, zones.place, drawn.classes, drawn.confidence, drawn.names)
        found["plots"] = [asdict(row) for row in rows]
    return found


def _ground_m2(run: SurveyRun, kept: NDArray[np.bool_]) -> float | None:
    rows, columns = (slice(0, size) for size in kept.shape)
    areas = run.zones.place.pixel_areas_m2(rows, columns)
    return None if areas is None else float(np.nansum(areas[kept]))


def zone_words(zones: Mapping[str, Any]) -> str:
    """How much of the field a survey kept to."""
    ground = "" if zones["kept_m2"] is None else f", {area_words(zones['kept_m2'] / M2_PER_HECTARE)}"
    share = format_percent(zones["kept_px"] / zones["field_px"])
    no_go = f"; no-go zones touch {format_count(zones['no_go_px'])} px" if zones["no_go_px"] else ""
    return (
        f"The survey keeps to {format_count(zones['kept_px'])} px, {share} of the field{ground}{no_go}. Of the rest "
        "no detail was asked for and no map is drawn."
    )


def plot_rows(plots: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """The table of plots in words: name, ground, leading classes, confidence."""
    return [
        {
            "plot": plot["plot"],
            "area": f"{format_count(plot['pixels'])} px"
            if plot["area_m2"] is None
            else area_words(plot["area_m2"] / M2_PER_HECTARE),
            "classes": _leading(plot["shares"]) if plot["mapped_pixels"] else "not mapped",
            "confidence": format_percent(plot["confidence"]),
        }
        for plot in plots
    ]


def _leading(shares: Mapping[str, float | None]) -> str:
    """The classes that cover most of a plot."""
    known = [(share, name) for name, share in shares.items() if share]
    most = sorted(known, key=lambda one: -one[0])[:LEADING]
    return ", ".join(f"{name.replace('_', ' ')} {format_percent(share)}" for share, name in most)


def plots_csv(plots: Sequence[Mapping[str, Any]]) -> str:
    """Every figure of every plot, a row each; empty where nothing is known."""
    names = list(plots[0]["shares"]) if plots else []
    head = ["plot", "pixels", "mapped_pixels", "area_m2", "confidence"]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([*head, *(f"share_{name}" for name in names)])
    for plot in plots:
        cells = [*(plot[name] for name in head), *(plot["shares"][name] for name in names)]
        table.writerow(["" if cell is None else cell for cell in cells])
    return text.getvalue()

"""The verb `plan`: a dry run of a survey, and estimates of what it takes. Nothing is built or written."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.archive.estimates import LABELS, estimate_survey, format_estimate, scan_table
from spectralzoom.flows.field import Field
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.opening.recorded_field import usual_of_recording
from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.planning.capture_plan import as_figures
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.publish.findings import field_figures, map_warnings, no_expected_score
from spectralzoom.flows.publish.receipt_table import finding_rows
from spectralzoom.flows.settings.flags import NO_FLAGS, AsJson, HelpAll, SurveyFlags, by_setting, print_every_flag
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.settings.values import ALWAYS
from spectralzoom.flows.stage import Stores
from spectralzoom.flows.stages.score import load_plan, score
from spectralzoom.flows.stages.segment import segment
from spectralzoom.flows.survey import run_stages
from spectralzoom.flows.terminal.figures import format_count
from spectralzoom.flows.terminal.processes import DONE
from spectralzoom.flows.terminal.progress import put_out, show_warnings, table
from spectralzoom.pipeline.errors import PipelineError, SurveyStopped
from spectralzoom.pipeline.geometry.scan import exposing
from spectralzoom.pipeline.planning.fine_pass import FinePlan
from spectralzoom.pipeline.planning.uniform_scans import frontier
from spectralzoom.storage.store import Archive, is_archive

MOST_LETTERS = 250  # of a reason
COLOURS = {"cached": "green", "to run": "bold", "blocked": "yellow", "left out": "dim"}


def plan(
    settings: Path | None = None, *, flags: SurveyFlags = NO_FLAGS, as_json: AsJson = False, help_all: HelpAll = False
) -> int:
    """Print what a survey would run: the stages that are stored, those to be made, and estimates.

    Estimates are seconds of the camera, bytes, multiply-adds and score, each with its source. Nothing is written. Give
    the settings that you would give to `survey`.

    Parameters
    ----------
    settings
        A survey's TOML file; flags win over it.
    """
    if help_all:
        return print_every_flag()
    put_out(
        plan_content(load_settings(settings, by_setting(flags), usual=usual_of_recording)), show_plan, as_json=as_json
    )
    return DONE


def dry_run(settings: Settings) -> tuple[SurveyPlan, Stores]:
    """Return the plan of a survey, and stores whose ``rows`` say what each of its stages would do.

    Raises PipelineError: the survey would be refused for another reason than its size.
    """
    found = plan_survey(open_field(settings, planning=True))
    archive = Archive(Path(settings.out).absolute())  # where there is none yet
    if is_archive(settings.out):
        archive = Archive.open(settings.out, create=False, write=False)
    stores = Stores(archive, dry=True)
    with suppress(SurveyStopped):
        run_stages(stores, found)
    return found, stores


def plan_content(settings: Settings) -> dict[str, Any]:
    """Return what a survey would do, stage by stage, as plain tables. Raises as `dry_run`."""
    plan, stores = dry_run(settings)
    passes, field = plan.passes, plan.field
    fine: FinePlan | None = None
    if score.name in stores.rows and stores.has(attention := stores.rows[score.name].ref):
        with suppress(PipelineError, OSError):  # the row of the stage that reads it has the error
            fine = load_plan(attention)
    zoomed = None if passes.plain else plan
    if passes.plain and plan.scans.two_passes is not None:  # which the planner considered
        zoomed = plan_survey(open_field(settings.but(zoom=ALWAYS), planning=True))
    uniform = plan.reading.of_whole_scan()
    work = uniform.work_done(uniform.likely()[0]).total  # of each uniform scan
    best = None if passes.plain else plan.scans.best_in_time(passes.coarse_s + passes.fine_s)
    drawn = stores.rows[segment.name].ref if segment.name in stores.rows else None
    warnings = map_warnings(plan, drawn if drawn is not None and stores.has(drawn) else None)
    unscored = no_expected_score(warnings, _mapped_px(field))
    figures = partial(as_figures, scored=not unscored, multiply_adds=work)
    rows = [
        {"stage": row.name, "state": row.state, "key": row.ref.key or None, "why": row.why}
        for row in stores.rows.values()
    ]
    content = {
        "warnings": warnings,
        "archive": settings.out,
        "stages": rows,
        "to_make": sum(row["state"] not in ("cached", "left out") for row in rows),
        "refused": field.refused,  # why this machine would refuse the survey
        "notes": list(plan.notes),
        "scans": {
            "taken": figures(plan.scans.chosen),
            "reference": figures(plan.scans.reference),
            "best_in_time": figures(best),
            "at_most": plan.reading.budget is not None,  # the scores are of maps with everything read
            "candidates": [figures(one) for one in frontier(plan.scans.offered)],
            "two_passes": None if zoomed is None else _two_passes(zoomed, fine, plan, unscored),
        },
        "field": field_figures(plan, fine),
        "estimate": estimate_survey(plan, fine, unscored),
    }
    if passes.plain and plan.reading.chooses:  # expected, of a uniform scan that is segmented in part
        content["kept"] = plan.reading.figures(plan.reading.likely()[0])
    return content


def _mapped_px(field: Field) -> int:
    """Return the pixels that can have a class: those with data within the zones."""
    without = [one for one in (field.scene.missing, field.zones.left_out) if one is not None]
    return int(np.count_nonzero(~np.logical_or.reduce([np.zeros(field.scene.shape, np.bool_), *without])))


def _two_passes(zoomed: SurveyPlan, fine: FinePlan | None, taken: SurveyPlan, unscored: str) -> dict[str, Any]:
    """Return the first pass and the estimates of two passes, and whether the survey takes them with ``fine``."""
    fine = fine if zoomed is taken else None
    first = zoomed.passes.coarse[0]
    exposure_ms = exposing(zoomed.field.camera, first).exposure_ms
    return {"taken": zoomed is taken, "step": first.step, "exposure_ms": exposure_ms} | estimate_survey(
        zoomed, fine, unscored
    )


def show_plan(content: dict[str, Any], console: Console) -> None:
    """Print the warnings and the forecast as a table."""
    show_warnings(content["warnings"], console)
    rows = [
        [row["stage"], f"[{COLOURS[row['state']]}]{row['state']}[/]", escape(shorten(row["why"], MOST_LETTERS))]
        for row in content["stages"]
    ]
    console.print(table(("stage", "state", "why"), rows, left=3, whole=("stage", "state")))
    size = f"{' x '.join(map(format_count, content['field']['size_px']))} px"
    parts = [size, *(text for _, text in finding_rows({"field": content["field"]}))]
    if content["field"]["ground_pixel_m"] is None:
        parts.append("no metres are known: a [pose], or a georeferenced scene, gives them and hectares an hour")
    if content["field"]["camera_s"] is None:
        parts.append("no camera: the pixels of the raster are taken as they are")
    console.print(escape(f"field: {'; '.join(parts)}"), soft_wrap=True)
    if content["to_make"]:
        console.print(f"{content['to_make']} stages to make")
        made = content["estimate"].items()
        rows = [[LABELS[name][0], format_estimate(name, one), one["known_from"]] for name, one in made]
        title = "Estimates: nothing of this has run"
        console.print(table(("", "about", "from"), rows, left=3, title=title, whole=("", "about")))
    else:
        console.print("everything is stored: it would be published")
    if content["scans"]["candidates"]:
        console.print(scan_table(content["scans"]))
    for note in content["notes"]:
        console.print(f"note: {escape(note)}", soft_wrap=True)
    if content["refused"] is not None:
        console.print(f"[yellow]refused here[/]: {escape(content['refused'])}", soft_wrap=True)

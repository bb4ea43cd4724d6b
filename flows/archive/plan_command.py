"""The verb `plan`: each stage of a survey is asked for the key of its store; nothing is built or written."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from textwrap import shorten
from typing import Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from spectralzoom.flows.publish.findings import field_figures
from spectralzoom.flows.publish.receipt_table import finding_rows
from spectralzoom.flows.settings.flags import NO_FLAGS, AsJson, SurveyFlags, by_setting
from spectralzoom.flows.settings.load import load_settings
from spectralzoom.flows.settings.survey_settings import ALWAYS, Settings
from spectralzoom.flows.settings.values import EXTENT_WHOLE
from spectralzoom.flows.tasks.capture_plan import as_figures
from spectralzoom.flows.tasks.open_survey import STAGES, OpenSurvey
from spectralzoom.flows.tasks.run import SurveyRun, open_run
from spectralzoom.flows.tasks.scores import MOST_ERROR, format_prediction
from spectralzoom.flows.tasks.stages.accuracy import evaluate
from spectralzoom.flows.tasks.stages.attention import load_plan
from spectralzoom.flows.terminal.figures import DASH, counted, format_bytes, format_count, format_seconds, known_number
from spectralzoom.flows.terminal.processes import DONE
from spectralzoom.flows.terminal.progress import put_out, table
from spectralzoom.pipeline.errors import IncompleteStoreError, PipelineError
from spectralzoom.pipeline.geometry.scan import exposing
from spectralzoom.pipeline.planning.coverage import BYTES_PER_SAMPLE, raw_bytes
from spectralzoom.pipeline.planning.fine_pass import FinePlan
from spectralzoom.pipeline.planning.uniform_scans import format_scan, frontier
from spectralzoom.storage.store import Archive, Ref, is_archive


def plan(settings: Path | None = None, *, flags: SurveyFlags = NO_FLAGS, as_json: AsJson = False) -> int:
    """Print what a survey would run: the stages that are stored, those to be made, and estimates.

    Estimates are seconds of the camera, bytes, multiply-adds and score, each with its source. Nothing is written. Give
    the settings that you would give to `survey`.

    Parameters
    ----------
    settings
        A survey's TOML file; flags win over it.
    """
    put_out(plan_content(load_settings(settings, by_setting(flags))), show_plan, as_json=as_json)
    return DONE


@dataclass(frozen=True)
class StageForecast:
    """Forecast of one stage."""

    stage: str
    state: Literal["cached", "to run", "blocked"]
    key: str | None  # None while an input of it is not known
    why: str = ""  # a stage is blocked


class _WaitsError(IncompleteStoreError):
    """A stage needs the content or the key of a store that is still to be made."""


@dataclass(frozen=True)
class _Awaited(Ref):
    """Address of a store that is still to be made: reading its path, or an unknown key, raises _WaitsError."""

    made_by: str = ""

    def __getattribute__(self, name: str) -> Any:
        value = object.__getattribute__(self, name)
        if name == "path" or (name == "key" and not value):
            raise _WaitsError(object.__getattribute__(self, "made_by"))
        return value


class Planner(OpenSurvey):
    """A survey that asks every stage for its key and runs none."""

    def __init__(self, run: SurveyRun) -> None:
        super().__init__(run)
        self.rows: list[StageForecast] = []

    def __call__(self, stage: str, /, *inputs: Ref) -> Ref:
        """Add the forecast of a stage, and return the address that its store would have."""
        product = STAGES[stage].product.name
        ref: Ref = _Awaited(product, "", Path(), made_by=stage)
        try:
            wanted = STAGES[stage].wants(self.run, *inputs)
            key = STAGES[stage].key(wanted)
            found = STAGES[stage].find(self.run.archive, wanted)
        except (PipelineError, OSError) as error:  # the survey would stop here
            why = f"waits for {error}" if isinstance(error, _WaitsError) else str(error)
            row = StageForecast(stage, "blocked", None, why)
        else:
            row = StageForecast(stage, "to run" if found is None else "cached", key)
            ref = found or _Awaited(product, key, self.run.archive.ref(product, key).path, made_by=stage)
        if row not in self.rows:  # the later of two passes asks for lines of the first again
            self.rows.append(row)
        self.products[stage] = ref
        return ref

    def goes_back(self, request: Ref) -> bool:
        """Return whether the survey may ask for more lines."""
        with suppress(PipelineError, OSError):
            return super().goes_back(request)
        return not self.run.plan.plain

    def take_as_found(self, stage: str, ref: Ref, *inputs: Ref) -> None:
        """Add a store that is not made again, because later ones were made of it."""
        self.rows.append(StageForecast(stage, "cached", ref.key))
        self.products[stage] = ref


MOST_SCANS = 8  # in the table
MOST_LETTERS = 250  # of a reason
COLOURS = {"cached": "green", "to run": "bold", "blocked": "yellow"}


def plan_content(settings: Settings) -> dict[str, Any]:
    """Return what a survey would do, stage by stage, as plain tables; writes nothing.

    Raises PipelineError: the survey would be refused for another reason than its size.
    """
    from spectralzoom.flows.survey import draw_class_map  # Prefect takes a second

    with tempfile.TemporaryDirectory(prefix="spectralzoom-plan-") as empty:
        archive = Archive(Path(empty), writes=False)  # where there is none yet
        if is_archive(settings.out):
            archive = Archive.open(settings.out, create=False, write=False)
        run = open_run(settings, planning=True, archive=archive)
        planner = Planner(run)
        draw_class_map(planner)
        if planner.is_judged:
            evaluate(planner, *planner.products.judged)
        fine: FinePlan | None = None
        attention = planner.products["score"]
        if attention is not None and not isinstance(attention, _Awaited):
            with suppress(PipelineError, OSError):  # the row of the stage that reads it has the error
                fine = load_plan(attention)
        figures = field_figures(run, fine)
        zoomed = None if run.plan.plain else run
        if run.plan.plain and run.scans.two_passes is not None:  # which the planner considered
            zoomed = open_run(replace(settings, zoom=ALWAYS), planning=True, archive=archive)
    estimate = estimate_survey(run, fine)
    whole = replace(run.settings, extent=EXTENT_WHOLE)
    uniform = replace(run, settings=whole, plan=replace(run.plan, plain=True), extent=None)
    work = uniform.work_done(uniform.likely_patches).total  # of each uniform scan
    seconds = run.plan.coarse_s + run.plan.fine_s
    content = {
        "archive": settings.out,
        "stages": [asdict(row) for row in planner.rows],
        "to_make": sum(row.state != "cached" for row in planner.rows),
        "refused": run.refused,  # why this machine would refuse the survey
        "notes": list(run.notes),
        "scans": {
            "taken": as_figures(run.scans.chosen, multiply_adds=work),
            "reference": as_figures(run.scans.reference, multiply_adds=work),
            "best_in_time": None if run.plan.plain else as_figures(run.scans.best_in_time(seconds), multiply_adds=work),
            "at_most": run.budget is not None,  # the scores are of maps with everything read
            "candidates": [as_figures(one, multiply_adds=work) for one in frontier(run.scans.offered)],
            "two_passes": None
            if zoomed is None
            else {
                "taken": zoomed is run,
                "step": zoomed.plan.coarse[0].step,
                "exposure_ms": exposing(run.camera, zoomed.plan.coarse[0]).exposure_ms,
                **(estimate if zoomed is run else estimate_survey(zoomed, None)),
            },
        },
        "field": figures,
        "estimate": estimate,
    }
    if run.plan.plain and run.chooses:  # expected, of a uniform scan that is segmented in part
        content["kept"] = run.reading_figures(run.likely_patches)
    return content


def show_plan(content: dict[str, Any], console: Console) -> None:
    """Print the forecast as a table."""
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


def scan_table(scans: Mapping[str, Any]) -> Table:
    """Return two passes and the best uniform scans of other time budgets: seconds, bytes, multiply-adds and score."""
    named = {
        "this survey": scans["taken"],
        "best uniform scan in this time": scans["best_in_time"],
        "cheapest near the best": scans["reference"],
    }
    bound = "at most " if scans["at_most"] else ""
    every = scans["candidates"][:: math.ceil(len(scans["candidates"]) / MOST_SCANS)]
    rows = {
        one["seconds"]: [
            format_scan(one["step"], one["exposure_ms"]),
            ", ".join(name for name, marked in named.items() if marked == one),
            format_seconds(one["seconds"]),
            format_bytes(one["bytes_raw"]),
            format_count(one["multiply_adds"]),
            f"{bound}{score}" if (score := format_prediction(one["expected_miou"], one["expected_spread"])) else DASH,
        ]
        for one in (*every, *named.values())
        if one is not None
    }
    cells = [*rows.items()]
    if (zoomed := scans["two_passes"]) is not None:
        first = format_scan(zoomed["step"], zoomed["exposure_ms"])
        mark = "this survey, two passes" if zoomed["taken"] else "two passes"
        words = [format_estimate(name, zoomed[name]) for name in LABELS if name != "miou"]
        score = DASH if zoomed["miou"]["at_most"] else format_estimate("miou", zoomed["miou"])  # no score by the record
        cells.append((zoomed["capture_s"]["value"], [first, mark, *words, score]))
    columns = ("scan or first pass", "", "capture time", "bytes captured", "multiply-adds", "mIoU, about")
    return table(columns, [row for _, row in sorted(cells)], left=2, whole=columns[2:])


LABELS: Mapping[str, tuple[str, Callable[[float | None], str]]] = {
    "capture_s": ("capture time", format_seconds),
    "bytes_captured": ("bytes captured", format_bytes),
    "multiply_adds": ("model's multiply-adds", format_count),
    "miou": ("mIoU", lambda score: format_prediction(score, None) or DASH),
}


@dataclass(frozen=True)
class Estimate:
    """A figure of a survey that has not run; None where it cannot be estimated."""

    value: float | None
    known_from: str
    at_most: bool = False
    at_least: bool = False
    spread: float | None = None  # a standard deviation


def estimate_survey(run: SurveyRun, fine: FinePlan | None) -> dict[str, dict[str, Any]]:
    """Return what a survey would take and score, `Estimate`s by the names of `LABELS`; a raster has no seconds.

    ``fine`` is the fine pass, where it is planned already.
    """
    camera = {} if run.raster is not None else _of_camera(run, fine)
    expected = run.least_gain is not None  # patches are chosen while the map is drawn
    patch_index = fine.patch_index if fine is not None and fine.sweeps and not expected else run.likely_patches
    every = format_count(run.work_done(run.kept_patches).total)
    source = f"the patches that other scenes needed; {every} with every patch" if expected else "network and field"
    work = Estimate(run.work_done(patch_index).total, source, fine is None and run.chooses and not expected)
    found = {**camera, "multiply_adds": work, "miou": _score(run)}
    return {name: asdict(one) for name, one in found.items()}


def _of_camera(run: SurveyRun, fine: FinePlan | None) -> dict[str, Estimate]:
    """Return seconds and bytes of the passes.

    A fine pass that is not planned yet counts with all of its budget, and with as many lines as can fit into it.
    """
    camera = run.camera
    bands = len(run.scene.wavelength_nm)
    captured = raw_bytes([*run.plan.coarse, *(fine.sweeps if fine else ())], camera, bands)
    open_end = fine is None and not run.plan.plain
    if fine is None and (second := run.second_pass) is not None:
        record = None if run.recorded else run.scan_record
        left = raw_bytes(second.swaths, camera, bands) - second.interlaces * captured
        offered_ms = second.recorded_ms or ((camera.exposure_ms,) if record is None else record.offered_ms(camera))
        lines = int(run.plan.fine_s / (replace(camera, exposure_ms=offered_ms[0]).frame_ms * 1e-3))
        captured += min(lines * camera.samples * bands * BYTES_PER_SAMPLE, left)
    seconds = run.plan.coarse_s + (run.plan.fine_s if fine is None else fine.seconds)
    return {
        "capture_s": Estimate(seconds, "the cost model of mirror and camera", open_end),
        "bytes_captured": Estimate(captured, "lines, samples and bands of the passes", open_end),
    }


def _score(run: SurveyRun) -> Estimate:
    """Return the score by the weights' table of scans, else by the scenes that were kept for validation."""
    if run.part:
        return Estimate(None, "a part of the field is captured, the prior map shows the rest")
    if (scan := run.scans.chosen) is not None:
        source = f"the weights' record of such scans, {counted(int(run.described.record['scans']['scenes']), 'scene')}"
        if scan.spread is not None and scan.spread > MOST_ERROR:
            return Estimate(None, f"{source}; the scenes differ too much")
        return Estimate(scan.expected["mIoU"], source, at_most=run.budget is not None, spread=scan.spread)
    if (zoomed := run.scans.two_passes) is not None and run.scan_record is not None:
        return Estimate(zoomed.expected, "the weights' record of uniform scans and both passes", at_least=True)
    validation = run.described.record.get("validation") or {}
    whole = known_number((validation.get("all") or {}).get("miou"))
    if whole is None:
        return Estimate(None, "no scene was kept for validation when the weights were trained")
    source = f"these weights on {counted(int(validation['scenes']), 'scene')} kept for validation, read whole"
    return Estimate(whole, source, at_most=run.chooses or not run.plan.plain)


def format_estimate(name: str, one: Mapping[str, Any]) -> str:
    """Return an estimate of a name in `LABELS` as text, with its bound or spread."""
    words = LABELS[name][1](one["value"]) if one["spread"] is None else format_prediction(one["value"], one["spread"])
    bound = "at most {}" if one["at_most"] else "{} or more" if one["at_least"] else "{}"
    return words if one["value"] is None else bound.format(words)

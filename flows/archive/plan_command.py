"""The verb `plan`: each stage of a survey is asked for the key of its store; nothing is built or written."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console
from rich.markup import escape

from flows.archive.plan_estimate import Estimate, estimate_survey, estimate_table
from flows.cli.app import AsJson
from flows.cli.survey_verbs import NO_FLAGS, SurveyFlags, by_setting
from flows.publish.findings import field_figures
from flows.publish.receipt_table import finding_rows
from flows.settings.load import load_settings
from flows.settings.survey_settings import Settings
from flows.tasks.capture_plan import ScanChoice, as_figures
from flows.tasks.open_survey import STAGES, OpenSurvey
from flows.tasks.run import SurveyRun, open_run
from flows.tasks.scores import MOST_ERROR, format_prediction
from flows.tasks.stage import Stage, Wanted
from flows.tasks.stages.accuracy import evaluate
from flows.tasks.stages.attention import load_plan
from flows.terminal.figures import DASH, format_bytes, format_count, format_percent, format_seconds
from flows.terminal.processes import DONE
from flows.terminal.progress import put_out, table
from pipeline.errors import IncompleteStoreError, PipelineError
from pipeline.lazy import deferred
from pipeline.planning.fine_pass import FinePlan
from pipeline.planning.uniform_scans import format_scan
from storage.archive.archive import Archive
from storage.archive.keys import StageRef, plain, store_at
from storage.archive.lineage import Catalogue, Change, changes_between, scenes_of
from storage.archive.records import Store
from storage.archive.staging import refusals
from storage.arrays.class_maps import ClassMap, load_class_map
from storage.remote.opening import is_archive, open_archive

if TYPE_CHECKING:
    import flows.archive.plan_preview as plan_preview
    import flows.survey as survey_flow
else:
    survey_flow = deferred("flows.survey")  # Prefect
    plan_preview = deferred("flows.archive.plan_preview")  # matplotlib, for pictures alone

State = Literal["cached", "to run", "blocked"]


def plan(
    settings: Path | None = None, *, flags: SurveyFlags = NO_FLAGS, preview: Path | None = None, as_json: AsJson = False
) -> int:
    """Print what a survey would run: the stages that are stored, those to be made and why, and estimates.

    Estimates are seconds of the camera, bytes, multiply-adds and score, each with its source. Only the preview is
    written. Give the settings that you would give to `survey`.

    Parameters
    ----------
    settings
        A survey's TOML file; flags win over it.
    preview
        A PNG to write: the sweeps over the field's last map, or over its outline where there is none, with zones.
    """
    put_out(plan_content(load_settings(settings, by_setting(flags)), preview), show_plan, as_json=as_json)
    return DONE


@dataclass(frozen=True)
class StageForecast:
    """Forecast of one stage."""

    stage: str
    state: State
    key: str | None  # None while an input of it is not known
    why: str
    changes: tuple[Change, ...] = ()  # against the newest store of the same stage and scene


class _WaitsError(IncompleteStoreError):
    """A stage needs the content or the key of a store that is still to be made."""


@dataclass(frozen=True)
class _Awaited(StageRef):
    """Address of a store that is still to be made: reading its path, or an unknown key, raises _WaitsError."""

    made_by: str = ""

    def __getattribute__(self, name: str) -> Any:
        value = object.__getattribute__(self, name)
        if name == "path" or (name == "key" and not value):
            raise _WaitsError(object.__getattribute__(self, "made_by"))
        return value


@dataclass(frozen=True)
class Forecast:
    """Forecast of a survey, stage by stage in order."""

    stages: list[StageForecast]
    refused: str | None = None  # why this machine would refuse the survey
    scans: ScanChoice = field(default_factory=ScanChoice)
    figures: Mapping[str, Any] = field(default_factory=dict)  # see `flows.publish.findings`
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    kept: Mapping[str, Any] | None = None  # at most, of a uniform scan that is segmented in part


def forecast(settings: Settings, preview: Path | None = None) -> Forecast:
    """Return what a survey would do, stage by stage; writes only the ``preview``, if one is given.

    Raises PipelineError: the survey would be refused for another reason than its size; ArchiveError: the preview cannot
    be written.
    """
    with tempfile.TemporaryDirectory(prefix="spectralzoom-plan-") as empty:
        archive = Archive(Path(empty), writes=False)  # where there is none yet
        if is_archive(settings.out):
            archive = open_archive(settings.out, create=False, write=False)
        run = open_run(settings, planning=True, archive=archive)
        catalogue = Catalogue.read(archive.root)
        planner = Planner(run, catalogue)
        survey_flow.draw_class_map(planner)
        if run.scene.labelled and run.settings.accuracy:
            evaluate(planner, *planner.products.judged)
        fine: FinePlan | None = None
        attention = planner.products["score"]
        if attention is not None and not isinstance(attention, _Awaited):
            with suppress(PipelineError, OSError):  # the row of the stage that reads it has the error
                fine = load_plan(attention)
        figures = field_figures(run, fine)
        if preview is not None:
            with refusals(preview.parent, "write the preview"):
                plan_preview.draw_preview(preview, run, fine, _last_map(run, catalogue), figure_lines(figures))
    kept = run.reading_figures(run.likely_patches) if run.plan.plain and run.chooses else None
    return Forecast(planner.rows, run.refused, run.scans, figures, estimate_survey(run, fine), kept)


def _last_map(run: SurveyRun, catalogue: Catalogue) -> ClassMap | None:
    """Return the field's newest map of the same size that can be read."""
    for one in reversed(catalogue.runs):
        if one.receipt.get("survey") == run.name and "class_map" in one.products:
            with suppress(PipelineError, OSError):
                found = load_class_map(run.archive.locate(one.products["class_map"]))
                if found.classes.shape == run.scene.shape:
                    return found
    return None


class Planner(OpenSurvey):
    """A survey that asks every stage for its key and runs none."""

    def __init__(self, run: SurveyRun, catalogue: Catalogue) -> None:
        super().__init__(run)
        self.catalogue = catalogue
        self.rows: list[StageForecast] = []
        self._planned: dict[str, Store] = {}  # by address

    def __call__(self, stage: str, /, *inputs: StageRef) -> StageRef:
        """Add the forecast of a stage, and return the address that its store would have."""
        try:
            row, ref = self._forecast(STAGES[stage], STAGES[stage].wants(self.run, *inputs))
        except (PipelineError, OSError) as error:  # the survey would stop here
            why = f"waits for {error}" if isinstance(error, _WaitsError) else str(error)
            row = StageForecast(stage, "blocked", None, why)
            ref = _Awaited(STAGES[stage].product.name, "", Path(), made_by=stage)
        if row not in self.rows:  # the later of two passes asks for lines of the first again
            self.rows.append(row)
        self.products[stage] = ref
        return ref

    def goes_back(self, request: StageRef) -> bool:
        """Return whether the survey may ask for more lines."""
        with suppress(PipelineError, OSError):
            return super().goes_back(request)
        return not self.run.plan.plain

    def take_as_found(self, stage: str, ref: StageRef, *inputs: StageRef) -> None:
        """Add a store that is not made again, because later ones were made of it."""
        self.rows.append(StageForecast(stage, "cached", ref.key, "condensed"))
        self.products[stage] = ref

    def _forecast(self, stage: Stage, wanted: Wanted) -> tuple[StageForecast, StageRef]:
        key = stage.key(wanted)
        found = stage.find(self.run.archive, wanted)
        if found is not None:
            return StageForecast(stage.name, "cached", key, "stored"), found
        ref = store_at(self.run.archive.root, stage.product.name, key)
        inputs = [one.key for one in wanted.inputs]
        facts = {"version": stage.product.version, "params": plain(wanted.params), "inputs": inputs}
        self._planned[ref.uri] = Store(ref, facts)
        why, changes = self._reason(stage, self._planned[ref.uri])
        row = StageForecast(stage.name, "to run", key, why, changes)
        return row, _Awaited(ref.stage, key, ref.path, made_by=stage.name)

    def _reason(self, stage: Stage, store: Store) -> tuple[str, tuple[Change, ...]]:
        """Return the differences from the newest store of the same stage and scene, in words and in full."""
        there = self.catalogue.stores.get(store.ref.uri)
        if there is not None and there.cleared:
            return "its files were cleared away by gc", ()
        stored = [
            one
            for one in self.catalogue.stores.values()
            if one.ref.stage == store.ref.stage and not one.problem and stage.inputs in (None, len(one.inputs))
        ]
        known = replace(self.catalogue, stores=self.catalogue.stores | self._planned)
        same = [one for one in stored if scenes_of(known, one.ref.uri) <= {self.run.scene.key}]
        before = max(same, key=lambda one: one.created, default=None)
        if before is None:
            return ("nothing stored yet of this scene" if stored else "nothing stored yet"), ()
        found = tuple(change for change in changes_between(known, before, store) if change.kind != "library")
        return _format_summary(found, store.ref.stage), found


def _format_summary(changes: Sequence[Change], stage: str) -> str:
    """Return the first change at its origin, and how many more there are."""
    causes = [change for change in changes if change.kind != "input"] or list(changes)
    if not causes:
        return "only its key differs"
    first = causes[0]
    where = "" if first.where == stage else f" of {first.where}"
    more = f", and {len(causes) - 1} more" if len(causes) > 1 else ""
    if first.kind == "input" or first.name == "weights":
        return f"other {first.name} than in the newest store{where}{more}"
    name = "version" if first.kind == "version" else first.name
    old, new = (", ".join(map(str, one)) if isinstance(one, list) else one for one in (first.old, first.new))
    return f"{name}{where}: {old} before, {new} now{more}"


MOST_SCANS = 8  # of the frontier that are shown
SCANS_TITLE = "One uniform scan of the field, by the weights' scan performance table"
MARKS = {"taken": "this survey", "reference": "reference"}
MOST_LETTERS = 250  # of a reason
COLOURS = {"cached": "green", "to run": "bold", "blocked": "yellow"}


def plan_content(settings: Settings, preview: Path | None = None) -> dict[str, Any]:
    """Return the forecast as plain tables."""
    found = forecast(settings, preview)
    best = found.scans.frontier
    shown = np.linspace(0, len(best) - 1, min(len(best), MOST_SCANS)).round().astype(int)
    return {
        "archive": settings.out,
        "stages": [asdict(row) for row in found.stages],
        "to_make": sum(row.state != "cached" for row in found.stages),
        "refused": found.refused,
        "scans": {
            "taken": as_figures(found.scans.chosen),
            "reference": as_figures(found.scans.reference),
            "frontier": [as_figures(best[number]) for number in shown],
        },
        "field": found.figures,
        "estimate": {name: asdict(one) for name, one in found.estimates.items()},
        **({} if found.kept is None else {"kept": found.kept}),
        **({} if preview is None else {"preview": str(preview)}),
    }


def show_plan(content: dict[str, Any], console: Console) -> None:
    """Print the forecast as a table."""
    rows = [
        [row["stage"], f"[{COLOURS[row['state']]}]{row['state']}[/]", escape(shorten(row["why"], MOST_LETTERS))]
        for row in content["stages"]
    ]
    console.print(table(("stage", "state", "why"), rows, left=3, whole=("stage", "state")))
    kept = [format_kept(content["kept"])] if "kept" in content else []
    for line in (*figure_lines(content["field"]), *kept):
        console.print(escape(line), soft_wrap=True)
    if content["to_make"]:
        console.print(f"{content['to_make']} stages to make")
        console.print(estimate_table(content["estimate"]))
    else:
        console.print("everything is stored: it would be published")
    if content["scans"]["frontier"]:
        _show_scans(content["scans"], console)
    if "preview" in content:
        console.print(f"preview: {escape(content['preview'])}", soft_wrap=True)
    if content["refused"] is not None:
        console.print(f"[yellow]refused here[/]: {escape(content['refused'])}", soft_wrap=True)


def figure_lines(figures: Mapping[str, Any]) -> list[str]:
    """Return the figures of the field and of the captures in sentences, a line each."""
    size = f"{' x '.join(map(format_count, figures['size_px']))} px"
    lines = [f"field: {'; '.join((size, *(text for _, text in finding_rows({'field': figures}))))}"]
    if figures["kept_fraction"] is not None:
        lines.append(f"zones: {format_percent(figures['kept_fraction'])} of the field is kept to")
    if figures["ground_pixel_m"] is None:
        lines.append("no metres are known: a [pose], or a georeferenced scene, gives them and hectares an hour")
    camera, count = figures["camera_s"], figures["lines"]
    if camera is None:
        return [*lines, "camera: none; the pixels of the raster are taken as they are"]
    fine = f"{'' if figures['fine_planned'] else 'at most '}{format_seconds(camera['fine'])}"
    fine_lines = "" if count["fine"] is None else f" and {format_count(count['fine'])}"
    return [
        *lines,
        f"camera: {format_seconds(camera['all'])} (coarse {format_seconds(camera['coarse'])}, fine {fine}) for "
        f"{format_count(count['coarse'])}{fine_lines} lines; every line at full exposure: "
        f"{format_seconds(camera['full_scan'])} for {format_count(count['full_scan'])}",
    ]


def format_kept(kept: Mapping[str, Any]) -> str:
    """Return how much of a uniform scan the budgets pay for at most."""
    read = kept["multiply_adds"]["done"] / kept["multiply_adds"]["everything"]
    return (
        f"full reading: likely {kept['patches']} of {kept['of_patches']} patches, for {format_percent(read)} of the "
        "multiply-adds of reading everything"
    )


def _show_scans(scans: dict[str, Any], console: Console) -> None:
    """Print the cost of uniform scans of the field, and their expected scores."""
    rows = {scan["seconds"]: scan for scan in scans["frontier"]}
    marks = {name: scans[name] for name in ("taken", "reference") if scans[name] is not None}
    rows |= {scan["seconds"]: scan for scan in marks.values()}
    cells = []
    for seconds, scan in sorted(rows.items()):
        notes = ", ".join(MARKS[name] for name, one in marks.items() if one == scan)
        predicted = format_prediction(scan["expected_miou"], scan["expected_spread"]) or DASH
        figures = f"{seconds:.1f}", format_bytes(scan["bytes_raw"]), predicted
        cells.append([format_scan(scan["step"], scan["exposure_ms"]), notes, *figures])
    columns = ("scan", "", "seconds", "raw data", "mIoU, about")
    console.print(table(columns, cells, left=2, title=SCANS_TITLE, whole=columns))
    if any(row[-1] == DASH for row in cells):
        console.print(
            f"[dim]{DASH}: scenes differ by more than {100 * MOST_ERROR:.0f} points (one standard deviation)[/]"
        )

"""The verb `plan`: each stage of a survey is asked for the key of its store; nothing is built or written."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.markup import escape

from flows.archive.plan_estimate import estimate_survey, estimate_table
from flows.cli.app import AsJson
from flows.cli.survey_verbs import NO_FLAGS, SurveyFlags, by_setting
from flows.publish.findings import field_figures
from flows.publish.receipt_table import finding_rows
from flows.settings.load import load_settings
from flows.settings.survey_settings import Settings
from flows.tasks.capture_plan import as_figures
from flows.tasks.open_survey import STAGES, OpenSurvey
from flows.tasks.run import SurveyRun, open_run
from flows.tasks.stage import Stage, Wanted
from flows.tasks.stages.accuracy import evaluate
from flows.tasks.stages.attention import load_plan
from flows.terminal.figures import format_count
from flows.terminal.processes import DONE
from flows.terminal.progress import put_out, table
from pipeline.errors import IncompleteStoreError, PipelineError
from pipeline.lazy import deferred
from pipeline.planning.fine_pass import FinePlan
from storage.archive.archive import Archive
from storage.archive.keys import StageRef, store_at
from storage.remote.opening import is_archive, open_archive

if TYPE_CHECKING:
    import flows.survey as survey_flow
else:
    survey_flow = deferred("flows.survey")  # Prefect

State = Literal["cached", "to run", "blocked"]


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
    state: State
    key: str | None  # None while an input of it is not known
    why: str = ""  # a stage is blocked


class _WaitsError(IncompleteStoreError):
    """A stage needs the content or the key of a store that is still to be made."""


@dataclass(frozen=True)
class _Awaited(StageRef):
    """Address of a store that is still to be made: reading its path, or an unknown key, raises _WaitsError."""

    made_by: str

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

    def __call__(self, stage: str, /, *inputs: StageRef) -> StageRef:
        """Add the forecast of a stage, and return the address that its store would have."""
        try:
            row, ref = self._forecast(STAGES[stage], STAGES[stage].wants(self.run, *inputs))
        except (PipelineError, OSError) as error:  # the survey would stop here
            why = f"waits for {error}" if isinstance(error, _WaitsError) else str(error)
            row = StageForecast(stage, "blocked", None, why)
            ref = _Awaited(STAGES[stage].product.name, "", Path(), stage)
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
        self.rows.append(StageForecast(stage, "cached", ref.key))
        self.products[stage] = ref

    def _forecast(self, stage: Stage, wanted: Wanted) -> tuple[StageForecast, StageRef]:
        key = stage.key(wanted)
        found = stage.find(self.run.archive, wanted)
        if found is not None:
            return StageForecast(stage.name, "cached", key), found
        ref = store_at(self.run.archive.root, stage.product.name, key)
        return StageForecast(stage.name, "to run", key), _Awaited(ref.stage, key, ref.path, stage.name)


MOST_LETTERS = 250  # of a reason
COLOURS = {"cached": "green", "to run": "bold", "blocked": "yellow"}


def plan_content(settings: Settings) -> dict[str, Any]:
    """Return what a survey would do, stage by stage, as plain tables; writes nothing.

    Raises PipelineError: the survey would be refused for another reason than its size.
    """
    with tempfile.TemporaryDirectory(prefix="spectralzoom-plan-") as empty:
        archive = Archive(Path(empty), writes=False)  # where there is none yet
        if is_archive(settings.out):
            archive = open_archive(settings.out, create=False, write=False)
        run = open_run(settings, planning=True, archive=archive)
        planner = Planner(run)
        survey_flow.draw_class_map(planner)
        if run.scene.labelled and run.settings.accuracy:
            evaluate(planner, *planner.products.judged)
        fine: FinePlan | None = None
        attention = planner.products["score"]
        if attention is not None and not isinstance(attention, _Awaited):
            with suppress(PipelineError, OSError):  # the row of the stage that reads it has the error
                fine = load_plan(attention)
        figures = field_figures(run, fine)
    content = {
        "archive": settings.out,
        "stages": [asdict(row) for row in planner.rows],
        "to_make": sum(row.state != "cached" for row in planner.rows),
        "refused": run.refused,  # why this machine would refuse the survey
        "scans": {"taken": as_figures(run.scans.chosen), "reference": as_figures(run.scans.reference)},
        "field": figures,
        "estimate": {name: asdict(one) for name, one in estimate_survey(run, fine).items()},
    }
    if run.plan.plain and run.chooses:  # at most, of a uniform scan that is segmented in part
        content["kept"] = run.reading_figures(run.likely_patches)
    return content


def show_plan(content: dict[str, Any], console: Console) -> None:
    """Print the forecast as a table."""
    rows = [
        [row["stage"], f"[{COLOURS[row['state']]}]{row['state']}[/]", escape(shorten(row["why"], MOST_LETTERS))]
        for row in content["stages"]
    ]
    console.print(table(("stage", "state", "why"), rows, left=3, whole=("stage", "state")))
    console.print(escape(format_field(content["field"])), soft_wrap=True)
    if content["to_make"]:
        console.print(f"{content['to_make']} stages to make")
        console.print(estimate_table(content["estimate"]))
    else:
        console.print("everything is stored: it would be published")
    if content["refused"] is not None:
        console.print(f"[yellow]refused here[/]: {escape(content['refused'])}", soft_wrap=True)


def format_field(figures: Mapping[str, Any]) -> str:
    """Return the size of the field, and what gives metres where they are not known."""
    size = f"{' x '.join(map(format_count, figures['size_px']))} px"
    told = [size, *(text for _, text in finding_rows({"field": figures}))]
    if figures["ground_pixel_m"] is None:
        told.append("no metres are known: a [pose], or a georeferenced scene, gives them and hectares an hour")
    if figures["camera_s"] is None:
        told.append("no camera: the pixels of the raster are taken as they are")
    return f"field: {'; '.join(told)}"

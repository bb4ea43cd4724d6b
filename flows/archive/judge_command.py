"""What `spectralzoom evaluate ARCHIVE RUN` does: judge the map of a run that was published without its accuracy.

Nothing of the survey is made again: what it left is read from the archive, and the light that controls need is drawn.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from rich.console import Console
from rich.markup import escape

from flows.archive.compare_command import find_run
from flows.archive.stale_runs import asked_again
from flows.publish.receipt import Receipt
from flows.publish.run_folder import add_accuracy, load_receipt
from flows.publish.survey_command import show_published
from flows.settings.survey_settings import Settings
from flows.survey.rig_run import for_rig
from flows.survey.run import SurveyRun, open_run
from flows.survey.scores import JUDGING
from flows.survey.stages import VERSIONS
from flows.survey.survey import TITLES, Products, StageRunner, judge
from flows.terminal.progress import StageProgress
from models.network.process import keep_freed_memory, use_one_thread
from pipeline.errors import ArchiveError, SceneError, WeightsError
from storage.archive.archive import Archive, StageRef
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.remote.opening import open_archive

# products of a survey, and the stages that leave them
MADE_BY = {
    "effects": "choose_effects", "raw_coarse": "capture_coarse", "coarse_pointing": "register_coarse",
    "lookup": "locate", "mosaic": "rectify", "attention": "attend", "raw_fine": "capture_fine",
    "fine_pointing": "register_fine", "patches": "cut_patches", "class_map": "draw_map", "turned": "compare_turned",
    "ground_map": "ground",
}  # fmt: skip
MAY_BE_MISSING = ("coarse_pointing", "fine_pointing", "ground_map")


@dataclass(frozen=True)
class JudgeRequest:
    """Which run, and how: None leaves it as the survey was asked for."""

    archive: str
    run: str  # its name, `latest` or `previous`
    controls: bool | None = None
    labels: str | None = None


def split_address(text: str) -> tuple[str, str] | None:
    """Archive and run of an address such as ``archive/runs/20261120T101701-farm``; None of anything else."""
    found = re.fullmatch(r"(.+)/runs/([^/]+)/?", text)
    return None if found is None else (found[1], found[2])


def run_judge(request: JudgeRequest, console: Console) -> Receipt:
    """Judge a run's map and add its accuracy to the run; gives its receipt, as it is where it has what is asked for.

    Raises
    ------
    ArchiveError : there is no such run, it is damaged, or lacks what is needed.
    SceneError, WeightsError : scene, labels or weights are not those of the run, or there are no labels.
    """
    opened = open_archive(request.archive, create=False)
    catalogue = Catalogue.read(opened.root)
    found = find_run(catalogue, request.run)
    receipt = load_receipt(found.folder)
    settings = _settings(found, request, opened.name)
    if _has(receipt, settings, request):
        console.print(escape(f"{found.uri} has its accuracy already"), highlight=False, soft_wrap=True)
        return receipt
    use_one_thread()
    keep_freed_memory()
    with console.status("opening scene and weights"):
        run = open_run(settings)
        run.archive.reclaim()
        products = _products(catalogue, found, run)
        _check_same(catalogue, found, products, run)
    with run.archive.in_use(), run.settings.crew.open(), StageProgress(console, TITLES) as progress:

        def watch(stage: str, state: str, done: float) -> None:
            running = state == "running"
            progress.show(stage, done, "" if running else state, ended=not running)

        draft = run.archive.extend_run(found.folder.name, wait=False)
        if draft is None:
            raise ArchiveError(f"{found.uri} is being judged by another process; it adds the accuracy")
        with draft:
            runner = StageRunner(run, watch)
            judged = judge(runner, products)
            published = add_accuracy(run, draft, judged, runner.records[JUDGING])
    show_published(published, run.archive, console)
    return published.receipt


def _settings(found: Run, request: JudgeRequest, archive: str) -> Settings:
    """The settings of the run's survey, with what is asked for now."""
    settings = replace(asked_again(found, archive, None), accuracy=True)
    if request.controls is not None:
        settings = for_rig(replace(settings, controls=request.controls))
    return settings if request.labels is None else replace(settings, labels=request.labels)


def _has(receipt: Receipt, settings: Settings, request: JudgeRequest) -> bool:
    """Whether a run's receipt has what is asked for: accuracy, by these labels, and controls where they are wanted."""
    if "accuracy" not in receipt or request.labels is not None:
        return False
    return bool(receipt["accuracy"]["controls"]) or not settings.controls


def _products(catalogue: Catalogue, found: Run, run: SurveyRun) -> Products:
    """What the run's survey left, each whole by its manifest and of the present version of its stage."""
    keys = {str(row.get("name")): str(row.get("key") or "") for row in found.stages}
    refs: dict[str, StageRef | None] = {}
    for product, stage in MADE_BY.items():
        key = keys.get(stage, "")
        if not key and product in MAY_BE_MISSING:
            refs[product] = None
        else:
            refs[product] = _store(catalogue, found, run.archive, product, key)
    return Products(**refs)  # type: ignore[arg-type]


def _store(catalogue: Catalogue, found: Run, archive: Archive, product: str, key: str) -> StageRef:
    uris = [uri for uri in catalogue.by_key.get(key, []) if uri in catalogue.stores]
    store = catalogue.stores[uris[0]] if uris else None
    what = f"{product.replace('_', ' ')} of {found.uri}"
    if store is None or store.problem is not None:
        raise ArchiveError(f"the {what} is missing or damaged; run verify --repair")
    now = VERSIONS.get(store.ref.stage)
    if store.version != str(now):
        raise ArchiveError(
            f"the {what} was made by version {store.version} of the stage {store.ref.stage}, which is now {now}:"
            " reprocess makes a new run, with its accuracy"
        )
    return archive.ref(store.ref.stage, store.ref.key)


def _check_same(catalogue: Catalogue, found: Run, products: Products, run: SurveyRun) -> None:
    """Refuse to judge by another scene or other weights than the map is of, or where there is nothing to judge by."""
    if run.scene.key != found.receipt.get("scene"):
        raise SceneError(
            f"the scene {run.settings.scene} is another than {found.uri} looked at; put that one back, or survey again"
        )
    drawn_with = _param(catalogue, products.class_map, "weights")
    if run.weights_key != drawn_with:
        raise WeightsError(
            f"the weights {run.settings.weights or 'that come with SpectralZoom'} are others than the map of"
            f" {found.uri} was drawn with; put those back, or reprocess with these"
        )
    if not run.scene.labelled:
        raise SceneError(f"there are no labels to judge {found.uri} by; give --labels FILE, on the scene's pixels")


def _param(catalogue: Catalogue, ref: StageRef, name: str) -> object:
    params: Mapping[str, object] = catalogue.stores[ref.uri].params
    return params.get(name)

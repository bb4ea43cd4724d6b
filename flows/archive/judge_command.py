"""What `spectralzoom evaluate ARCHIVE RUN` does: judge the map of a run that was published without its accuracy.

Nothing of the survey is made again: what it left is read from the archive, and the light that controls need is drawn.
"""

from __future__ import annotations

from dataclasses import replace

from rich.console import Console
from rich.markup import escape

from flows.archive.compare_command import find_run
from flows.archive.stale_runs import asked_again
from flows.publish.receipt import Receipt
from flows.publish.run_folder import add_accuracy, load_receipt
from flows.publish.survey_command import show_published
from flows.survey.run import SurveyRun, open_run
from flows.survey.sources import for_rig
from flows.survey.stage import versions
from flows.survey.survey import STAGES, TITLES, Products, StageRunner, judge
from flows.terminal.progress import StageProgress
from models.network.process import keep_freed_memory, use_one_thread
from pipeline.errors import ArchiveError, SceneError, WeightsError
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.remote.opening import open_archive


def run_judge(
    archive: str, name: str, console: Console, *, controls: bool | None = None, labels: str | None = None
) -> Receipt:
    """Judge a run's map and add its accuracy to the run; gives its receipt, as it is where it has what is asked for.

    ``name`` may be `latest` or `previous`; what is None is as the survey was asked for.

    Raises
    ------
    ArchiveError : there is no such run, it is damaged, or lacks what is needed.
    SceneError, WeightsError : scene, labels or weights are not those of the run, or there are no labels.
    """
    opened = open_archive(archive, create=False)
    catalogue = Catalogue.read(opened.root)
    found = find_run(catalogue, name)
    receipt = load_receipt(found.folder)
    settings = replace(asked_again(found, opened.name, None), accuracy=True)
    if controls is not None:
        settings = for_rig(replace(settings, controls=controls))
    if labels is not None:
        settings = replace(settings, labels=labels)
    there = "accuracy" in receipt and labels is None
    if there and (receipt["accuracy"]["controls"] or not settings.controls):
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
        draft = run.archive.extend_run(found.folder.name, wait=False)
        if draft is None:
            raise ArchiveError(f"{found.uri} is being judged by another process; it adds the accuracy")
        with draft:
            runner = StageRunner(run, progress.watch)
            judged = judge(runner, products)
            published = add_accuracy(run, draft, judged, runner.records["evaluate"])
    show_published(published, run.archive, console)
    return published.receipt


def _products(catalogue: Catalogue, found: Run, run: SurveyRun) -> Products:
    """What the run's survey left, each whole by its manifest and of the present version of its stage."""
    rows = {str(row.get("name")): row for row in found.stages}
    products = Products()
    for stage in STAGES.values():
        if not stage.judges:
            row = rows.get(stage.name, {})
            key, what = str(row.get("key") or ""), f"{stage.title} of {found.uri}"
            skipped = row.get("state") == "skipped"
            products[stage.name] = None if skipped else _store(catalogue, run.archive, what, key)
    return products


def _store(catalogue: Catalogue, archive: Archive, what: str, key: str) -> StageRef:
    uris = [uri for uri in catalogue.by_key.get(key, []) if uri in catalogue.stores]
    store = catalogue.stores[uris[0]] if uris else None
    if store is None or store.problem is not None:
        raise ArchiveError(f"the {what} is missing or damaged; run verify --repair")
    now = versions().get(store.ref.stage)
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
    if run.weights_key != catalogue.stores[products.of("draw_map").uri].params.get("weights"):
        raise WeightsError(
            f"the weights {run.settings.weights or 'that come with SpectralZoom'} are others than the map of"
            f" {found.uri} was drawn with; put those back, or reprocess with these"
        )
    if not run.scene.labelled:
        raise SceneError(f"there are no labels to judge {found.uri} by; give --labels FILE, on the scene's pixels")

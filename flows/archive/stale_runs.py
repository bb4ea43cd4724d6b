"""Select the newest run of every field of an archive, and decide whether present code and weights would change it."""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path, PurePath

from flows.settings.load import load_settings, of_this_version, parse_settings
from flows.settings.survey_settings import BUILT_IN_SCENES, OF_THE_MACHINE, RECORDED, RIG, Settings
from flows.tasks.open_survey import STAGES, versions
from flows.tasks.recorded_field import open_recorded
from flows.tasks.scene import open_map, open_scene
from flows.tasks.survey_model import weights_path
from models.weights.files import describe_weights
from pipeline.errors import PipelineError, SceneError, SettingsError
from storage.archive.keys import canonical_json
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.readers.recordings import stores_of_lines

OF_THE_SURVEY = ("labels", "weights", "memory", "accuracy", "controls", "prior", "keep")  # not in raw cubes


def called(run: Run) -> str:
    """Return the name of the field that a run surveyed."""
    return str(run.receipt.get("survey") or run.facts.get("survey") or run.folder.name)


def generations(catalogue: Catalogue) -> list[list[Run]]:
    """Return the runs of each field, oldest first: those of one name, source, visit and scene, by the scene's key.

    A run without a readable receipt is a field of its own.
    """
    found: dict[str, list[Run]] = {}
    by_name = {one.folder.name: one for one in catalogue.runs}
    for run in catalogue.runs:
        lit = run
        while lit.settings.get("source") == RECORDED:  # perhaps the raw cubes of another run
            place, _, name = str(lit.settings.get("sweeps")).rpartition("/runs/")
            if not place or name == lit.folder.name or name not in by_name:
                break
            lit = by_name[name]
        asked = [lit.settings.get(name) for name in ("source", "visit")]
        found.setdefault(canonical_json([called(run), lit.receipt.get("scene", run.uri), *asked]), []).append(run)
    return list(found.values())


def newest_runs(catalogue: Catalogue) -> list[Run]:
    """Return the newest run of every field, oldest first."""
    newest = {runs[-1].uri for runs in generations(catalogue)}
    return [run for run in catalogue.runs if run.uri in newest]


def from_raw_cubes(catalogue: Catalogue, run: Run, settings: Settings) -> Settings:
    """Return settings that survey a run's own raw cubes as a recording, where its source cannot be read again.

    That is the case if the stage of captures has another version, or if the files of a recording or scene are gone or
    changed. The settings stay as they are otherwise. Raises SettingsError, BudgetError: as `asked_again`; SceneError:
    the raw cubes are gone too.
    """
    raw = set(stores_of_lines(run.products, lambda uri: uri in catalogue.stores and not catalogue.stores[uri].cleared))
    stores = [catalogue.stores.get(uri) for uri in raw]
    is_there = _is_there(run, settings)
    if not stores or any(one is None or one.problem is not None or one.cleared for one in stores):
        if is_there:
            return settings
        raise SceneError(
            f"what {run.uri} showed is gone or shows something else by now; restore its scene or recording"
        )
    is_old = settings.source in (RIG, RECORDED) and bool(stale_stores(catalogue, raw, None))
    if not is_old and is_there:
        return settings
    asked = {"sweeps": f"{settings.out}/{run.uri}", "out": settings.out, "engine": settings.engine}
    kept = {name: getattr(settings, name) for name in OF_THE_SURVEY}
    return load_settings(None, {name: value for name, value in {**asked, **kept}.items() if value is not None})


def can_capture(run: Run) -> bool:
    """Return whether the lines or pixels of a run can be captured or read again; a rig would show another day."""
    try:
        settings = asked_again(run, run.folder.parents[1], None)
    except PipelineError:
        return False
    return settings.source != RIG and _is_there(run, settings)


def _is_there(run: Run, settings: Settings) -> bool:
    """Return whether the recording or scene file of a run still shows the same; True for a rig and built-in scenes."""
    if settings.source == RIG or (settings.source != RECORDED and settings.scene in BUILT_IN_SCENES):
        return True
    try:
        if settings.source == RECORDED:
            scene = open_recorded(settings).scene()[0].in_light(settings.sky.fraction_of_clear)
        else:
            scene = open_map(settings)[1] if settings.is_map else open_scene(settings)[0]
    except PipelineError:
        return False
    return scene.key == run.receipt.get("scene")


def is_called(run: Run, pattern: str) -> bool:
    """Return whether the survey, scene or run has this name; ``*`` matches any letters."""
    scene = str(run.settings.get("scene", ""))
    names = (called(run), scene, PurePath(scene).name, run.folder.name)
    return any(fnmatchcase(name, pattern.replace("[", "[[]").replace("?", "[?]")) for name in names)


def asked_again(run: Run, out: str | Path, weights: Path | None) -> Settings:
    """Return the settings of a run for another survey into the archive ``out``, with other ``weights`` if given.

    Raises SettingsError, BudgetError: the run's settings cannot be read, or are not of this version.
    """
    if not run.settings:
        raise SettingsError(f"the settings of {run.uri} cannot be read ({run.problem}); survey this field by hand")
    known = of_this_version(run.settings) | dict.fromkeys(OF_THE_MACHINE)
    return parse_settings({**known, "out": str(out), **({} if weights is None else {"weights": str(weights)})})


def stale_stores(catalogue: Catalogue, uris: set[str], weights: str | None) -> set[str]:
    """Return the stores that a survey would make again: missing, damaged, of another version or of other weights."""
    now = versions()
    by_weights = {one.product.name for one in STAGES.values() if one.product.by_weights}
    found = {uri: catalogue.stores.get(uri) for uri in uris}
    return {
        uri
        for uri, store in found.items()
        if store is None
        or store.problem is not None
        or store.version != str(now.get(store.ref.stage))
        or (store.ref.stage in by_weights and store.params.get("weights", weights) != weights)
    }


def weights_now(run: Run, settings: Settings | None = None) -> str | None:
    """Return the key of the weights that the survey of a run takes now; None where they cannot be read."""
    try:
        return describe_weights(weights_path(settings or asked_again(run, run.folder.parents[1], None))).key
    except (OSError, PipelineError):
        return None


def is_current(catalogue: Catalogue, run: Run, settings: Settings) -> bool:
    """Return whether a run is whole and its survey would find all of its stores, by versions and weights alone."""
    weights = weights_now(run, settings)
    complete = run.problem is None and all(row.get("state") != "failed" for row in run.stages)
    return complete and not stale_stores(catalogue, set(run.names), weights)

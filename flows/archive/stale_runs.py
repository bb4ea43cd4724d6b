"""Fields of an archive, the newest run of each, and whether it is as the present code, weights and settings make it."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path, PurePath
from typing import Any

from flows.publish.receipt import is_pending
from flows.settings.load import load_settings, of_this_version, parse_settings
from flows.settings.survey_settings import BUILT_IN_SCENES, OF_THE_MACHINE, RECORDED, Settings
from flows.tasks.open_survey import STAGES, versions
from flows.tasks.survey_model import weights_path
from models.weights.files import describe_weights
from pipeline.errors import PipelineError, SettingsError, WeightsError
from pipeline.simulator.scenes.built_in import LAWS
from pipeline.simulator.scenes.farm.farm_scene import USUAL_DAY, USUAL_HOUR
from storage.archive.keys import canonical_json
from storage.archive.lineage import Catalogue
from storage.archive.records import Run, Store
from storage.readers.open_cubes import split_variable
from storage.readers.recordings import find_raw_cubes, stores_of_lines

OF_THE_SURVEY = ("labels", "weights", "memory", "accuracy", "prior")  # settings that its raw cubes do not bring
# what the light of a field depends on; surveys that agree in these are generations of one
OF_THE_LIGHT = (
    *("scene", "bands", "wavelengths", "source", "seed", "effects", "size"),
    *("day", "hour", "interest", "camera", "pointing_px", "pose", "visit", "sweeps", "pointing", "dark", "white"),
)


@dataclass(frozen=True)
class Generation:
    """The newest run of one field."""

    field: str  # what its survey is called
    run: Run


def called(run: Run) -> str:
    """Return the name of the field that a run surveyed."""
    return str(run.receipt.get("survey") or run.facts.get("survey") or run.folder.name)


def newest_runs(catalogue: Catalogue) -> list[Generation]:
    """Return the newest run of every field, oldest first; a run with unreadable settings is a field of its own."""
    found: dict[str, Generation] = {}
    for run in catalogue.runs:  # oldest first
        name = called(run)
        field = canonical_json([name, _light_of(_recorded_run(catalogue, run)) if run.settings else run.uri])
        found.pop(field, None)
        found[field] = Generation(name, run)
    return list(found.values())


def renewals(catalogue: Catalogue) -> dict[str, str]:
    """Return the newest run of the same look for each run that was made again, by their names."""
    scan_passes: dict[str, list[str]] = {}
    for run in catalogue.runs:
        if run.settings:
            light = _light_of(_recorded_run(catalogue, run))
            scan_passes.setdefault(canonical_json([called(run), light]), []).append(run.folder.name)
    return {earlier: names[-1] for names in scan_passes.values() for earlier in names[:-1]}


def _recorded_run(catalogue: Catalogue, run: Run) -> Run:
    """Return the run of this archive whose raw cubes a run was surveyed from as a recording, else the run itself."""
    by_name = {one.folder.name: one for one in catalogue.runs}
    while run.settings.get("source") == RECORDED:
        place, _, name = str(run.settings.get("sweeps")).rpartition("/runs/")
        if not place or name == run.folder.name or name not in by_name:
            return run
        run = by_name[name]
    return run


def from_raw_cubes(catalogue: Catalogue, run: Run, settings: Settings) -> Settings:
    """Return the settings of a survey of a run's own raw cubes as a recording, where its light is not found otherwise.

    That is so where the captures have another version than a rig or a recording left. It is so, too, where the files of
    a recording or of a simulated scene are gone. Else, and where the raw cubes are gone too, the settings stay. Raises
    SettingsError, BudgetError: as `asked_again`.
    """
    raw = set(stores_of_lines(run.products, lambda uri: uri in catalogue.stores and not catalogue.stores[uri].cleared))
    stores = [catalogue.stores.get(uri) for uri in raw]
    if not stores or any(one is None or one.problem is not None or one.cleared for one in stores):
        return settings
    is_old = settings.source in ("rig", RECORDED) and bool(stale_stores(catalogue, raw, None))
    if not is_old and _is_there(settings):
        return settings
    asked = {"sweeps": f"{settings.out}/{run.uri}", "out": settings.out, "engine": settings.engine}
    kept = {name: getattr(settings, name) for name in OF_THE_SURVEY}
    return load_settings(None, {name: value for name, value in {**asked, **kept}.items() if value is not None})


def _is_there(settings: Settings) -> bool:
    """Return whether what a recording or a scene comes from still lies where it lay; a rig is taken to be there."""
    if settings.source == RECORDED:
        try:
            find_raw_cubes(str(settings.sweeps))
        except PipelineError:
            return False
        return True
    if settings.source != "sim" or settings.scene in BUILT_IN_SCENES:
        return True
    return split_variable(settings.scene)[0].exists()


def _light_of(run: Run) -> dict[str, Any]:
    """Return the settings that the light of a run depends on, a built-in scene by one name and its usual moment."""
    light = {key: run.settings.get(key) for key in OF_THE_LIGHT}
    sky = run.settings.get("sky")
    light["sky"] = [sky.get("light", "clear"), sky.get("light_fraction")] if isinstance(sky, dict) else ["clear", None]
    if light["scene"] in BUILT_IN_SCENES:
        usual = {"day": USUAL_DAY, "hour": USUAL_HOUR}
        light |= {"scene": LAWS[light["scene"]]} | {key: value for key, value in usual.items() if light[key] is None}
    return light


def is_called(generation: Generation, pattern: str) -> bool:
    """Return whether a field's survey, scene or run is called so; ``*`` stands for any letters."""
    scene = str(generation.run.settings.get("scene", ""))
    names = (generation.field, scene, PurePath(scene).name, generation.run.folder.name)
    return any(fnmatchcase(name, pattern.replace("[", "[[]").replace("?", "[?]")) for name in names)


def asked_again(run: Run, out: str | Path, weights: Path | None) -> Settings:
    """Return the settings of a run for another survey into the archive ``out``, with other weights if these are given.

    Raises SettingsError, BudgetError: the run's settings cannot be read, or are not of this version.
    """
    if not run.settings:
        raise SettingsError(f"the settings of {run.uri} cannot be read ({run.problem}); survey this field by hand")
    known = of_this_version(run.settings) | dict.fromkeys(OF_THE_MACHINE)
    return parse_settings({**known, "out": str(out), **({} if weights is None else {"weights": str(weights)})})


def stale_stores(catalogue: Catalogue, uris: set[str], weights: str | None) -> set[str]:
    """Return the stores that a survey would make again: gone, damaged, of another version, of other weights."""
    now, by_weights = versions(), {one.product.name for one in STAGES.values() if one.product.by_weights}

    def is_stale(store: Store | None) -> bool:
        if store is None or store.problem is not None or store.version != str(now.get(store.ref.stage)):
            return True
        return store.ref.stage in by_weights and store.params.get("weights", weights) != weights

    return {uri for uri in uris if is_stale(catalogue.stores.get(uri))}


def is_whole(catalogue: Catalogue, run: Run) -> bool:
    """Return whether run and stores are there, told from manifests alone, and none of its stages failed."""
    stores = [catalogue.stores.get(uri) for uri in catalogue.named_and_below[run.uri]]
    failed = any(row.get("state") == "failed" for row in run.stages)
    return run.problem is None and not failed and all(one is not None and one.problem is None for one in stores)


def is_current(catalogue: Catalogue, run: Run, settings: Settings) -> bool:
    """Return whether its survey would find all that this run rests on, by versions and weights alone."""
    stale = stale_stores(catalogue, catalogue.named_and_below[run.uri], weights_key(settings))
    return not stale and is_whole(catalogue, run) and not is_pending(run.receipt)


def weights_key(settings: Settings) -> str | None:
    """Return the key of the weights by their content, as stages know it; None where they cannot be read."""
    try:
        path = weights_path(settings)
        return _file_key(path, path.stat().st_mtime_ns, path.stat().st_size)
    except (OSError, SettingsError, WeightsError):  # they came from elsewhere, and nothing says which they are
        return None


@cache
def _file_key(path: Path, changed_ns: int, size: int) -> str:
    """Read once for all fields, and again when the file has changed."""
    return describe_weights(path).key

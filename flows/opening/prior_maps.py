"""The prior map of a survey: which earlier run it is of, and how many days ago that was."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from odc.geo.geobox import GeoBox

from spectralzoom.flows.frame import Prior
from spectralzoom.flows.publish.scores import warnings_of
from spectralzoom.flows.settings.load import anchor_paths
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import BUILT_IN_SCENES, PART, WHOLE
from spectralzoom.pipeline.errors import IncompleteStoreError, SettingsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.ground.georeference import OFF_GRID_PX, shift_px
from spectralzoom.pipeline.simulator.scenes.laws import USUAL_DAY, USUAL_HOUR
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.words import moment_of
from spectralzoom.storage.arrays.class_maps import ProbabilityStore
from spectralzoom.storage.arrays.georeference import load_geobox
from spectralzoom.storage.runs import Run, dated, has_time, read_run
from spectralzoom.storage.store import Archive, run_stem

NONE, LATEST, AUTO = "none", "latest", "auto"
NEWEST_RUNS = 60  # newest runs of a field that are searched for the previous visit
PROBABILITIES = "class_probabilities"  # a product of runs
OF_THE_LIGHT = (  # settings that two runs of the same captured light share
    *("scene", "source", "seed", "size", "visit", "day", "hour", "effects", "pointing_px"),
    *("extent", "scan_step", "scan_exposure_ms", "budget", "policy"),
)


def find_prior(
    archive: Archive, settings: Settings, name: str, grid: SceneGrid, class_names: tuple[str, ...], scene: RasterScene
) -> tuple[Prior | None, tuple[str, ...]]:
    """Return the run of the prior map of a survey of ``name``, or None, and notes.

    It is the run with the last capture before this visit, among the newest runs of the field. The time of publication
    does not count. Raises SettingsError: the named run cannot be a prior map.
    """
    if settings.prior in (NONE, AUTO):
        return None, ()
    if settings.prior != LATEST:
        folder = archive.root / "runs" / Path(settings.prior).name
        why = "there is no such run in the archive"
        if folder.is_dir():
            found = _usable(archive, read_run(folder), settings, grid, class_names, scene)
            if isinstance(found, Prior):
                return found, ()
            why = found
        raise SettingsError(f"--prior {settings.prior}: {why}; give another run, latest or none")
    runs_by_reason: dict[str, list[str]] = {}
    for run in _before(archive, settings, name, scene):
        found = _usable(archive, run, settings, grid, class_names, scene)
        if isinstance(found, Prior):
            return found, (*_unusable(runs_by_reason), f"prior map: {run.folder.name}, {found.days:.3g} days earlier")
        runs_by_reason.setdefault(found, []).append(run.folder.name)
    why = "none of its earlier runs can be one" if runs_by_reason else "the archive has no earlier visit"
    return None, (*_unusable(runs_by_reason), f"{name} has no prior map: {why}")


def inherited_warning(prior: Prior | None, settings: Settings) -> tuple[str, ...]:
    """Return the warning that places of a partial scan keep a prior map which has a warning; or nothing."""
    if prior is None or not prior.warned or settings.extent == WHOLE:
        return ()
    shown = f"spectralzoom explain ARCHIVE {prior.run}"
    what = f"places that are not captured again keep the prior map {prior.run}, which has a warning"
    return (f"{what} ({shown}); --extent whole captures all",)


def _unusable(runs_by_reason: dict[str, list[str]]) -> tuple[str, ...]:
    """Return a note for each reason why runs cannot be the prior map."""
    return tuple(
        f"{runs[0]} cannot be the prior map: {why}" + (f"; {len(runs) - 1} more likewise" if len(runs) > 1 else "")
        for why, runs in runs_by_reason.items()
    )


def _before(archive: Archive, settings: Settings, name: str, scene: RasterScene) -> Iterator[Run]:
    """Return the newest runs of a field with class probabilities, the last captured before this visit first."""
    found: list[tuple[float, int, Run]] = []
    asked = anchor_paths(settings.to_dict(), Path.cwd())
    # The prior map may choose the extent: then the extent does not identify the light.
    chosen = ("extent", "scan_step", "scan_exposure_ms") if settings.extent == PART else ()
    light = [key for key in OF_THE_LIGHT if key not in chosen]
    for number, folder in enumerate(reversed(archive.runs())):
        if run_stem(name) not in folder.name:  # no receipt has to be read for that
            continue
        run = read_run(folder)
        if run.receipt.get("survey") == name and PROBABILITIES in run.products:
            if run.receipt.get("scene") == scene.key and all(run.settings.get(key) == asked[key] for key in light):
                continue  # made of the requested light itself: no earlier visit
            days = _days_since(run, dated(settings.visit, scene.acquired), settings.moment)
            if days >= 0 or run.in_future:  # which a note names
                found.append((days, number, run))
            if len(found) >= NEWEST_RUNS:
                break
    yield from (run for _, _, run in sorted(found, key=lambda one: one[:2]))


def _usable(
    archive: Archive, run: Run, settings: Settings, grid: SceneGrid, class_names: tuple[str, ...], scene: RasterScene
) -> Prior | str:
    """Return the run as a prior, or the reason why it cannot be one."""
    if run.problem is not None:
        return run.problem
    if run.in_future:
        return "it was published in the future; check the clock"
    places = [run.products.get(name, "").split("/") for name in (PROBABILITIES, "mosaic")]
    if any(len(parts) < 3 for parts in places):
        return "it left no class probabilities"
    try:
        probabilities, mosaic = (archive.find(parts[1], parts[2]) for parts in places)
        if probabilities is None or mosaic is None:
            return "its stores were cleared; reprocess computes them again"
        store = ProbabilityStore(probabilities.path / "class_probabilities.zarr")
        names = store.legend.names
        before = load_geobox(probabilities.path / "class_map.zarr")
    except IncompleteStoreError as error:
        return f"{error}"
    if (why := _off_grid(store.shape, before, grid, scene)) is not None:
        return f"it has another grid than this field: {why}"
    if any(run.settings["camera"][part] != getattr(settings.camera, part) for part in ("pitch_um", "focal_length_mm")):
        return "its camera has another pitch or focal length"
    classes = tuple(names.index(one) if one in names else -1 for one in class_names)
    if all(number < 0 for number in classes):
        return f"it has none of the classes of these weights, but {', '.join(names)}"
    days = _days_since(run, dated(settings.visit, scene.acquired), settings.moment)
    if days < 0:
        return f"it was captured {-days:.3g} days after this visit"
    day = None if settings.moment is None else float(settings.moment[0])
    if (called := moment_of(dated(settings.visit, scene.acquired))) is not None:
        day = float(called.timetuple().tm_yday)
    return Prior(run.folder.name, probabilities, mosaic, days, day, classes, bool(warnings_of(run.receipt)))


def _off_grid(shape: tuple[int, int], before: GeoBox | None, grid: SceneGrid, scene: RasterScene) -> str | None:
    """Return the difference of a map's grid from that of the field; None for the same grid."""
    if shape != (grid.height, grid.width):
        return f"{shape[1]} x {shape[0]} px and not {grid.width} x {grid.height}"
    if before is None or scene.geobox is None:
        return None
    shift = shift_px(scene.geobox, before) if before.crs == scene.geobox.crs else None
    if shift is None:
        return "another coordinate system, pixel size or direction"
    off = max(map(abs, shift))
    return f"its corner lies {off:.3g} px away" if off > OFF_GRID_PX else None


def _days_since(run: Run, acquired: str | None, moment: tuple[int, float] | None) -> float:
    """Return the days from a run's acquisition to another one; negative if that came first.

    The dates of both count, with their times if both have one. Else day and hour of a built-in scene count, else whole
    days, where an acquisition without a date is that of the survey.
    """
    then, now = map(moment_of, named := (run.acquired, acquired))
    if then is not None and now is not None and all(map(has_time, named)):
        return (now - then).total_seconds() / 86400
    if (then is None or now is None) and moment is not None and run.settings.get("scene") in BUILT_IN_SCENES:
        before = [run.settings.get("day"), run.settings.get("hour")]
        day, hour = (
            usual if given is None else float(given)
            for given, usual in zip(before, (USUAL_DAY, USUAL_HOUR), strict=True)
        )
        return moment[0] - day + (moment[1] - hour) / 24
    then, now = then or moment_of(run.created), now or datetime.now(UTC)
    return 0.0 if then is None else float((now.date() - then.date()).days)

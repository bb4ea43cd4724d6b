"""What `spectralzoom simulate` does and shows: one scan of a scene as raw cubes, and the manifest of its effects."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from flows.publish.effects_table import print_effects
from flows.settings.survey_settings import Settings
from flows.simulate.effect_comparison import Comparison, compare_with_everything
from flows.tasks.capture_plan import PassLayout
from flows.tasks.run import CaptureRun, make_source
from flows.tasks.scene import SimulatedField, farm_refusal, open_scene
from flows.tasks.stage import Stage, Wanted
from flows.tasks.stages.capture import capture_coarse
from flows.tasks.stages.effects import choose_effects, load_manifest
from flows.terminal.figures import format_bytes, format_seconds
from flows.terminal.processes import writing
from flows.terminal.progress import StageProgress
from models.network.machine import keep_freed_memory
from pipeline.errors import SceneError, SettingsError
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep
from pipeline.lazy import deferred
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.selection.choice import UNIT_NAMES
from storage.archive.keys import StageRef
from storage.readers.scene_files import load_scene_file
from storage.remote.opening import open_archive

if TYPE_CHECKING:
    import flows.simulate.effect_picture as effect_picture
else:
    effect_picture = deferred("flows.simulate.effect_picture")

TITLES = {"effects": "effects that matter", "capture": "scan", "comparison": "the same with everything on"}
PATCH, FACTOR = 16, 4  # of the weights that come with the house: scans are those of its surveys


@dataclass
class _Maker:
    """Finds stores or has them built, with progress, and remembers what building the last of them took."""

    run: CaptureRun
    progress: StageProgress
    spent: dict[str, float | None] = field(default_factory=dict)  # CPU seconds by stage; None where it was there

    def __call__(self, name: str, stage: Stage, wanted: Wanted) -> StageRef:
        began = time.process_time()
        self.progress.show(name, 0.0)
        ref, built = stage.produce(self.run.archive, wanted)
        self.spent[name] = time.process_time() - began if built else None
        self.progress.show(name, 1.0, "" if built else "cached", ended=True)
        return ref

    def watching(self, name: str) -> CaptureRun:
        return replace(self.run, report=lambda done: self.progress.show(name, done))


def run_simulate(
    settings: Settings, console: Console, *, coarse: bool = False, picture: Path | None = None
) -> dict[str, Any]:
    """Scan a scene into an archive, with progress on ``console``; give the record that --json prints.

    With a ``picture`` (PNG) the scan is held against one with everything on. Raises BoundError: what would be left out
    changes the worst part of the scene by more than its bound says; SettingsError, SceneError, ArchiveError: what was
    asked for cannot be.
    """
    if picture is not None:
        _check_picture(picture)
    keep_freed_memory()
    with console.status("opening the scene"):
        run, sweeps, notes = open_simulation(settings, coarse=coarse)
        # No other sweep is taken, so none has to be bounded and checked; who compares wants to see what was chosen.
        run = replace(run, planned=tuple(sweeps), weighs_small=picture is not None)
        run.archive.reclaim()  # what a killed scan left half made
    for note in notes:
        console.print(f"[dim]note: {escape(note)}[/]")
    with run.archive.in_use(), StageProgress(console, TITLES) as progress:
        make = _Maker(run, progress)
        wanted = choose_effects.wants(make.watching("effects"))
        effects = make("effects", choose_effects, _drawn_first(run.scene, wanted, make.spent))
        raw = make("capture", capture_coarse, run.recorder.wanted(sweeps, [effects], make.watching("capture").report))
        record = _record(run, sweeps, effects, raw, make.spent)
        found = None
        if picture is not None:

            def say(words: str) -> None:
                console.print(f"[dim]everything on, exact: {escape(words)}[/]")

            progress.show("comparison", 0.0)
            found = compare_with_everything(make.watching("comparison"), sweeps, effects, say)
            progress.show("comparison", 1.0, ended=True)
    _print(record, console)
    if picture is None or found is None:
        return record
    with writing(picture, "--compare"):
        effect_picture.draw_comparison(
            picture, found, effect_picture.Words(f"{Path(settings.scene).stem}, seed {settings.seed}", settings.effects)
        )
    _print_comparison(found, picture, console)
    return record | {"comparison": {**found.record(), "picture": str(picture)}}


def _drawn_first(scene: RasterScene, wanted: Wanted, spent: dict[str, float | None]) -> Wanted:
    """The same, which draws the scene before it chooses: what that takes is in every call, whatever is chosen."""
    spent["scene"] = None

    def build(path: Path) -> None:
        began = time.process_time()
        _ = scene.planes, scene.electrons
        spent["scene"] = time.process_time() - began
        wanted.build(path)

    return replace(wanted, build=build)


def _check_picture(path: Path) -> None:
    """Refuse what cannot be written before minutes are spent on it."""
    if path.suffix.lower() != ".png":
        raise SettingsError(f"--compare writes a PNG, got {path}; name a file that ends with .png")
    if path.is_dir():
        raise SettingsError(f"--compare {path} is a folder; name a file in it, such as {path / 'difference.png'}")
    with writing(path, "--compare"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()
    if not path.stat().st_size:
        path.unlink()


def open_simulation(settings: Settings, *, coarse: bool = False) -> tuple[CaptureRun, list[Sweep], tuple[str, ...]]:
    """Open scene and archive; give also the sweeps to take, and what was assumed of the scene. Draws nothing."""
    if settings.source != "sim":
        raise SettingsError(f"source = {settings.source!r}: a simulation is of the simulated rig; leave it out")
    refused = farm_refusal(settings)
    if refused is not None:
        raise SettingsError(refused)
    scene, notes = open_scene(settings)
    if scene.filled_px:  # a survey goes on without; a simulation would have to invent light
        file = load_scene_file(
            settings.scene, bands=settings.bands, wavelengths=settings.wavelengths, labels_needed=False
        )
        missing = ~np.isfinite(file.values)
        row, column, band = (int(one) for one in np.unravel_index(int(missing.argmax()), missing.shape))
        number = band if settings.bands is None else settings.bands[band]
        raise SceneError(
            f"{settings.scene} has no finite value at row {row}, column {column}, band {number} (pixels without:"
            f" {int(missing.any(axis=2).sum())}), and a simulation invents no light; fill or crop it, or choose other"
            " --bands"
        )
    _, coarse_pass, full = PassLayout.of(settings, SceneGrid(*scene.shape, PATCH, FACTOR)).sweeps()
    simulated = make_source(scene, settings)
    run = CaptureRun(
        settings=settings,
        archive=open_archive(settings.out),
        source=SimulatedField(simulated),
        simulated=simulated,
        scene=scene,
        planned=(*coarse_pass, *full),
    )
    return run, coarse_pass if coarse else full, notes


def _record(
    run: CaptureRun, sweeps: Sequence[Sweep], effects: StageRef, raw: StageRef, spent: Mapping[str, float | None]
) -> dict[str, Any]:
    manifest, camera = load_manifest(effects), run.camera
    lines, bands = sum(sweep.lines for sweep in sweeps), len(run.scene.wavelength_nm)
    px_bands = lines * camera.samples * bands
    took, chose, drew = spent["capture"], spent["effects"], spent["scene"]
    return {
        "scene": run.scene.key,
        "seed": run.settings.seed,
        "archive": run.archive.name,
        "store": raw.uri,
        "cubes": [f"{raw.uri}/{path.name}" for path in sorted(raw.path.glob("*.zarr"))],
        "cached": took is None,
        "sweeps": len(sweeps),
        "lines": lines,
        "px_bands": px_bands,
        "cpu_s": took,
        "px_bands_per_cpu_s": px_bands / took if took else None,
        "bytes_stored": run.archive.stored_bytes(raw),
        "scene_cpu_s": drew,
        "choice_cpu_s": None if chose is None or drew is None else chose - drew,
        "effects_store": effects.uri,
        "effects": manifest["effects"],
        "effects_total": manifest["total"],
        "path": str(raw.path),
    }


def _print(record: Mapping[str, Any], console: Console) -> None:
    print_effects(record["effects"], record["effects_total"], console)
    done = "already there" if record["cached"] else f"{format_seconds(record['cpu_s'])} of CPU"
    console.print(
        f"{record['lines']} lines in {record['sweeps']} sweeps: {done}, {format_bytes(record['bytes_stored'])} stored"
    )
    for name in record["cubes"]:
        console.print(f"  {escape(str(Path(record['path']) / Path(name).name))}", soft_wrap=True)


def _print_comparison(found: Comparison, picture: Path, console: Console) -> None:
    unit = UNIT_NAMES[found.unit]
    which = "all" if found.lines == found.of_lines else f"{found.lines} of the {found.of_lines}"
    bound = "there is no bound" if found.bound is None else f"the bound is {found.bound:.2g}"
    console.print(
        f"Everything on, exact, takes {format_seconds(found.exact_cpu_s)} of CPU for {which} lines, these effects"
        f" {format_seconds(found.cpu_s)}: {found.ratio:.1f} times less. Light differs by {found.measured:.2g} {unit}"
        f" at most ({bound})."
    )
    console.print(f"  {escape(str(picture))}", soft_wrap=True)

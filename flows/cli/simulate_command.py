"""The verb `simulate`: one scan of a scene as raw cubes, and the manifest of its effects."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.publish.receipt_table import print_effects
from spectralzoom.flows.settings.flags import NO_SIMULATION_FLAGS, AsJson, SimulationFlags, Switch, by_setting
from spectralzoom.flows.settings.load import load_settings
from spectralzoom.flows.settings.survey_settings import Settings
from spectralzoom.flows.tasks.capture_plan import PassLayout
from spectralzoom.flows.tasks.run import CaptureRun, make_source
from spectralzoom.flows.tasks.scene import SimulatedField, farm_refusal, open_scene
from spectralzoom.flows.tasks.stage import Stage, Wanted
from spectralzoom.flows.tasks.stages.capture import capture_coarse
from spectralzoom.flows.tasks.stages.effects import choose_effects, load_manifest
from spectralzoom.flows.terminal.figures import counted, format_bytes, format_seconds
from spectralzoom.flows.terminal.progress import StageProgress, print_json, stderr
from spectralzoom.models.network.machine import keep_freed_memory
from spectralzoom.pipeline.errors import SceneError, SettingsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.storage.store import Archive, Ref

TITLES = {"effects": "choice of effects", "capture": "scan"}
PATCH = 16  # of the shipped weights, so that scans are those of their surveys


def simulate(
    scene: str,
    *,
    out: Annotated[str, Parameter(name=("--out", "-o"))],
    coarse: Switch = False,
    settings: Path | None = None,
    flags: SimulationFlags = NO_SIMULATION_FLAGS,
    as_json: AsJson = False,
) -> int:
    """Simulate a full scan of SCENE, and list the effects that were simulated or omitted, with reasons.

    The same command resumes a stopped scan; a finished scan is not repeated.

    Parameters
    ----------
    scene
        `farm` or `scouting` (built in; `farm@2` names the version of its law), or an image or cube file: PNG, JPEG,
        BMP, GeoTIFF, .npy, .mat, ENVI, Zarr.
    out
        Folder of the archive for the raw cubes.
    coarse
        Simulate the coarse sweep instead: every fourth line.
    settings
        Settings file (TOML) with the tables [camera], [optics], [mirror], [detector], [air] and [sky]. Flags override
        it.
    """
    values = {"scene": scene, "out": out, "source": "sim", **by_setting(flags)}
    keep_freed_memory()
    with stderr.status("opening the scene"):
        run, sweeps, notes = open_simulation(load_settings(settings, values), coarse=coarse)
        run = replace(run, planned=tuple(sweeps))  # only these sweeps have to be bounded and checked
        run.archive.reclaim()  # parts that a killed scan left
    for note in notes:
        stderr.print(f"[dim]note: {escape(note)}[/]")
    with run.archive.in_use(), StageProgress(stderr, TITLES) as progress:

        def watching(name: str) -> CaptureRun:
            progress.show(name, 0.0)
            return replace(run, report=lambda done: progress.show(name, done))

        def made(name: str, stage: Stage, wanted: Wanted) -> tuple[Ref, bool]:
            ref, built = stage.produce(run.archive, wanted)
            progress.show(name, 1.0, "" if built else "cached", ended=True)
            return ref, built

        effects, _ = made("effects", choose_effects, choose_effects.wants(watching("effects")))
        began = time.process_time()
        wanted = run.recorder.wanted(sweeps, [effects], watching("capture").report)
        raw, built = made("capture", capture_coarse, wanted)
        record = _record(run, sweeps, effects, raw, time.process_time() - began if built else None)
    _print(record, stderr)
    if as_json:
        print_json(record)
    return 0


def open_simulation(settings: Settings, *, coarse: bool = False) -> tuple[CaptureRun, list[Sweep], tuple[str, ...]]:
    """Open scene and archive; return the run, its sweeps, and assumptions on the scene. Simulates nothing."""
    if settings.source != "sim":
        raise SettingsError(f"source = {settings.source!r} cannot be simulated; leave it out")
    if (refused := farm_refusal(settings)) is not None:
        raise SettingsError(refused)
    scene, notes = open_scene(settings)
    if scene.filled_px:  # a survey skips them; a simulation would have to invent radiance
        raise SceneError(
            f"{settings.scene} has {scene.filled_px} pixels without a finite value, and a simulation needs one "
            "everywhere; fill or crop it, or choose other --bands"
        )
    _, coarse_pass, full = PassLayout.of(settings, SceneGrid(*scene.shape, PATCH)).sweeps()
    simulated = make_source(scene, settings)
    run = CaptureRun(
        settings=settings,
        archive=Archive.open(settings.out),
        source=SimulatedField(simulated),
        simulated=simulated,
        scene=scene,
        planned=(*coarse_pass, *full),
    )
    return run, coarse_pass if coarse else full, notes


def _record(run: CaptureRun, sweeps: Sequence[Sweep], effects: Ref, raw: Ref, cpu_s: float | None) -> dict[str, Any]:
    manifest = load_manifest(effects)
    return {
        "scene": run.scene.key,
        "seed": run.settings.seed,
        "archive": run.archive.name,
        "store": raw.uri,
        "cubes": [f"{raw.uri}/{path.name}" for path in sorted(raw.path.glob("*.zarr"))],
        "cached": cpu_s is None,
        "sweeps": len(sweeps),
        "lines": (lines := sum(sweep.lines for sweep in sweeps)),
        "px_bands": lines * run.camera.samples * len(run.scene.wavelength_nm),
        "cpu_s": cpu_s,
        "bytes_stored": run.archive.stored_bytes(raw),
        "effects_store": effects.uri,
        "effects": manifest["effects"],
        "effects_total": manifest["total"],
        "path": str(raw.path),
    }


def _print(record: Mapping[str, Any], console: Console) -> None:
    print_effects(record["effects"], record["effects_total"], console)
    done = "already there" if record["cached"] else f"{format_seconds(record['cpu_s'])} of CPU"
    console.print(
        f"{counted(record['lines'], 'line')} in {counted(record['sweeps'], 'sweep')}: {done}, "
        f"{format_bytes(record['bytes_stored'])} stored"
    )
    for name in record["cubes"]:
        console.print(f"  {escape(str(Path(record['path']) / Path(name).name))}", soft_wrap=True)

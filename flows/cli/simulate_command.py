"""The verb `simulate`: one scan of a scene as raw cubes, and the manifest of its effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.field import view_of
from spectralzoom.flows.observer import tidy_up
from spectralzoom.flows.opening.open_field import make_source
from spectralzoom.flows.opening.scene import darkness, farm_refusal, open_scene
from spectralzoom.flows.planning.capture_plan import PassLayout
from spectralzoom.flows.planning.plan_survey import pool_of
from spectralzoom.flows.publish.receipt_table import print_effects
from spectralzoom.flows.settings.flags import NO_SIMULATION_FLAGS, AsJson, SimulationFlags, Switch, by_setting
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.stage import Stores
from spectralzoom.flows.stages.capture import SAVED_S, SweepRequest, capture_coarse
from spectralzoom.flows.stages.effects import choose_effects, load_manifest
from spectralzoom.flows.terminal.figures import counted, format_bytes, format_seconds
from spectralzoom.flows.terminal.progress import StageProgress, print_json, stderr
from spectralzoom.models.network.machine import keep_freed_memory
from spectralzoom.pipeline.errors import SceneError, SettingsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.storage.store import Archive, Ref, listed_bytes, read_manifest

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
        asked = load_settings(settings, values)
        field, notes = open_simulation(asked)
        _, coarse_pass, full = PassLayout.of(asked, SceneGrid(*field.shape, PATCH)).sweeps()
        sweeps = coarse_pass if coarse else full
        archive = Archive.open(asked.out)
        archive.reclaim()  # parts that a killed scan left
    for note in notes:
        stderr.print(f"[dim]note: {escape(note)}[/]")
    with archive.in_use(), StageProgress(stderr) as progress:
        stores = Stores(archive, watch=progress.watch, finish=tidy_up)
        effects, raw = scan(stores, asked, field, sweeps)
    record = _record(stores, asked, field, sweeps, effects, raw)
    _print(record, stderr)
    if as_json:
        print_json(record)
    return 0


def open_simulation(settings: Settings) -> tuple[RasterScene, tuple[str, ...]]:
    """Open the scene of a simulation; return it with notes on assumptions. Simulates nothing.

    Raises SettingsError, SceneError: it cannot be simulated.
    """
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
    return scene, (*darkness(settings), *notes)


def scan(stores: Stores, settings: Settings, scene: RasterScene, sweeps: Sequence[Sweep]) -> tuple[Ref, Ref]:
    """Choose the effects for these sweeps alone, and capture them; return both stores."""
    source = make_source(scene, settings)
    effects = choose_effects(
        stores,
        scene=scene,
        rig=settings.simulated_rig,
        sweeps=sweeps,
        cost=settings.cost,
        asked=settings.effects,
        tol=settings.tol,
    )
    raw = capture_coarse(
        stores,
        effects,
        request=SweepRequest.of(sweeps, settings.camera, settings.cost),
        view=view_of(settings, scene, source),
        source=source,
        pool=pool_of(settings),
    )
    return effects, raw


def _record(
    stores: Stores, settings: Settings, scene: RasterScene, sweeps: Sequence[Sweep], effects: Ref, raw: Ref
) -> dict[str, Any]:
    manifest = load_manifest(effects)
    row = stores.rows[capture_coarse.name]
    return {
        "scene": scene.key,
        "seed": settings.seed,
        "archive": stores.archive.name,
        "store": raw.uri,
        "cubes": [f"{raw.uri}/{path.name}" for path in sorted(raw.path.glob("*.zarr"))],
        "cached": row.state == "cached",
        "sweeps": len(sweeps),
        "lines": (lines := sum(sweep.lines for sweep in sweeps)),
        "px_bands": lines * settings.camera.samples * len(scene.wavelength_nm),
        "cpu_s": row.cpu_s,
        "bytes_stored": listed_bytes(read_manifest(raw.path)),
        "effects_store": effects.uri,
        "effects": manifest["effects"],
        "effects_total": {**manifest["total"], SAVED_S: stores.total(SAVED_S)},
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

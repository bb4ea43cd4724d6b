"""The stages of a survey: references in, one published store out. Arrays stay inside a stage.

Each stage names its version (raise it when what it writes changes), the parameters it uses and the stores it reads;
the archive makes the key of them, finds the store if it is there, and has it built if it is not.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.survey.effect_choice import load_manifest, source_with
from flows.survey.field_work import FieldWork, region_params
from flows.survey.region_work import look_at, seat_columns
from flows.survey.rendered_lines import lines_again, take_lines
from flows.survey.rig_run import RIG_RECORD, capture_source, held_lines, rig_record
from flows.survey.run import CaptureRun, SurveyRun
from models.policies.policies import IMAGE_POLICIES, SEEDED_POLICIES, SEEING_POLICIES, score_seats
from models.reading.inference import CoarseLook, Glance, read_glance
from models.reading.regions import whole_field
from pipeline.geometry.scan import Sweep
from pipeline.planning.fine_pass import FinePlan, plan_fine
from pipeline.simulator.simulated import sweep_starts
from pipeline.source import Line, Source
from storage.archive.archive import StageRef, stage_key
from storage.archive.stored_tables import read_table
from storage.arrays.attention import Attention, write_attention
from storage.arrays.class_maps import ClassNames, clear_classes, create_class_map
from storage.arrays.cubes import RawCube, RawCubeWriter, SweepHeader, open_raw_cube
from storage.arrays.patches import open_patches
from storage.arrays.spool import Spool

VERSIONS = {
    "effects": 2, "capture": 4, "register": 2, "locate": 2, "rectify": 3, "attend": 7, "patches": 3, "segment": 5,
    "turned": 1, "ground": 2, "evaluate": 7,
}  # fmt: skip
SEATS_AT_ONCE = 64
STRANGE = "strange.json"  # beside a map, where values were no readings

Build = Callable[[Path], None]
Produce = Callable[[str, Build, dict[str, Any], Sequence[StageRef]], StageRef]


def capture_coarse(run: SurveyRun, produce: Produce, effects: StageRef) -> StageRef:
    """Sweep the whole field once, fast."""
    return capture_sweeps(run, produce, run.plan.coarse, [effects])


def capture_fine(run: SurveyRun, produce: Produce, attention: StageRef, effects: StageRef) -> StageRef:
    """Go back for the places that the plan chose."""
    return capture_sweeps(run, produce, load_plan(attention).sweeps, [attention, effects], begins_s=run.plan.coarse_s)


def capture_sweeps(
    run: CaptureRun, produce: Produce, sweeps: list[Sweep], inputs: list[StageRef], *, begins_s: float = 0.0
) -> StageRef:
    """Take some sweeps, one after the other from ``begins_s`` on, with the effects of the last of the inputs."""
    clock = sweep_starts(sweeps, run.camera, run.settings.cost, after_s=begins_s)
    params = {**run.source_key(), "sweeps": [asdict(sweep) for sweep in sweeps], "starts_s": list(clock.values())}
    key = stage_key("capture", VERSIONS["capture"], params, [ref.key for ref in inputs])
    total = sum(sweep.lines for sweep in sweeps) or 1

    def build(path: Path) -> None:
        """Take the sweeps one after the other, each into a cube of its own."""
        before, manifest = 0, load_manifest(inputs[-1])
        lit = replace(run, source=source_with(run.source, inputs[-1], clock))
        with capture_source(lit, key) as source:
            for sweep in sweeps:
                done = partial(_report_lines, run, before / total, total)
                _capture_sweep(lit, source, sweep, path, key=key, report=done, effects=manifest)
                before += sweep.lines
            if run.rig is not None:
                write_json(path / RIG_RECORD, rig_record(source))

    ref = produce("capture", build, params, inputs)
    run.archive.drop_spool(key)
    return ref


def _report_lines(run: CaptureRun, before: float, total: int, lines: int) -> None:
    run.report(before + lines / total)


def _capture_sweep(
    run: CaptureRun, source: Source, sweep: Sweep, path: Path, *, key: str, report: Callable[[int], None],
    effects: Mapping[str, Any],
) -> None:  # fmt: skip
    """Lines into the spool and then the cube, one by one, from where a broken capture stopped.

    Lines that were lost since are asked for again; a rig captures nothing for them, and what it cannot give is invalid.
    """
    references = source.references(sweep)
    simulation = None if run.rig else effects
    header = SweepHeader(
        sweep, references, run.scene.wavelength_nm, run.scene.fwhm_nm, source.name, simulation=simulation
    )
    samples, bands = references.dark.shape
    about = {"sweep": asdict(sweep), **run.source_key()}
    folder = run.archive.spool_folder(key)
    with (
        Spool.open(folder, samples, bands, header=about, name=sweep.name) as spool,
        RawCubeWriter(path / f"{sweep.name}.zarr", header) as cube,
    ):

        def take(line: Line) -> None:
            spool.append(line)
            cube.write([line])
            report(spool.count)

        again = lines_again if run.rig is None else held_lines
        spool.mend(again(source, sweep, spool.lost))
        for block in spool.blocks():
            cube.write(block)
        report(spool.count)
        take_lines(source, sweep, take, run.settings.crew, first=spool.count)


def captured(ref: StageRef) -> list[RawCube]:
    """Open the sweeps of a capture, in the order of their names."""
    return [open_raw_cube(path) for path in sorted(ref.path.glob("*.zarr"))]


def glance_at(run: SurveyRun, mosaic: StageRef) -> Glance:
    """What the model says of a stored coarse mosaic alone, the whole field at once: for those that hold it anyway."""
    return read_glance(run.weights, look_at(run.weights, mosaic.path / "mosaic.zarr", whole_field(run.grid)))


def attend(run: SurveyRun, produce: Produce, mosaic: StageRef) -> StageRef:
    """Score every seat by the coarse mosaic, and plan the sweeps that show the most score in the time left."""
    settings = run.settings

    def build(path: Path) -> None:
        """Score the seats, and refuse a plan whose map would not fit the memory."""
        work = FieldWork.of(run)
        scores = _scores(run, work, mosaic)
        plan = plan_fine(
            run.grid,
            run.camera,
            settings.cost,
            run.plan.along,
            scores,
            budget_s=run.plan.fine_s,
            margin_px=run.plan.margin_px,
            full=run.plan.full,
            threshold=settings.threshold,
        )
        work.check_memory(plan.seats, len(run.scene.wavelength_nm))  # before the rig goes back, not after
        rank = np.full(scores.shape, -1, np.int32)
        rank[plan.seats[np.argsort(-scores[plan.seats], kind="stable")]] = np.arange(len(plan.seats))
        shape = run.grid.seat_shape
        write_attention(path / "attention.zarr", Attention(scores.reshape(shape), rank.reshape(shape), settings.policy))
        write_plan(path, plan)

    params = {
        "weights": run.weights_key,
        "grid": asdict(run.grid),
        "policy": settings.policy,
        "seed": settings.seed if settings.policy in SEEDED_POLICIES else None,
        "mask": None if run.mask is None else digest(run.mask),
        "fine_s": run.plan.fine_s,
        "overlap_px": run.plan.overlap_px,
        "margin_px": run.plan.margin_px,
        "along": run.plan.along,
        "camera": asdict(run.camera),
        "cost": asdict(settings.cost),
        **(region_params(run.grid) if settings.policy in SEEING_POLICIES else {}),
        **({} if run.vgg is None else {"vgg": run.vgg.key}),
        **({} if settings.threshold is None else {"threshold": settings.threshold}),
    }
    return produce("attend", build, params, [mosaic])


def _scores(run: SurveyRun, work: FieldWork, mosaic: StageRef) -> NDArray[np.float64]:
    """(seat,) worth of a fine look at each seat of the padded grid."""
    policy = run.settings.policy
    if policy in SEEING_POLICIES + IMAGE_POLICIES:
        return work.score(policy, mosaic.path / "mosaic.zarr", lambda done: run.report(0.5 * done)).ravel()
    nothing = np.empty((0, 0, 0), np.float32)
    return score_seats(policy, Glance(run.grid, nothing, nothing), seed=run.settings.seed, mask=run.mask)


def write_plan(folder: Path, plan: FinePlan) -> None:
    """Write the plan of an attention store; of a threshold only where there was one."""
    content = asdict(plan) | {"seats": plan.seats.tolist()}
    absent = [name for name in ("threshold", "spared_s") if content[name] is None]
    write_json(folder / "plan.json", {name: value for name, value in content.items() if name not in absent})


def load_plan(attention: StageRef) -> FinePlan:
    """Read the plan of an attention store."""
    plan = read_table(attention.path / "plan.json")
    kept = {"sweeps": [Sweep(**sweep) for sweep in plan["sweeps"]], "seats": np.array(plan["seats"], np.intp)}
    return FinePlan(**(plan | kept))


def patch_columns(run: SurveyRun, patches: StageRef, seen: CoarseLook) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Seats of the whole field and their normalised spectral columns, (seat, p, p, column); see ``seat_columns``."""
    store = open_patches(patches.path / "patches.zarr")
    return seat_columns(run.weights, store, run.scene.wavelength_nm, seen, whole_field(run.grid))


def draw_map(run: SurveyRun, produce: Produce, mosaic: StageRef, patches: StageRef) -> StageRef:
    """Read coarse and fine patches together and draw the class map, one region of the field after the other.

    Where the scene has no value the map has no class.
    """

    def build(path: Path) -> None:
        out, legend = path / "class_map.zarr", ClassNames(run.weights.class_names, run.weights.class_colours)
        create_class_map(out, (run.grid.height, run.grid.width), legend, grid=run.angular_grid())
        strange = FieldWork.of(run).draw(mosaic.path / "mosaic.zarr", patches.path / "patches.zarr", out, run.report)
        if any(strange):
            write_json(path / STRANGE, dict(zip(("coarse_px", "fine_px"), strange, strict=True)))
        if run.scene.missing is not None:
            clear_classes(out, run.scene.missing)

    params = {
        "weights": run.weights_key,
        "grid": asdict(run.grid),
        **region_params(run.grid),
        **({} if run.scene.missing is None else {"missing": digest(run.scene.missing)}),
    }
    return produce("segment", build, params, [mosaic, patches])


def strange_pixels(class_map: StageRef) -> dict[str, int]:
    """Coarse and fine pixels that were left out of a map, as no sensor gives their values; empty without any."""
    path = class_map.path / STRANGE
    return dict(read_table(path)) if path.is_file() else {}


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write plain values in their own order; numpy's numbers become floats."""
    path.write_text(json.dumps(content, indent=1, default=float) + "\n")


def digest(array: NDArray[np.generic]) -> str:
    """Hash of an array's shape and values, for stage keys."""
    return hashlib.sha256(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes()).hexdigest()[:20]

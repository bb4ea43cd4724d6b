"""Reading a field region by region: what the seams change for each halo, and what memory it takes.

``PYTHONPATH=. python tests/benchmarks/bench_regions.py`` prints the table of halos by seed.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import shutil
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measure import Row
from numpy.typing import NDArray
from paper_scale import peak_bytes
from rich.console import Console

from flows.field_work import SHARD, FieldWork
from flows.region_work import WeightsFile
from flows.run import SurveyRun, open_run
from flows.settings import load_settings
from flows.survey_command import run_survey
from models.metrics import confusion, mean_iou
from models.process import use_one_thread
from models.regions import HALO_CELLS, Region, most_bytes, plan_regions
from pipeline.grid import SceneGrid
from pipeline.selection import frame_seats
from storage.block_work import Crew
from storage.class_maps import ClassNames, create_class_map, load_class_map
from storage.mosaics import MosaicWriter
from storage.patches import PATCHES_A_SHARD, PatchWriter, open_patches
from storage.tile_work import RESERVED_BYTES

SEEDS, HALOS = (1, 2, 3), (0, 1, 2, 4)
MOST_PX = (512, 640)  # of 1024 x 1280 px: four regions
SHARE = 0.35
SIDES, SYNTHETIC_PX, SYNTHETIC_BANDS = (640, 1920, 3840), (640, 640), 8
MEMORY = 4 * 2**30
MOST_GROWTH = 1.25


@dataclass(frozen=True)
class Seams:
    """How the map in regions differs from the map of one region."""

    halo: int
    all_px: float  # share of pixels of the same class
    near_px: float  # the same within one coarse patch of a seam
    miou: float  # by the labels
    seats: float  # share of the chosen seats that both choose
    extra: float  # pixels read over pixels kept


def rows() -> list[Row]:
    """The halo in use against none, and memory as the field grows."""
    table = measure_halos()
    found = [
        Row(
            f"class map in 2 x 2 regions against one, halo of {halo} coarse patches: same class",
            f"{np.mean([one[halo].all_px for one in table]):.3%}",
            ">= 99.9 %" if halo == HALO_CELLS else "",
            np.mean([one[halo].all_px for one in table]) >= 0.999 if halo == HALO_CELLS else None,
            f"within a patch of a seam {np.mean([one[halo].near_px for one in table]):.3%}; mIoU "
            f"{np.mean([one[halo].miou - one[-1].miou for one in table]):+.4f}; seats in common "
            f"{np.mean([one[halo].seats for one in table]):.1%}",
        )
        for halo in HALOS
    ]
    return [*found, *_memory()]


def measure_halos() -> list[dict[int, Seams]]:
    """By seed and halo; -1 is the field as one region."""
    with tempfile.TemporaryDirectory() as name:
        return [_survey(Path(name), seed) for seed in SEEDS]


def _survey(folder: Path, seed: int) -> dict[int, Seams]:
    """Survey a farm once, and draw it in regions with each halo."""
    flags = {"scene": "farm", "seed": seed, "out": str(folder / str(seed)), "engine": "plain", "controls": False}
    settings = load_settings(None, flags)
    published = run_survey(settings, Console(quiet=True))
    run, stages = open_run(settings), {stage["name"]: stage["key"] for stage in published.receipt["stages"]}
    archive = folder / str(seed) / "stages"
    mosaic = archive / "rectify" / stages["rectify"] / "mosaic.zarr"
    patches = archive / "patches" / stages["cut_patches"] / "patches.zarr"
    drawn = {halo: _read(run, mosaic, patches, halo) for halo in (-1, *HALOS)}
    return {halo: _compared(run, drawn, halo) for halo in drawn}


Read = tuple[list[Region], NDArray[np.uint8], NDArray[np.float64]]


def _read(run: SurveyRun, mosaic: Path, patches: Path, halo: int) -> Read:
    """Regions, class map and scores for one halo, -1 for the field as one region."""
    whole = FieldWork.of(run)
    regions = whole.regions if halo < 0 else plan_regions(run.grid, SHARD, most_px=MOST_PX, halo=halo)
    work = FieldWork(whole.weights, regions, Crew(workers=1), MEMORY)
    out = mosaic.parents[3] / f"halo{halo}.zarr"
    legend = ClassNames(run.weights.class_names, run.weights.class_colours)
    create_class_map(out, (run.grid.height, run.grid.width), legend)
    work.draw(mosaic, patches, out, lambda done: None)
    return list(regions), load_class_map(out).classes, work.score("entropy", mosaic, lambda done: None)


def _compared(run: SurveyRun, drawn: dict[int, Read], halo: int) -> Seams:
    (regions, classes, scores), (_, whole, whole_scores) = drawn[halo], drawn[-1]
    same = classes == whole
    near = _near_seams(regions, run.grid.patch * run.grid.factor)
    assert run.labels is not None
    chosen, before = (
        frame_seats(each.ravel(), SHARE, run.grid.valid_share().ravel() > 0).seats for each in (scores, whole_scores)
    )
    return Seams(
        halo,
        float(same.mean()),
        float(same[near].mean()) if near.any() else 1.0,
        mean_iou(confusion(run.labels, classes, run.weights.config.classes)),
        len(np.intersect1d(chosen, before)) / len(before),
        sum(float(np.prod(region.read.shape)) for region in regions) / same.size,
    )


def _near_seams(regions: list[Region], reach: int) -> NDArray[np.bool_]:
    """Pixels within ``reach`` of a seam between regions."""
    height, width = regions[0].field.height, regions[0].field.width
    near = np.zeros((height, width), np.bool_)
    for seam in {region.kept.top for region in regions} - {0}:
        near[max(seam - reach, 0) : seam + reach] = True
    for seam in {region.kept.left for region in regions} - {0}:
        near[:, max(seam - reach, 0) : seam + reach] = True
    return near


def _memory() -> list[Row]:
    """Peak memory of drawing fields of 1, 9 and 36 regions, and of the middle one as one region."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for side in SIDES:
            _write_field(folder / str(side), side)
        peaks = [_alone(folder / str(side), side, True) for side in SIDES]
        whole = _alone(folder / str(SIDES[1]), SIDES[1], False)
    counts = [(side // SYNTHETIC_PX[0]) ** 2 for side in SIDES]
    growth = peaks[2][0] / peaks[1][0]
    over = max(peak / projected for peak, projected in [*peaks, whole])
    told = ", ".join(f"{count}: {_mib(peak)}" for count, (peak, _) in zip(counts, peaks, strict=True))
    return [
        Row(
            f"peak memory of a map in {counts[2]} regions against one in {counts[1]}",
            f"{growth:.2f}",
            f"<= {MOST_GROWTH}",
            growth <= MOST_GROWTH,
            f"regions of {SYNTHETIC_PX[0]} px, one worker: {told}; nine regions read as one: {_mib(whole[0])}",
        ),
        Row(
            "the same over what is projected, at most",
            f"{over:.2f}",
            "<= 1",
            over <= 1,
            f"projected {', '.join(_mib(projected) for _, projected in peaks)}; as one {_mib(whole[1])}",
        ),
    ]


def _mib(size: float) -> str:
    return f"{size / 2**20:.0f} MiB"


def _alone(folder: Path, side: int, cut: bool) -> tuple[int, int]:
    """Draw in a process of its own; its highest memory, and the one projected [bytes]."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_draw_field, folder, side, cut).result()


def _write_field(folder: Path, side: int) -> None:
    """Store a random coarse mosaic and patches at 35 % of the seats."""
    grid, rng = SceneGrid(side, side, 16, 4), np.random.default_rng(0)
    nm = np.linspace(420, 980, SYNTHETIC_BANDS)
    writer = MosaicWriter(folder / "mosaic.zarr", grid.coarse_shape, nm)
    writer.write_rows(0, rng.uniform(0.1, 0.5, (*grid.coarse_shape, len(nm))), np.ones(grid.coarse_shape))
    count = int(np.prod(grid.seat_shape))
    seats = np.sort(rng.choice(count, int(SHARE * count), replace=False))
    patches = PatchWriter(folder / "patches.zarr", seats, grid.seat_origin(seats), grid.patch, nm)
    for first in range(0, len(seats), PATCHES_A_SHARD):
        shape = (min(PATCHES_A_SHARD, len(seats) - first), grid.patch, grid.patch)
        patches.write(first, rng.uniform(0.1, 0.5, (*shape, len(nm))).astype(np.float32), np.ones(shape, np.bool_))


def _draw_field(folder: Path, side: int, cut: bool) -> tuple[int, int]:
    """Draw a stored field with the shipped weights, one worker; memory of this process, and what was projected."""
    use_one_thread()
    path = Path(__file__).resolve().parents[2] / "models" / "shipped" / "farm.safetensors"
    file = WeightsFile(path, hashlib.sha256(path.read_bytes()).hexdigest()[:20])
    grid = SceneGrid(side, side, 16, 4)
    regions = plan_regions(grid, SHARD, most_px=SYNTHETIC_PX) if cut else plan_regions(grid, SHARD)
    weights, out = file.load(), folder / "map.zarr"
    shutil.rmtree(out, ignore_errors=True)
    create_class_map(out, (side, side), ClassNames(weights.class_names, weights.class_colours))
    work = FieldWork(file, regions, Crew(workers=1), MEMORY)
    work.draw(folder / "mosaic.zarr", folder / "patches.zarr", out, lambda done: None)
    seats = open_patches(folder / "patches.zarr").seats
    return peak_bytes(), RESERVED_BYTES + most_bytes(weights.config, regions, seats, SYNTHETIC_BANDS)


def main() -> None:
    """Print the table of halos by seed."""
    print("seed  halo  same class  near seams    mIoU   seats in common  read/kept")
    for seed, by_halo in zip(SEEDS, measure_halos(), strict=True):
        for halo, one in by_halo.items():
            print(
                f"{seed:4}  {'one' if halo < 0 else halo:>4}  {one.all_px:10.3%}  {one.near_px:10.3%}  {one.miou:.4f}"
                f"  {one.seats:15.2%}  {one.extra:9.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()

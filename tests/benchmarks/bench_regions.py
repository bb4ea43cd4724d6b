"""Reading a field region by region: what the seams change for each halo, and what memory it takes.

``PYTHONPATH=. python tests/benchmarks/bench_regions.py`` prints the table of halos by seed.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import shutil
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measure import Row, peak_bytes
from numpy.typing import NDArray
from rich.console import Console

from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from flows.tasks.field_work import FieldWork, WeightsFile
from flows.tasks.reading_costs import SHARD
from flows.tasks.run import SurveyRun, open_run
from models.evaluation.metrics import confusion, mean_iou
from models.network.machine import use_one_thread
from models.reading.regions import HALO_CELLS, Region, most_bytes, plan_regions
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.selection import frame_patches
from pipeline.simulator.scenes.farm.spectra import MATERIALS, spectral_library
from storage.arrays.class_maps import ClassMap, ClassNames, create_class_map, load_class_map
from storage.arrays.layout import SHARD_ROWS
from storage.arrays.mosaics import PATCHES_A_SHARD, MosaicWriter, PatchWriter, open_patches
from storage.parallel.pool import RESERVED_BYTES, WorkerPool

SEEDS, HALOS = (1, 2, 3), (0, 1, 2, 4)
MOST_PX = (512, 640)  # of 1024 x 1280 px: four regions
FRACTION = 0.35
SIDES, SYNTHETIC_PX, SYNTHETIC_BANDS = (640, 1920, 3840), (640, 640), 8
MEMORY = 4 * 2**30
MOST_GROWTH = 1.25
MOSAIC_PX, MOSAIC_BANDS, MOSAIC_FRACTION = 10240, 4, 0.02
BLOBS, BLOB_PX = 400, 24.0  # of the coarse mosaic, maize on bare soil


@dataclass(frozen=True)
class Seams:
    """How the map in regions differs from the map of one region."""

    halo: int
    all_px: float  # fraction of pixels of the same class
    near_px: float  # the same within one coarse patch of a seam
    far_px: float  # fraction of pixels of the same class further than that from every seam
    step: float  # mean step of confidence across a seam, over the same step in the map of one region
    miou: float  # by the labels
    patch_index: float  # fraction of the chosen patches that both choose
    extra: float  # pixels read over pixels kept


def rows() -> list[Row]:
    """The halo in use against none, and memory as the field grows."""
    table = measure_halos()
    found = [
        Row(
            f"class map in 2 x 2 regions against one, halo of {halo} coarse patches: same class",
            f"{np.mean([one[halo].all_px for one in table]):.3%}",
            ">= 99.9 %" if halo == HALO_CELLS else "",
            bool(np.mean([one[halo].all_px for one in table]) >= 0.999) if halo == HALO_CELLS else None,
            f"within a patch of a seam {np.mean([one[halo].near_px for one in table]):.3%}, further away "
            f"{np.mean([one[halo].far_px for one in table]):.3%}; step of confidence across a seam over the same "
            f"without it {np.mean([one[halo].step for one in table]):.3f}; mIoU "
            f"{np.mean([one[halo].miou - one[-1].miou for one in table]):+.4f}; patches in common "
            f"{np.mean([one[halo].patch_index for one in table]):.1%}",
        )
        for halo in HALOS
    ]
    return [*found, *_memory(), *_mosaic()]


def measure_halos() -> list[dict[int, Seams]]:
    """By seed and halo; -1 is the field as one region."""
    with tempfile.TemporaryDirectory() as name:
        return [_survey(Path(name), seed) for seed in SEEDS]


def _survey(folder: Path, seed: int) -> dict[int, Seams]:
    flags = {"scene": "farm", "seed": seed, "out": str(folder / str(seed)), "engine": "plain", "controls": False}
    settings = load_settings(None, flags)
    published = run_survey(settings, Console(quiet=True))
    run, stages = open_run(settings), {stage["name"]: stage["key"] for stage in published.receipt["stages"]}
    archive = folder / str(seed) / "stages"
    mosaic = archive / "rectify" / stages["rectify"] / "mosaic.zarr"
    patches = archive / "patches" / stages["extract_patches"] / "patches.zarr"
    drawn = {halo: _read(run, mosaic, patches, halo) for halo in (-1, *HALOS)}
    return {halo: _compared(run, drawn, halo) for halo in drawn}


Read = tuple[list[Region], ClassMap, NDArray[np.float64]]


def _read(run: SurveyRun, mosaic: Path, patches: Path, halo: int) -> Read:
    """Regions, maps and scores for one halo, -1 for the field as one region."""
    whole = run.work
    regions = whole.regions if halo < 0 else plan_regions(run.grid, SHARD, most_px=MOST_PX, halo=halo)
    work = FieldWork(whole.weights, regions, WorkerPool(workers=1), MEMORY)
    out = mosaic.parents[3] / f"halo{halo}.zarr"
    legend = ClassNames(run.weights.class_names, run.weights.class_colours)
    create_class_map(out, (run.grid.height, run.grid.width), legend)
    work.draw(mosaic, patches, out, lambda done: None)
    return list(regions), load_class_map(out), work.score("entropy", mosaic, lambda done: None)


def _compared(run: SurveyRun, drawn: dict[int, Read], halo: int) -> Seams:
    (regions, cut, scores), (_, whole, whole_scores) = drawn[halo], drawn[-1]
    same = cut.classes == whole.classes
    near = _near_seams(regions, run.grid.patch * run.grid.factor)
    assert run.labels is not None
    chosen, before = (
        frame_patches(each.ravel(), FRACTION, run.grid.valid_fraction().ravel() > 0).patch_index
        for each in (scores, whole_scores)
    )
    return Seams(
        halo,
        float(same.mean()),
        float(same[near].mean()) if near.any() else 1.0,
        float(same[~near].mean()),
        _step(regions, cut.confidence) / _step(regions, whole.confidence) if near.any() else 1.0,
        mean_iou(confusion(run.labels, cut.classes, run.weights.config.classes)),
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


def _step(regions: list[Region], confidence: NDArray[np.float32]) -> float:
    """Mean difference of neighbouring pixels on either side of the borders of regions."""
    exact = confidence.astype(np.float64)
    steps = [np.abs(exact[seam] - exact[seam - 1]) for seam in {region.kept.top for region in regions} - {0}]
    steps += [np.abs(exact[:, seam] - exact[:, seam - 1]) for seam in {region.kept.left for region in regions} - {0}]
    return float(np.concatenate(steps).mean())


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


def _mosaic() -> list[Row]:
    """A field of the paper's size with little in it: one budget over all its regions, each read with its halo."""
    with (
        tempfile.TemporaryDirectory() as name,
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool,
    ):
        peak, regions, patch_index, hit, cpu_s = pool.submit(_read_mosaic, Path(name)).result()
    return [
        Row(
            f"peak memory of scoring and drawing {MOSAIC_PX} x {MOSAIC_PX} px, {MOSAIC_BANDS} bands, sparse content",
            f"{peak / 2**30:.2f} GiB",
            f"<= {MEMORY / 2**30:g} GiB",
            peak <= MEMORY,
            f"{regions} regions with their halos, one worker; {patch_index} patches by one budget over all of them, {hit:.0%} "
            f"of them on content; CPU {cpu_s:.0f} s",
        )
    ]


def _read_mosaic(folder: Path) -> tuple[int, int, int, float, float]:
    """Peak memory, regions, patches, the fraction of them that hold content, and processor time, writing included."""
    use_one_thread()
    file = _shipped()
    weights = file.load()
    config = weights.config
    grid = SceneGrid(MOSAIC_PX, MOSAIC_PX, config.patch, config.factor)
    content = _write_sparse(folder / "mosaic.zarr", grid)
    work = FieldWork(file, plan_regions(grid, SHARD), WorkerPool(workers=1), MEMORY)
    began = time.process_time()
    scores = work.score("sobel", folder / "mosaic.zarr", lambda done: None)
    patch_index = np.sort(frame_patches(scores.ravel(), MOSAIC_FRACTION, grid.valid_fraction().ravel() > 0).patch_index)
    _write_patches(folder / "patches.zarr", grid, patch_index, spectral_library(MOSAIC_BANDS).wavelength_nm)
    legend = ClassNames(weights.class_names, weights.class_colours)
    create_class_map(folder / "map.zarr", (MOSAIC_PX, MOSAIC_PX), legend)
    work.draw(folder / "mosaic.zarr", folder / "patches.zarr", folder / "map.zarr", lambda done: None)
    cells = config.patch // config.factor
    held = content.reshape(grid.patch_shape[0], cells, grid.patch_shape[1], cells).any(axis=(1, 3)).ravel()
    return (
        peak_bytes(),
        len(work.regions),
        len(patch_index),
        float(held[patch_index].mean()),
        time.process_time() - began,
    )


def _write_sparse(path: Path, grid: SceneGrid) -> NDArray[np.bool_]:
    """Store a coarse mosaic of clumps of maize on bare soil, some rows at a time; which pixels are maize."""
    rng, library = np.random.default_rng(0), spectral_library(MOSAIC_BANDS)
    nm = library.wavelength_nm
    soil, maize = (library.reflectance[MATERIALS.index(name)] for name in ("soil_dry", "maize_full"))
    y, x = grid.coarse_shape
    centres = rng.uniform(0, (y, x), (BLOBS, 2))
    grown = np.zeros((y, x), np.bool_)
    rows, columns = np.ogrid[:y, :x]
    for down, across in centres:
        near = tuple(slice(max(int(at - BLOB_PX), 0), int(at + BLOB_PX) + 1) for at in (down, across))
        grown[near] |= (rows[near[0]] - down) ** 2 + (columns[:, near[1]] - across) ** 2 < BLOB_PX**2
    writer = MosaicWriter(path, grid.coarse_shape, nm)
    for top in range(0, y, SHARD_ROWS):
        part = grown[top : top + SHARD_ROWS]
        noise = rng.normal(0, 0.005, (*part.shape, len(nm)))
        values = np.where(part[..., None], maize, soil) + noise
        writer.write_tile(top, 0, values.astype(np.float32), np.ones(part.shape))
    return grown


def _mib(size: float) -> str:
    return f"{size / 2**20:.0f} MiB"


def _alone(folder: Path, side: int, cut: bool) -> tuple[int, int]:
    """Draw in a process of its own; its highest memory, and the one projected [bytes]."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_draw_field, folder, side, cut).result()


def _write_field(folder: Path, side: int) -> None:
    """Store a random coarse mosaic and patches at 35 % of the patches."""
    grid, rng = SceneGrid(side, side, 16, 4), np.random.default_rng(0)
    nm = np.linspace(420, 980, SYNTHETIC_BANDS)
    writer = MosaicWriter(folder / "mosaic.zarr", grid.coarse_shape, nm)
    writer.write_tile(0, 0, rng.uniform(0.1, 0.5, (*grid.coarse_shape, len(nm))), np.ones(grid.coarse_shape))
    count = int(np.prod(grid.patch_shape))
    patch_index = np.sort(rng.choice(count, int(FRACTION * count), replace=False))
    _write_patches(folder / "patches.zarr", grid, patch_index, nm)


def _write_patches(path: Path, grid: SceneGrid, patch_index: NDArray[np.integer], nm: NDArray[np.float64]) -> None:
    rng = np.random.default_rng(1)
    patches = PatchWriter(path, patch_index, grid.patch_origin(patch_index), grid.patch, nm)
    for first in range(0, len(patch_index), PATCHES_A_SHARD):
        shape = (min(PATCHES_A_SHARD, len(patch_index) - first), grid.patch, grid.patch)
        patches.write(rng.uniform(0.1, 0.5, (*shape, len(nm))).astype(np.float32), np.ones(shape, np.bool_))


def _draw_field(folder: Path, side: int, cut: bool) -> tuple[int, int]:
    """Draw a stored field with the shipped weights, one worker; memory of this process, and what was projected."""
    use_one_thread()
    file = _shipped()
    grid = SceneGrid(side, side, 16, 4)
    regions = plan_regions(grid, SHARD, most_px=SYNTHETIC_PX) if cut else plan_regions(grid, SHARD)
    weights, out = file.load(), folder / "map.zarr"
    shutil.rmtree(out, ignore_errors=True)
    create_class_map(out, (side, side), ClassNames(weights.class_names, weights.class_colours))
    work = FieldWork(file, regions, WorkerPool(workers=1), MEMORY)
    work.draw(folder / "mosaic.zarr", folder / "patches.zarr", out, lambda done: None)
    patch_index = open_patches(folder / "patches.zarr").patch_index
    return peak_bytes(), RESERVED_BYTES + most_bytes(weights.config, regions, patch_index, SYNTHETIC_BANDS)


def _shipped() -> WeightsFile:
    path = Path(__file__).resolve().parents[2] / "models" / "shipped" / "farm.safetensors"
    return WeightsFile(path, hashlib.sha256(path.read_bytes()).hexdigest()[:20])


def main() -> None:
    print("seed  halo  same class  near seams    mIoU   patches in common  read/kept")
    for seed, by_halo in zip(SEEDS, measure_halos(), strict=True):
        for halo, one in by_halo.items():
            print(
                f"{seed:4}  {'one' if halo < 0 else halo:>4}  {one.all_px:10.3%}  {one.near_px:10.3%}  {one.miou:.4f}"
                f"  {one.patch_index:15.2%}  {one.extra:9.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()

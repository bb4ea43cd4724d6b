"""Capture planning: free strip offsets against fixed strips, greedy blocks, one sweep per patch and the optimum."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from measure import Row, data_folder, not_run
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.budget_search import cheapest_cover, covers, spend
from pipeline.planning.coverage import cheapest_full, coarse_sweeps, full_sweeps
from pipeline.planning.fine_pass import plan_fine, price_of_patches
from pipeline.planning.prices import ScanPrices, check_budget, prices_of
from pipeline.planning.scan_runs import Cover, Field
from pipeline.planning.swaths import Views, edges_from, swaths_at_patches

CAMERA, COST = LineCamera(), CostModel()
FRACTIONS = (0.5, 0.8, 0.9, 0.95)
FRAMES, PATCH = 20, 32
ExpectedGain = NDArray[np.float64]


def rows() -> list[Row]:
    return [*_frames(), *_patches(), *_optimum(), *_farm(), *_speed()]


# --- the first 20 frames of the CWFID training list ---


def _frames() -> list[Row]:
    folder = data_folder("cwfid")
    if not folder.is_dir():
        return [not_run("CWFID, 90 % of the patches with vegetation", folder)]
    grid, patch_index = _vegetation(folder)
    _, full, _ = cheapest_full(grid, CAMERA, COST)
    whole = FRAMES * sum(sweep.lines for sweep in full)
    found, plans = [], []
    for along in ("y", "x"):
        blocks = [
            _block_field(grid, along, patch_number, ScanPrices(0.1, 0.0, 0.0, 1500)) for patch_number in patch_index
        ]
        real = [_real_field(grid, along, patch_number, prices_of(CAMERA, COST)) for patch_number in patch_index]
        plans.append(_plans(real))
        free, exact = _curve(_plans(blocks), FRAMES * 2592), _curve(plans[-1], whole)
        fixed = _curve(_plans([_fixed(field) for field in blocks]), FRAMES * 2592)
        fixed_real = _curve(_plans([_fixed(field) for field in real]), whole)
        greedy = _greedy_curve(grid, along, patch_index)
        side = "short side" if along == "y" else "long side"
        goal = ("50/80/90/95 %: 90 % <= 0.27", free[2] <= 0.27) if along == "y" else ("", None)
        found += [
            Row(
                f"CWFID, fine lines over full, line along the {side}, blocks of 32 lines as geometry.md counts",
                _fractions(free),
                *goal,
                f"fixed strips {_fractions(fixed)}; greedy {_fractions(greedy)}; all frames pooled",
            ),
            Row(
                f"the same, true lines: rotation, taps, default prices, line along the {side}",
                _fractions(exact),
                "90 % <= 0.27",
                exact[2] <= 0.27,
                f"fixed strips {_fractions(fixed_real)}",
            ),
        ]
    coarse = [coarse_sweeps(replace(grid, factor=factor), CAMERA, "y") for factor in (4, 8)]
    fractions = [FRAMES * sum(sweep.lines for sweep in sweeps) / whole for sweeps in coarse]
    turned = _fractions(_curve([one + other for one, other in zip(*plans, strict=True)], whole))
    found.append(Row("the same, true lines, each frame in its better orientation", turned))
    return [*found, Row("coarse lines beside it, s = 4 / 8", _fractions(fractions))]


def _fractions(values: list[float]) -> str:
    return "/".join(f"{value:.3f}" for value in values)


def _vegetation(folder: Path) -> tuple[SceneGrid, list[ExpectedGain]]:
    """The grid of the frames, and which patches hold a pixel of crop or weed, 1 or 0 (patch,) a frame."""
    from storage.readers.labels import load_labels
    from storage.readers.scene_toml import load_scene_settings

    stated = load_scene_settings(folder / "scene.toml")
    patch_index = []
    for path in sorted((folder / "annotations").glob("*.png"))[:FRAMES]:
        labels = load_labels(path, (966, 1296), classes=stated.classes, unlabelled=stated.unlabelled)
        grid = SceneGrid(*labels.index.shape, PATCH, 1)
        padded = np.zeros(grid.padded_shape, bool)
        padded[: grid.height, : grid.width] = np.isin(labels.index, [labels.names.index(n) for n in ("crop", "weed")])
        cells = padded.reshape(grid.patch_shape[0], PATCH, grid.patch_shape[1], PATCH).any(axis=(1, 3))
        patch_index.append(cells.ravel().astype(float))
    return grid, patch_index


def _real_field(grid: SceneGrid, along: Axis, expected_gain: ExpectedGain, prices: ScanPrices) -> Field:
    views = edges_from(grid, CAMERA, swaths_at_patches(grid, CAMERA, along), expected_gain > 0)
    return Field(views, expected_gain, _columns(grid, along), prices)


def _columns(grid: SceneGrid, along: Axis) -> NDArray[np.intp]:
    row, column = np.divmod(np.arange(int(np.prod(grid.patch_shape))), grid.patch_shape[1])
    return column if along == "x" else row


def _block_field(grid: SceneGrid, along: Axis, expected_gain: ExpectedGain, prices: ScanPrices) -> Field:
    """Patches in blocks of lines, 640 px wide and neither turned nor tapped: how the design counts."""
    column = _columns(grid, along)
    row = _columns(grid, "y" if along == "x" else "x")
    most, wanted = CAMERA.samples // grid.patch, np.flatnonzero(expected_gain)
    size = grid.height if along == "x" else grid.width
    swaths = range(max(int(column.max()) + 1 - most, 0) + 1)
    seen = [wanted[(column[wanted] >= s) & (column[wanted] < s + most)] for s in swaths]
    patch_number = np.concatenate(seen)
    sweeps = tuple(Sweep(f"block-{s:03d}", "fine", along, float(s), 0.0, size) for s in swaths)
    first = row[patch_number] * grid.patch
    stop = np.minimum(first + grid.patch, -(-size // grid.patch) * grid.patch)
    views = Views(sweeps, int(stop.max()), np.cumsum([0, *map(len, seen)]), patch_number, first, stop)
    return Field(views, expected_gain, column, prices)


def _fixed(field: Field) -> Field:
    """The same field seen from the strips of a full scan alone, each patch from one: the exact optimum per strip."""
    views, swaths = field.views, field.side_by_side.ravel()
    taken: set[int] = set()
    parts = []
    for swath in swaths.tolist():
        own = np.arange(views.edges[swath], views.edges[swath + 1])
        own = own[[patch_number not in taken for patch_number in views.patch_number[own].tolist()]]
        taken |= set(views.patch_number[own].tolist())
        parts.append(own)
    kept = np.concatenate(parts)
    sweeps = tuple(views.swaths[swath] for swath in swaths)
    edges = np.cumsum([0, *map(len, parts)])
    few = Views(sweeps, views.lines, edges, views.patch_number[kept], views.first[kept], views.stop[kept])
    return Field(few, field.expected_gain, field.column, field.prices)


def _plans(fields: list[Field]) -> list[list[Cover]]:
    """Covers of each frame at many prices of a line; the last shows everything."""
    return [[cover for cover, _ in covers(field)] for field in fields]


def _curve(plans: list[list[Cover]], whole: int) -> list[float]:
    """Lines that show given fractions of the worth of all frames together, over ``whole``.

    Frames go from one of their plans to the next in the order of worth per line.
    """
    total = sum(frame[-1].expected_gain for frame in plans)
    steps = [step for frame in plans for step in _hull(frame)]
    steps.sort(key=lambda step: -step[0] / max(step[1], 1))
    expected_gain, lines = np.cumsum([step[0] for step in steps]), np.cumsum([step[1] for step in steps])
    return [float(lines[np.searchsorted(expected_gain, fraction * total - 1e-9)]) / whole for fraction in FRACTIONS]


def _hull(plans: list[Cover]) -> list[tuple[float, int]]:
    """Steps (worth, lines) along the upper hull of plans, from none."""
    hull = [Cover()]
    for plan in sorted(plans, key=lambda plan: (plan.lines, -plan.expected_gain)):
        if plan.expected_gain <= hull[-1].expected_gain:
            continue
        while len(hull) > 1 and _slope(hull[-2], hull[-1]) <= _slope(hull[-2], plan):
            hull.pop()
        hull.append(plan)
    return [(b.expected_gain - a.expected_gain, b.lines - a.lines) for a, b in pairwise(hull)]


def _slope(one: Cover, other: Cover) -> float:
    return (other.expected_gain - one.expected_gain) / max(other.lines - one.lines, 1e-9)


def _greedy_curve(grid: SceneGrid, along: Axis, patch_index: list[ExpectedGain]) -> list[float]:
    """Peer: the block of lines that shows most new patches is taken next, over all frames."""
    fields = [_block_field(grid, along, patch_number, ScanPrices(0.1, 0.0, 0.0, 1500)) for patch_number in patch_index]
    steps: list[float] = []
    for field in fields:
        swaths, rows_, views = len(field.views.swaths), -(-field.views.lines // PATCH), field.views
        left = field.expected_gain.copy()
        while left.any():
            gain = np.bincount(views.swath * rows_ + views.first // PATCH, left[views.patch_number], swaths * rows_)
            swath, row = divmod(int(gain.argmax()), rows_)
            steps.append(float(gain.max()))
            left[views.patch_number[(views.swath == swath) & (views.first // PATCH == row)]] = 0
    expected_gain = np.cumsum(sorted(steps, reverse=True))
    return [
        float(np.searchsorted(expected_gain, fraction * expected_gain[-1] - 1e-9) + 1) * PATCH / (FRAMES * 2592)
        for fraction in FRACTIONS
    ]


# --- 100 patches of 320 px in 10240 x 10240 px ---


def _patches() -> list[Row]:
    grid = SceneGrid(10_240, 10_240, 320, 4)
    full = sum(sweep.lines for sweep in full_sweeps(grid, CAMERA, "x"))
    coarse = sum(sweep.lines for sweep in coarse_sweeps(grid, CAMERA, "x"))
    patch_index = np.random.default_rng(0).choice(1024, 100, replace=False)
    began = time.process_time()
    price = price_of_patches(grid, CAMERA, COST, "x", patch_index)
    took = time.process_time() - began
    expected_gain = np.zeros(1024)
    expected_gain[patch_index] = 1
    field = _real_field(grid, "x", expected_gain, prices_of(CAMERA, COST))
    need = field.views.stop - field.views.first
    single = sum(int(need[field.views.patch_number == patch_number].min()) for patch_number in patch_index)
    swaths = cheapest_cover(_fixed(field))
    fraction, alone, fixed = ((coarse + lines) / full for lines in (price.lines, single, swaths.lines))
    met = fraction <= min(alone, 0.498, 1.0) and price.lines <= 1.02 * swaths.lines
    text = f"{fraction:.1%} of {full} lines with the coarse pass ({price.lines} fine), {took:.1f} s"
    goal = "<= one sweep per patch (49.8 %), <= exact per-strip optimum + 2 %, <= 100 %"
    peers = f"one sweep per patch {alone:.1%} ({single}); exact per-strip optimum {fixed:.1%} ({swaths.lines})"
    what = "100 patches of 320 px, seed 0, s = 4, rotated footprints"
    return [Row(what, text, goal, met, peers), *_many_patches(grid, coarse, full)]


def _many_patches(grid: SceneGrid, coarse: int, full: int) -> list[Row]:
    """Where one sweep per patch costs more than scanning everything, and where runs of lines do too."""
    patch_index = np.random.default_rng(0).choice(1024, 400, replace=False)
    expected_gain = np.zeros(1024)
    expected_gain[patch_index] = 1
    views = _real_field(grid, "x", expected_gain, prices_of(CAMERA, COST)).views
    alone = sum(
        int((views.stop - views.first)[views.patch_number == patch_number].min()) for patch_number in patch_index
    )
    fraction = (coarse + price_of_patches(grid, CAMERA, COST, "x", patch_index).least[0]) / full
    wide = price_of_patches(SceneGrid(600, 1280, 400, 1), CAMERA, COST, "x", np.arange(8))
    return [
        Row(
            "400 patches of 320 px, with the coarse pass",
            f"{fraction:.1%} of the full scan's lines",
            "<= 100 %",
            fraction <= 1,
            f"one sweep per patch {(coarse + alone) / full:.1%}",
        ),
        Row(
            "8 patches of 400 px, of which a line shows one, in 1280 x 600 px",
            f"{wide.least[0]} lines ({wide.kind})",
            "never above the full scan",
            wide.least[0] <= (wide.full_lines or 0),
            f"by runs of lines {wide.lines}",
        ),
    ]


# --- the optimum of an integer programme ---


def _optimum() -> list[Row]:
    """20 x 12 patches seen 8 columns at a time, four budgets; the programme is solved to 1e-4."""
    grid = SceneGrid(20 * 80, 12 * 80, 80, 1)
    expected_gain = _smooth((20, 12), seed=0, sigma=1.2).ravel()
    prices = prices_of(CAMERA, COST)
    field = _block_field(grid, "x", expected_gain, prices)
    full_s = prices.seconds(2 * 1600, 2)
    ours, best, spent = [], [], [0.0, 0.0]
    for budget in (0.08, 0.2, 0.4, 0.7):
        began = time.perf_counter()
        ours.append(spend(field, budget * full_s).expected_gain)
        spent[0] += time.perf_counter() - began
        began = time.perf_counter()
        best.append(_milp(field, prices, budget * full_s))
        spent[1] += time.perf_counter() - began
    fractions = [a / b for a, b in zip(ours, best, strict=True)]
    return [
        Row(
            "worth over the optimum, 240 patches, budget .08/.2/.4/.7",
            "/".join(f"{fraction:.2%}" for fraction in fractions),
            "",
            None,
            f"four plans {spent[0]:.2f} s; scipy milp (HiGHS, gap 1e-4) {spent[1]:.1f} s",
        )
    ]


def _milp(field: Field, prices: ScanPrices, budget_s: float) -> float:
    """Most worth for a budget: is a strip on in a row, does it start there, is a patch shown, loads of the memory."""
    from scipy import sparse
    from scipy.optimize import Bounds, LinearConstraint, milp

    views, height = field.views, int((field.views.stop - field.views.first)[0])
    rows_ = views.lines // height
    on = len(views.swaths) * rows_
    patch_index, place = np.unique(views.patch_number, return_inverse=True)
    size = 2 * on + len(patch_index) + 1
    cell = views.swath * rows_ + views.first // height
    started = sparse.eye(on) - sparse.eye(on, k=-1).multiply((np.arange(on) % rows_ > 0)[:, None])
    starts = sparse.hstack([started, -sparse.eye(on), sparse.csr_matrix((on, len(patch_index) + 1))])
    shown = sparse.hstack(
        [
            -sparse.csr_matrix((np.ones(len(cell)), (place, cell)), (len(patch_index), on)),
            sparse.csr_matrix((len(patch_index), on)),
            sparse.eye(len(patch_index)),
            sparse.csr_matrix((len(patch_index), 1)),
        ]
    )
    value, seconds, loads = np.zeros(size), np.zeros(size), np.zeros(size)
    value[2 * on : -1] = field.expected_gain[patch_index]
    seconds[:on], seconds[on : 2 * on], seconds[-1] = height * prices.line_s, prices.run_s, prices.reload_s
    loads[:on], loads[-1] = height, -prices.lines_per_reload
    limits = LinearConstraint(
        sparse.vstack([starts, shown, sparse.csr_matrix(seconds), sparse.csr_matrix(loads)]),
        -np.inf,
        np.concatenate([np.zeros(on + len(patch_index)), [budget_s, 0.0]]),
    )
    top, whole = np.ones(size), np.zeros(size)
    top[-1], whole[:on], whole[-1] = 99, 1, 1
    found = milp(
        -value,
        constraints=limits,
        bounds=Bounds(0, top),
        integrality=whole,
        options={"mip_rel_gap": 1e-4, "time_limit": 20},
    )
    return float(-found.fun)


def _smooth(shape: tuple[int, int], *, seed: int, sigma: float) -> ExpectedGain:
    from scipy.ndimage import gaussian_filter

    drawn = gaussian_filter(np.random.default_rng(seed).normal(size=shape), sigma, mode="wrap")
    return np.exp(1.5 * drawn / drawn.std())


# --- the farm's field, and how long planning takes ---


def _farm() -> list[Row]:
    """Budget 0.5 on 1280 x 1024 px: worth of free offsets over that of fixed strips."""
    grid = SceneGrid(1024, 1280, 16, 4)
    along, _, full_s = cheapest_full(grid, CAMERA, COST)
    left = check_budget(0.5, COST.seconds(coarse_sweeps(grid, CAMERA, along), CAMERA), full_s)
    gains, fractions = [], []
    for seed in range(6):
        scores = _smooth(grid.patch_shape, seed=seed, sigma=(1.5, 3.0)[seed % 2]).ravel()
        plan = plan_fine(grid, CAMERA, COST, along, scores, budget_s=left)
        fixed = spend(_fixed(_real_field(grid, along, scores, prices_of(CAMERA, COST))), left)
        gains.append(plan.expected_gain / fixed.expected_gain - 1)
        fractions.append(plan.expected_gain / scores.sum())
    text = f"{np.mean(fractions):.1%} of the score; {np.mean(gains):+.1%} over fixed strips (from {min(gains):+.1%})"
    return [Row("farm, budget 0.5, six smooth random score maps", text, "> fixed strips", min(gains) > 0)]


def _speed() -> list[Row]:
    found = []
    for size, patch, goal in (((1024, 1280), 16, 2.0), ((10_240, 10_240), 32, 20.0), ((10_240, 10_240), 320, 20.0)):
        grid = SceneGrid(*size, patch, 4)
        full_s = COST.seconds(full_sweeps(grid, CAMERA, "x"), CAMERA)
        scores = _smooth(grid.patch_shape, seed=0, sigma=3.0).ravel()
        began = time.process_time()
        plan = plan_fine(grid, CAMERA, COST, "x", scores, budget_s=0.25 * full_s)
        took = time.process_time() - began
        what = f"planning {size[1]} x {size[0]} px, {patch} px patches, a quarter of the full scan's seconds"
        figure = f"{took:.2f} s of processor, {len(plan.sweeps)} runs"
        found.append(Row(what, figure, f"< {goal:.0f} s", took < goal))
    return found

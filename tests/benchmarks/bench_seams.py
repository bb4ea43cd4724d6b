"""Seams: accuracy of registration, crop rows that alias, a survey put together, and real pictures cut and joined.

Run alone, python tests/benchmarks/bench_seams.py FOLDER draws seams before and after registration: ``survey_seams.png``
is a simulated survey whose mirror looks 50 px beside the plan, ``picture_seams.png`` real pictures put together. What
the pictures show is printed as well.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle
from measure import Row, not_run
from numpy.typing import NDArray
from prepared.seam_data import (
    CUT_LEFT,
    CUT_RIGHT,
    LINES,
    RGBN,
    ROW_PX,
    SAMPLES,
    Survey,
    cut_and_join,
    given_neighbours,
    join_neighbours,
    left_again,
    line_errors,
    make_survey,
    row_views,
    seam_offsets,
    wave_views,
)

from pipeline.rectify.placed import PixelGrid, place
from pipeline.rectify.region import mosaic_tile
from pipeline.rectify.registration.alignment import SweepShift
from pipeline.rectify.registration.shifts import PairShift, pair_shift

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
Peer = Callable[[Floats, Floats], Floats]

SHAPE = (512, 64)
PRIOR_PX = 26.0
INK, QUIET, ALONG, SCAN = "#222222", "#8a8a8a", "#c1440e", "#1f5f8b"
CROP = (150, 230)  # rows and columns of a close view
OVERVIEW_STEP = 4
COLOURS = (2, 1, 0)  # bands shown as red, green and blue


def rows() -> list[Row]:
    waves = [_waves("4-40 px", (4, 40), 50), _waves("40-400 px", (40, 400), 50), _waves("4-40 px", (4, 40), 1)]
    return [*waves, _rows_with_gaps(), _rows_without(), *_survey(), *_pictures()]


def _waves(name: str, periods: tuple[float, float], snr: float, seeds: int = 20) -> Row:
    ours: list[float] = []
    peers: dict[str, list[float]] = {peer: [] for peer in PEERS}
    for seed in range(seeds):
        shift = np.random.default_rng(seed).uniform(-8, 8, 2)
        views = wave_views(seed, SHAPE, shift, snr, periods)
        found = pair_shift(*views, prior_px=9)
        ours.append(np.hypot(*(found.shift - shift)))
        for peer, method in PEERS.items():
            peers[peer].append(np.hypot(*(method(*views) - shift)))
    found_share = np.isfinite(ours).mean()
    error = float(np.nanmedian(ours))
    return Row(
        f"registration, {SHAPE[0]} x {SHAPE[1]} px, waves of {name}, SNR {snr:g}: median error",
        f"{error:.3f} px" + ("" if found_share == 1 else f", {100 * found_share:.0f} % found"),
        "<= 0.1 px" if snr == 50 else "",
        error <= 0.1 and found_share == 1 if snr == 50 else None,
        ", ".join(f"{peer} {np.median(errors):.3f} px" for peer, errors in peers.items()),
    )


def _rows_with_gaps(seeds: int = 200) -> Row:
    results, peers = _row_results(seeds, gaps=0.2)
    off = sum(found.status == "found" and np.abs(found.shift - shift).max() > 1 for found, shift in results)
    found = sum(found.status == "found" for found, _ in results)
    error = np.median([np.hypot(*(found.shift - shift)) for found, shift in results if found.status == "found"])
    return Row(
        f"crop rows {ROW_PX:g} px apart, a fifth bare, shifts to 25 px, {seeds} seeds: off by a row",
        f"{off} of {seeds} ({found} found, {error:.3f} px)",
        "never",
        off == 0 and found > 0.9 * seeds,
        ", ".join(f"{peer} {count} off" for peer, count in peers.items()),
    )


def _rows_without(seeds: int = 40) -> Row:
    results, peers = _row_results(seeds, gaps=0.0)
    undecided = sum(found.status == "undecidable" for found, _ in results)
    return Row(
        "the same without a gap: reported as undecidable",
        f"{undecided} of {seeds}",
        "all",
        undecided == seeds,
        ", ".join(f"{peer} guesses, {count} off" for peer, count in peers.items()),
    )


def _row_results(seeds: int, gaps: float) -> tuple[list[tuple[PairShift, Floats]], dict[str, int]]:
    results, peers = [], dict.fromkeys(PEERS, 0)
    for seed in range(seeds):
        shift = np.random.default_rng(seed).uniform(-25, 25, 2)
        views = row_views(seed, SHAPE, shift, 50, gaps)
        results.append((pair_shift(*views, prior_px=PRIOR_PX), shift))
        for peer, method in PEERS.items():
            peers[peer] += int(np.abs(method(*views) - shift).max() > 1)
    return results, peers


def _survey() -> list[Row]:
    survey = make_survey()
    before, after = (seam_offsets(survey, shifts) for shifts in (survey.unregistered, survey.found.shifts))
    # np.max, for max() would pass over a seam that is NaN: not seen, or not measured.
    worst = [float(np.max([np.hypot(*seam.mean(axis=0)) for seam in seams])) for seams in (before, after)]
    again = float(np.max([np.hypot(*mean) for mean in left_again(survey, survey.found.shifts)]))
    jitter = np.concatenate(line_errors(survey)).std()
    what = f"survey of {LINES} lines x {SAMPLES} samples, {len(survey.sweeps)} strips, 50 px and 0.8 px per line off"
    return [
        Row(
            f"{what}: mean offset left at the worst seam",
            f"{worst[1]:.3f} px",
            "< 0.2 px",
            worst[1] < 0.2,
            f"not registered {worst[0]:.1f} px",
        ),
        Row("the same, seams registered again", f"{again:.3f} px", "< 0.2 px", again < 0.2),
        Row("the same: what remains per line, rms", f"{jitter:.2f} px"),
    ]


def _pictures() -> list[Row]:
    if not RGBN.is_dir():
        return [not_run("two parts of rgbn.tif put together", RGBN)]
    exact, smooth = cut_and_join()
    rows = [
        Row(
            "two parts of rgbn.tif, 3 and 4 px out of place, put together by nearest: pixels that differ",
            f"{exact.differing}",
            "0",
            exact.differing == 0,
        ),
        Row(
            "the same by Catmull-Rom, one cut between pixels: rms error over the deviation",
            f"{100 * smooth.relative:.2f} %",
            "",
            None,
            f"bilinear {100 * smooth.bilinear:.2f} %",
        ),
    ]
    pair = join_neighbours()
    apart = ("rgbn_subb.tif on rgbn_suba.tif", pair.shift, float(np.sqrt(np.nanmean(pair.difference**2))))
    for name, shift, left in [*given_neighbours(), apart]:
        figure = f"{shift[0]:+.3f}, {shift[1]:+.3f} px; {left:.2f} DN rms"
        rows.append(Row(f"{name}: found beside its georeference (rows, columns); left there", figure))
    return rows


def _skimage(reference: Floats, moving: Floats) -> Floats:
    from skimage.registration import phase_cross_correlation

    window = np.outer(*(np.hanning(size) for size in reference.shape))
    views = [(view - view.mean()) * window for view in (reference, moving)]
    return np.asarray(phase_cross_correlation(*views, normalization=None, upsample_factor=100)[0])


def _opencv(reference: Floats, moving: Floats) -> Floats:
    import cv2

    window = cv2.createHanningWindow(reference.shape[::-1], cv2.CV_64F)
    # Copies, for it puts the window on what it is given where the size needs no padding.
    (right, down), _ = cv2.phaseCorrelate(reference.copy(), moving.copy(), window)
    return np.array([-down, -right])


PEERS: dict[str, Peer] = {"skimage": _skimage, "cv2.phaseCorrelate": _opencv}


def main() -> None:
    parser = argparse.ArgumentParser(description="Show seams before and after registration.")
    parser.add_argument("folder", type=Path, help="where the two PNG files are written")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    plt.switch_backend("Agg")
    plt.rcParams.update({"font.size": 9, "axes.edgecolor": QUIET, "axes.labelcolor": INK, "text.color": INK})
    show_survey(make_survey(), folder / "survey_seams.png")
    if RGBN.is_dir():
        show_pictures(folder / "picture_seams.png")
    else:
        print(f"picture_seams.png: not run: no {RGBN}, set SPECTRALZOOM_DATA")


def show_survey(survey: Survey, path: Path) -> None:
    """Print and draw what registration does to the seams of a survey."""
    before, after = (seam_offsets(survey, shifts) for shifts in (survey.unregistered, survey.found.shifts))
    again = left_again(survey, survey.found.shifts)
    print(f"{len(survey.sweeps)} strips, held: {survey.found.reference}; offset left at seams, along and scan [px]")
    for number, seams in enumerate(zip(before, after, again, strict=True)):
        first, last = (seam.mean(axis=0) for seam in seams[:2])
        print(
            f"  seam {number}-{number + 1}: before {first.round(2)}, after {last.round(3)}, measured again "
            f"{seams[2].round(3)}; from line to line {seams[1].std(axis=0).round(2)} rms"
        )
    errors = line_errors(survey)
    for one, error in zip(survey.sweeps, errors, strict=True):
        print(f"  {one.sweep.name}: what remains per line, rms along and scan {error.std(axis=0).round(3)} px")
    _draw_survey(survey, before, after, path)


def _draw_survey(survey: Survey, before: list[Any], after: list[Any], path: Path) -> None:
    figure = plt.figure(figsize=(14.5, 12.4), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=[3.6, 1])
    left, right = top.subfigures(1, 2, width_ratios=[1, 1.12])
    whole = _mosaic(survey, survey.found.shifts, (0, 0), (survey.grid.height, survey.grid.width), OVERVIEW_STEP)
    scale = float(np.nanpercentile(whole, 99.5))
    overview = left.subplots()
    extent = (0, survey.grid.width, survey.grid.height, 0)
    overview.imshow(_colour(whole, scale), extent=extent, interpolation="antialiased")
    overview.set(title="After registration; black: no strip looked there", xlabel="x [px]", ylabel="y [px]")
    views = right.subplots(len(after), 2)
    lines = bottom.subplots(1, len(after), sharey=True)
    for number, row in enumerate(views):
        corner = _crop_corner(survey, number)
        overview.add_patch(Rectangle(corner[::-1], CROP[1], CROP[0], fill=False, color="white", lw=1.6))
        overview.text(corner[1], corner[0] - 25, f"{number}-{number + 1}", color="white", weight="bold")
        sides = (("before", survey.unregistered, before[number]), ("after", survey.found.shifts, after[number]))
        for panel, (name, shifts, seam) in zip(row, sides, strict=True):
            panel.imshow(_colour(_mosaic(survey, shifts, corner, CROP, 1), scale), interpolation="nearest")
            along, scan = seam.mean(axis=0)
            panel.set(
                title=f"{number}-{number + 1} {name}: off by ({along:+.2f}, {scan:+.2f}) px", xticks=[], yticks=[]
            )
        _draw_residual(lines[number], after[number], first=number == 0, name=f"Left at seam {number}-{number + 1}")
    figure.suptitle(
        "Five strips that look up to 50 px beside the plan, with 0.8 px of jitter from line to line",
        weight="bold",
        fontsize=13,
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)
    print(path)


def _draw_residual(panel: Any, seam: NDArray[np.float64], *, first: bool, name: str) -> None:
    """Offset of every line at one seam, both axes, with its mean over 100 lines."""
    line = np.arange(len(seam))
    for axis, (colour, label) in enumerate(((ALONG, "along the line"), (SCAN, "along the scan"))):
        panel.plot(line, seam[:, axis], ".", ms=1, color=colour, alpha=0.25, rasterized=True)
        mean = np.convolve(seam[:, axis], np.ones(100) / 100, mode="valid")
        panel.plot(line[50 : 50 + len(mean)], mean, color=colour, lw=1.6, label=f"{label}, mean of 100")
    panel.axhline(0, color=INK, lw=0.6)
    panel.axhspan(-0.2, 0.2, color="#dddddd", zorder=0)
    panel.set(ylim=(-4, 4), xlabel="line", title=name)
    panel.spines[["top", "right"]].set_visible(False)
    if first:
        panel.set_ylabel("offset [px]")
        panel.legend(frameon=False, fontsize=8, loc="lower left")


def _crop_corner(survey: Survey, seam: int) -> tuple[int, int]:
    """First row and column of the close view of a seam: where the picture has most edges across it."""
    middle = (survey.sweeps[seam].sweep.strip_px + survey.sweeps[seam + 1].sweep.strip_px) / 2
    left = int(middle + survey.grid.width / 2 - CROP[1] / 2)
    strip = _mosaic(survey, survey.found.shifts, (0, left), (survey.grid.height, CROP[1]), 1).mean(axis=2)
    smooth = np.nan_to_num(np.abs(np.diff(strip, axis=0))).mean(axis=1)
    busy = np.convolve(smooth, np.ones(CROP[0]), mode="valid")
    edge = 120
    return int(edge + np.argmax(busy[edge:-edge])), left


def _mosaic(
    survey: Survey, shifts: Sequence[SweepShift], corner: tuple[int, int], size: tuple[int, int], step: int
) -> Image:
    """A part of the survey's mosaic, every ``step``-th pixel."""
    origin = tuple(
        first + (1 - whole) / 2 for first, whole in zip(corner, (survey.grid.height, survey.grid.width), strict=True)
    )
    grid = PixelGrid((origin[0], origin[1]), step, (size[0] // step, size[1] // step))
    placed = [
        place(one, survey.camera, shift_px=shift.of_lines(one.sweep.lines))
        for one, shift in zip(survey.sweeps, shifts, strict=True)
    ]
    tiles = [
        mosaic_tile(placed, survey.camera, grid, slice(row, min(row + 128, grid.shape[0])), slice(0, grid.shape[1]))[0]
        for row in range(0, grid.shape[0], 128)
    ]
    return np.concatenate(tiles)


def _colour(values: Image, scale: float) -> Image:
    shown: Image = np.clip(np.nan_to_num(values[..., COLOURS]) / scale, 0, 1) ** 0.7
    return shown


def show_pictures(path: Path) -> None:
    """Print and draw real pictures put together: two parts of one, and two neighbours that came with it."""
    exact, smooth = cut_and_join()
    print(f"two parts of rgbn.tif put together by nearest: {exact.differing} values differ")
    print(f"  by Catmull-Rom with a cut between pixels: rms {100 * smooth.relative:.2f} % of the deviation")
    for name, shift, rms in given_neighbours():
        print(f"  {name}: {shift[0]:+.3f} {shift[1]:+.3f} px beside its georeference, residual {rms:.2f} DN rms")
    pair = join_neighbours()
    left = float(np.sqrt(np.nanmean(pair.difference**2)))
    figure, panels = plt.subplots(2, 3, figsize=(14.5, 8.4), layout="constrained")
    _draw_picture(panels[0, 0], exact.values, f"Two parts put together by nearest: {exact.differing} values differ")
    for first, last in ((0, CUT_RIGHT), (CUT_LEFT, exact.values.shape[1])):
        panels[0, 0].add_patch(_outline((0, first), (exact.values.shape[0], last - first)))
    _draw_picture(panels[0, 1], smooth.values, "Second part cut between pixels, by Catmull-Rom")
    _draw_difference(panels[0, 2], smooth.error, f"Its difference: {100 * smooth.relative:.1f} % of the deviation")
    down, right = pair.shift
    _draw_picture(
        panels[1, 0], pair.values, f"suba and subb, found ({down:+.3f}, {right:+.3f}) px beside the georeference"
    )
    for origin, size in pair.outlines:
        panels[1, 0].add_patch(_outline(origin, size))
    rows, columns = pair.close
    _draw_picture(panels[1, 1], pair.values[rows, columns], "Close view of their seam", interpolation="nearest")
    _draw_difference(panels[1, 2], pair.difference[pair.shared], f"Their difference where both are: {left:.1f} DN rms")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    print(path)


def _outline(origin: Sequence[float], size: Sequence[float]) -> Rectangle:
    return Rectangle(
        (origin[1] - 0.5, origin[0] - 0.5), size[1], size[0], fill=False, color="white", lw=1.3, linestyle="--"
    )


def _draw_picture(panel: Any, values: Image, title: str, interpolation: str = "antialiased") -> None:
    panel.imshow(
        np.clip(np.where(np.isfinite(values[..., :3]), values[..., :3], 255) / 255, 0, 1), interpolation=interpolation
    )
    panel.set_title(title, fontsize=9)
    panel.set(xticks=[], yticks=[])


def _draw_difference(panel: Any, difference: Image, title: str) -> None:
    drawn = panel.imshow(np.abs(difference).mean(axis=2), cmap="magma", vmin=0, vmax=40, interpolation="antialiased")
    panel.set_title(title, fontsize=9)
    panel.set(xticks=[], yticks=[])
    panel.figure.colorbar(drawn, ax=panel, label="DN", shrink=0.8)


if __name__ == "__main__":
    main()

"""Seams: accuracy of registration, crop rows that alias, a survey put together, and real pictures cut and joined."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from beside.seam_data import (
    LINES,
    RGBN,
    ROW_PX,
    SAMPLES,
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
from measure import Row, not_run
from numpy.typing import NDArray

from pipeline.rectify.registration.shifts import PairShift, pair_shift

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
Peer = Callable[[Floats, Floats], Floats]

SHAPE = (512, 64)
PRIOR_PX = 26.0


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
    found_fraction = np.isfinite(ours).mean()
    error = float(np.nanmedian(ours))
    return Row(
        f"registration, {SHAPE[0]} x {SHAPE[1]} px, waves of {name}, SNR {snr:g}: median error",
        f"{error:.3f} px" + ("" if found_fraction == 1 else f", {100 * found_fraction:.0f} % found"),
        "<= 0.1 px" if snr == 50 else "",
        error <= 0.1 and found_fraction == 1 if snr == 50 else None,
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

"""Seams: accuracy of registration, and crop rows that cause aliasing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from measure import Row
from numpy.typing import NDArray

from pipeline.rectify.registration.alignment import PairShift, pair_shift
from tests.pipeline.rectify.made_views import ROW_PX, row_views, wave_views

Floats = NDArray[np.float64]
Peer = Callable[[Floats, Floats], Floats]

SHAPE = (512, 64)
PRIOR_PX = 26.0


def rows() -> list[Row]:
    waves = [_waves("4-40 px", (4, 40), 50), _waves("40-400 px", (40, 400), 50), _waves("4-40 px", (4, 40), 1)]
    return [*waves, _rows_with_gaps(), _rows_without()]


def _waves(name: str, periods: tuple[float, float], snr: float, seeds: int = 20) -> Row:
    ours: list[float] = []
    peers: dict[str, list[float]] = {peer: [] for peer in PEERS}
    for seed in range(seeds):
        shift = np.random.default_rng(seed).uniform(-8, 8, 2)
        views = wave_views(seed, SHAPE, shift, snr, periods)
        ours.append(np.hypot(*(pair_shift(*views, prior_px=9).shift - shift)))
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
    results = []
    peers = dict.fromkeys(PEERS, 0)
    for seed in range(seeds):
        shift = np.random.default_rng(seed).uniform(-25, 25, 2)
        views = row_views(seed, SHAPE, shift, 50, gaps)
        results.append((pair_shift(*views, prior_px=PRIOR_PX), shift))
        for peer, method in PEERS.items():
            peers[peer] += int(np.abs(method(*views) - shift).max() > 1)
    return results, peers


def _skimage(reference: Floats, moving: Floats) -> Floats:
    from skimage.registration import phase_cross_correlation

    window = np.outer(*(np.hanning(size) for size in reference.shape))
    views = [(view - view.mean()) * window for view in (reference, moving)]
    return np.asarray(phase_cross_correlation(*views, normalization=None, upsample_factor=100)[0])


def _opencv(reference: Floats, moving: Floats) -> Floats:
    import cv2

    window = cv2.createHanningWindow(reference.shape[::-1], cv2.CV_64F)
    # Copies, as it applies the window in place if the size needs no padding.
    (right, down), _ = cv2.phaseCorrelate(reference.copy(), moving.copy(), window)
    return np.array([-down, -right])


PEERS: dict[str, Peer] = {"skimage": _skimage, "cv2.phaseCorrelate": _opencv}

"""Resampling: cost against a copy of the same rows, and against other libraries."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from beside.resample_peers import BANDS, Turned, cv2_parts, peers, turned_waves
from measure import Row, ns_of, ratio, time_in_turn
from numpy.typing import NDArray

from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rectify.resample import resample

KERNELS: dict[Kernel, tuple[int, str]] = {
    "nearest": (0, "nearest"),
    "bilinear": (1, "linear"),
    "catmull-rom": (3, "cubic"),
}
BLOCK = 2048
ALIKE = 1.001  # errors within this ratio differ by rounding only
ROUNDS = 3
TILES = 3  # in a row, as in a worker


def rows() -> list[Row]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of the other libraries
            natural, flat = turned_waves(1), turned_waves(0)
            beside = [row for kernel in KERNELS for row in _beside_peers(kernel, natural, flat)]
            return [*_over_take(natural), *beside, *_over_linear(natural, flat)]
    finally:
        torch.set_num_threads(before)


def _call(scene: Turned, kernel: Kernel) -> Callable[[], Any]:
    valid = np.ones(scene.samples.shape[:2], bool)
    return lambda: resample(scene.samples, valid, scene.coordinates, kernel)


def _take(scene: Turned, out: NDArray[np.float32]) -> Callable[[], None]:
    """Copy each point's nearest row in blocks; with mode="clip", as numpy's default mode makes one more copy."""
    table = scene.samples.reshape(-1, scene.samples.shape[2])
    line, sample = np.rint(scene.coordinates).astype(np.intp).T
    index = line * scene.samples.shape[1] + sample

    def call() -> None:
        for start in range(0, len(index), BLOCK):
            np.take(table, index[start : start + BLOCK], axis=0, out=out[start : start + BLOCK], mode="clip")

    return call


def _over_take(scene: Turned) -> list[Row]:
    """Compare each kernel with a copy of the same rows, on a sweep larger than the cache."""
    out = np.empty(scene.truth.shape, np.float32)
    calls = {"take": _take(scene, out)} | {kernel: _call(scene, kernel) for kernel in KERNELS}
    clocks = time_in_turn({name: _often(call, TILES) for name, call in calls.items()}, 7)
    take = ns_of(clocks["take"], TILES * out.size)
    found = []
    for kernel in KERNELS:
        times = ratio(clocks, kernel, "take")
        goal = 3.0 if kernel == "catmull-rom" else None
        judged = (f"<= {goal:g} x", times <= goal) if goal else ("", None)
        spent = f"{ns_of(clocks[kernel], TILES * out.size):.2f} ns/(px*band), np.take {take:.2f}"
        found.append(Row(f"{kernel}, {BANDS} bands, over np.take of the same rows", f"{times:.2f} x", *judged, spent))
    return found


def _often(call: Callable[[], Any], times: int) -> Callable[[], None]:
    def repeated() -> None:
        for _ in range(times):
            call()

    return repeated


def _beside_peers(kernel: Kernel, natural: Turned, flat: Turned) -> list[Row]:
    """Compare time and error of one order; ours allocates its output, even if a peer gets a buffer."""
    order, name = KERNELS[kernel]
    others = peers(natural, order)
    clocks = time_in_turn({"ours": _call(natural, kernel)} | {peer.name: peer.call for peer in others}, ROUNDS)
    ours = ns_of(clocks["ours"], natural.truth.size)
    theirs = {peer.name: ns_of(clocks[peer.name], peer.bands * len(natural.truth)) for peer in others}
    met = all(ours < theirs[peer.name] for peer in others)
    found = [Row(f"{name}: ns/(px*band)", f"{ours:.2f}", "less than each", met, _listed(theirs, "{:.3g}"))]
    for what, scene, there in (("amplitude as period", natural, others), ("all waves alike", flat, peers(flat, order))):
        error = scene.error(_call(scene, kernel)()[0])
        errors = {peer.name: scene.error(peer.by_pixel(peer.call())) for peer in there}
        met = all(error <= other * ALIKE for other in errors.values())
        listed = _listed(errors, "{:.4f}")
        found.append(Row(f"{name}: rmse / std, {what}", f"{error:.4f}", "no larger than each", met, listed))
    return found


def _over_linear(natural: Turned, flat: Turned) -> list[Row]:
    """Compare Catmull-Rom with cv2's linear kernel."""
    found = []
    for what, scene in (("amplitude as period", natural), ("all waves alike", flat)):
        linear = peers(scene, 1, only="cv2.remap")[0]
        ours, theirs = scene.error(_call(scene, "catmull-rom")()[0]), scene.error(linear.by_pixel(linear.call()))
        listed = f"{ours:.4f}, cv2 linear {theirs:.4f}"
        fraction = ours / theirs
        name = f"catmull-rom: error over cv2.remap linear, {what}"
        found.append(Row(name, f"{fraction:.3f}", "<= 1/3", fraction <= 1 / 3, listed))
    calls = {"ours": _call(natural, "catmull-rom"), "joined": peers(natural, 1, only="cv2.remap")[0].call}
    calls["parted"] = cv2_parts(natural, 1)
    clocks = time_in_turn({name: _often(call, TILES) for name, call in calls.items()}, 7)
    times, parted = ratio(clocks, "ours", "joined"), ratio(clocks, "ours", "parted")
    listed = f"{times:.2f} x with its three parts of 90 bands joined, {parted:.2f} x with them left apart"
    return [*found, Row("catmull-rom: time over cv2.remap linear", f"{times:.2f} x", "< 1 x", times < 1, listed)]


def _listed(figures: Mapping[str, float], form: str) -> str:
    return ", ".join(f"{name} {form.format(figure)}" for name, figure in figures.items())

"""Resampling: cost against a copy of the same rows, and against OpenCV and torch, each in its fastest layout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from measure import Row, ns_of, ratio, time_in_turn
from numpy.typing import NDArray

from spectralzoom.models.network.machine import one_thread
from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rectify.resample import resample

NAMES: dict[Kernel, str] = {"nearest": "nearest", "bilinear": "linear", "catmull-rom": "cubic"}
SIDE = 256  # px of the sweep
BANDS = 270
WAVES = 24
EDGE = 176  # px of the output grid, which stays inside when rotated
TURN_DEG = 14.0
BLOCK = 2048
ALIKE = 1.001  # errors within this ratio differ by rounding only
ROUNDS = 3
TILES = 3  # in a row, as in a worker
Call = Callable[[], NDArray[np.float32]]  # gives (y * x, band)


@dataclass(frozen=True)
class Turned:
    """A sweep of waves and a grid rotated against it; ``truth`` has the waves' values at the grid's points."""

    samples: NDArray[np.float32]  # (line, sample, band)
    coordinates: NDArray[np.float64]  # (y * x, 2) line and sample
    truth: NDArray[np.float64]  # (y * x, band)

    def error(self, out: NDArray[np.floating]) -> float:
        """Return the RMSE over the standard deviation."""
        return float(np.sqrt(np.mean((out - self.truth) ** 2)) / np.std(self.truth))


def turned_waves() -> Turned:
    """Return waves of 4 to 40 px with their period as amplitude, as in images of natural scenes, and a turned grid."""
    rng = np.random.default_rng(0)
    period = np.exp(rng.uniform(np.log(4.0), np.log(40.0), WAVES))
    angle = rng.uniform(0, np.pi, WAVES)
    frequency = np.stack([np.sin(angle), np.cos(angle)], axis=-1) / period[:, None]
    cosine, sine = rng.standard_normal((2, WAVES, BANDS)) * period[:, None]

    def waves(at: NDArray[np.float64]) -> NDArray[np.float64]:
        phase = 2 * np.pi * at @ frequency.T
        return np.cos(phase) @ cosine + np.sin(phase) @ sine

    cos, sin = np.cos(np.deg2rad(TURN_DEG)), np.sin(np.deg2rad(TURN_DEG))
    turn = np.array([[cos, -sin], [sin, cos]])
    start = np.array([SIDE / 2 + 0.2, SIDE / 2 - 0.3]) - turn @ np.full(2, (EDGE - 1) / 2)
    coordinates = np.argwhere(np.ones((EDGE, EDGE), bool)) @ turn.T + start
    lines = np.argwhere(np.ones((SIDE, SIDE), bool)).astype(np.float64)
    return Turned(waves(lines).astype(np.float32).reshape(SIDE, SIDE, BANDS), coordinates, waves(coordinates))


def rows() -> list[Row]:
    scene = turned_waves()
    cv2.setNumThreads(1)
    with one_thread():
        return [
            *_over_take(scene),
            *(row for kernel in NAMES for row in _beside_peers(kernel, scene)),
            _over_linear(scene),
        ]


def _ours(scene: Turned, kernel: Kernel) -> Call:
    valid = np.ones(scene.samples.shape[:2], bool)
    return lambda: resample(scene.samples, valid, scene.coordinates, kernel)[0]


def _cv2(scene: Turned, kernel: Kernel) -> Call:
    """Return cv2.remap by groups of bands, split before the timing: 90 are its fastest, for cubic 4."""
    linear = {"nearest": cv2.INTER_NEAREST, "bilinear": cv2.INTER_LINEAR}
    size, flag = (90, linear[kernel]) if kernel in linear else (4, cv2.INTER_CUBIC)
    y, x = scene.coordinates.T.astype(np.float32).reshape(2, EDGE, EDGE)
    parts = [np.ascontiguousarray(scene.samples[..., at : at + size]) for at in range(0, BANDS, size)]
    outs = [np.empty((EDGE, EDGE, part.shape[2]), np.float32) for part in parts]
    whole = np.empty((EDGE, EDGE, BANDS), np.float32)

    def call() -> NDArray[np.float32]:
        for part, out in zip(parts, outs, strict=True):
            cv2.remap(part, x, y, flag, dst=out, borderMode=cv2.BORDER_REFLECT_101)
        return np.concatenate(outs, axis=2, out=whole).reshape(-1, BANDS)

    return call


def _torch(scene: Turned, kernel: Kernel) -> Call:
    mode = {"nearest": "nearest", "bilinear": "bilinear"}.get(kernel, "bicubic")
    grid = torch.from_numpy(
        (scene.coordinates[:, ::-1] / (SIDE - 1) * 2 - 1).astype(np.float32).reshape(1, EDGE, EDGE, 2)
    )
    # channels last takes half the time of planes
    image = torch.from_numpy(scene.samples)[None].permute(0, 3, 1, 2)

    def call() -> NDArray[np.float32]:
        out = torch.nn.functional.grid_sample(image, grid, mode=mode, align_corners=True)
        return np.asarray(out[0].flatten(1).T.numpy())

    return call


PEERS = {"cv2.remap": _cv2, "torch grid_sample": _torch}


def _take(scene: Turned) -> Callable[[], None]:
    """Copy each point's nearest row in blocks; with mode="clip", as numpy's default mode makes one more copy."""
    table, out = scene.samples.reshape(-1, BANDS), np.empty(scene.truth.shape, np.float32)
    line, sample = np.rint(scene.coordinates).astype(np.intp).T
    index = line * SIDE + sample

    def call() -> None:
        for start in range(0, len(index), BLOCK):
            np.take(table, index[start : start + BLOCK], axis=0, out=out[start : start + BLOCK], mode="clip")

    return call


def _over_take(scene: Turned) -> list[Row]:
    """Compare each kernel with a copy of the same rows, on a sweep larger than the cache."""
    calls = {"take": _take(scene)} | {kernel: _ours(scene, kernel) for kernel in NAMES}
    clocks = time_in_turn({name: lambda call=call: [call() for _ in range(TILES)] for name, call in calls.items()}, 7)
    take = ns_of(clocks["take"], TILES * scene.truth.size)
    found = []
    for kernel in NAMES:
        times = ratio(clocks, kernel, "take")
        judged = ("<= 3 x", times <= 3) if kernel == "catmull-rom" else ("", None)
        spent = f"{ns_of(clocks[kernel], TILES * scene.truth.size):.2f} ns/(px*band), np.take {take:.2f}"
        found.append(Row(f"{kernel}, {BANDS} bands, over np.take of the same rows", f"{times:.2f} x", *judged, spent))
    return found


def _beside_peers(kernel: Kernel, scene: Turned) -> list[Row]:
    """Compare time and error of one order; ours allocates its output, even if a peer gets a buffer."""
    ours, peers = _ours(scene, kernel), {name: make(scene, kernel) for name, make in PEERS.items()}
    clocks = time_in_turn({"ours": ours} | peers, ROUNDS)
    times = {name: ns_of(clock, scene.truth.size) for name, clock in clocks.items()}
    errors = {"ours": scene.error(ours())} | {name: scene.error(call()) for name, call in peers.items()}
    faster = all(times["ours"] < times[name] for name in peers)
    exact = all(errors["ours"] <= errors[name] * ALIKE for name in peers)
    beside = [", ".join(f"{name} {one[name]:.3g}" for name in peers) for one in (times, errors)]
    return [
        Row(f"{NAMES[kernel]}: ns/(px*band)", f"{times['ours']:.2f}", "less than each", faster, beside[0]),
        Row(f"{NAMES[kernel]}: rmse / std", f"{errors['ours']:.4f}", "no larger than each", exact, beside[1]),
    ]


def _over_linear(scene: Turned) -> Row:
    """Compare the error of Catmull-Rom with that of cv2's linear kernel."""
    ours, theirs = scene.error(_ours(scene, "catmull-rom")()), scene.error(_cv2(scene, "bilinear")())
    name = "catmull-rom: error over cv2.remap linear, amplitude as period"
    return Row(name, f"{ours / theirs:.3f}", "<= 1/3", ours / theirs <= 1 / 3, f"{ours:.4f}, cv2 linear {theirs:.4f}")

"""Trade-off of the line model: where the samples of a line look, from no rotation to exact rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_normal, scene_to_direction
from pipeline.geometry.paper_equations import LINE_MODELS, LineModel, line_points, unlimited_position

FIELD_PX = 10240
LINES_APART_PX = 80.0

Floats = NDArray[np.float64]
Lines = list[tuple[Floats, Floats]]


@dataclass(frozen=True)
class Strips:
    """Lines of a full scan that the mirror reaches, strip by strip, and where they end."""

    camera: LineCamera
    centres: tuple[tuple[float, Floats], ...]  # strip and scan coordinate of its lines [px]
    ends: Lines  # along and scan, (line, 2) each [px]


def _prepare(_seed: int) -> Strips:
    camera = LineCamera()
    half, sides = FIELD_PX / 2, FIELD_PX // camera.samples
    scan = np.arange(-half, half + 1, LINES_APART_PX)
    centres = []
    for strip in (np.arange(sides) + 0.5) * camera.samples - half:
        tangents = np.stack([np.full_like(scan, strip), scan], axis=-1) * camera.ifov_rad
        position = unlimited_position(direction_to_normal(scene_to_direction(tangents)))
        centres.append((float(strip), scan[np.hypot(*position.T) <= 1]))
    ends = [_ends(*line_points("L4", *strip, camera)) for strip in centres]
    return Strips(camera, tuple(centres), ends)


def _ends(along: Floats, scan: Floats) -> tuple[Floats, Floats]:
    return along[:, [0, -1]], scan[:, [0, -1]]


def _run(state: Strips, model: Setting) -> Lines:
    return [line_points(cast("LineModel", model), strip, scan, state.camera) for strip, scan in state.centres]


def _judge(state: Strips, _model: Setting, out: Lines) -> float:
    pairs = zip(map(_ends, *zip(*out, strict=True)), state.ends, strict=True)
    return max(float(np.hypot(a - exact_a, b - exact_b).max()) for (a, b), (exact_a, exact_b) in pairs)


LINE_MODEL = register(
    Tradeoff(
        stage="rectify",
        knob="line model",
        error="greatest error at a line's end [px]",
        unit="px",
        reference=f"exact rays over {FIELD_PX} x {FIELD_PX} px, as far as the mirror reaches",
        settings=LINE_MODELS,
        prepare=_prepare,
        run=_run,
        judge=_judge,
        work=lambda state, _model: float(sum(len(scan) for _, scan in state.centres) * state.camera.samples),
        levels=lambda _state: (Level("half a pixel", 0.5),),
        moved_bytes=16.0,
    )
)

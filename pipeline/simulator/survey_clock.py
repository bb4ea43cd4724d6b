"""The survey's clock: when each sweep starts, one after the other as the plan prices them."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.geometry.vector_memory import memory_loads


def sweep_starts(
    sweeps: Sequence[Sweep], camera: LineCamera, cost: CostModel, *, after_s: float = 0.0
) -> dict[str, float]:
    """Give when the first line of each sweep begins, by the sweep's name, since the survey's start. [s]

    Before it come the sweeps before, a set-up for each and its own, and the loads of the vector memory until then.
    Lines of a sweep follow each other without a break: a load in the midst of one delays the next sweep only.

    Parameters
    ----------
    sweeps
        In the order in which they are taken.
    after_s
        What the survey has spent before: the fine sweeps come after the coarse ones' seconds.
    """
    loads_before: dict[int, int] = {}
    for number, load in enumerate(memory_loads(sweeps, cost.vector_pairs), 1):
        for part in load.parts:
            loads_before.setdefault(part.sweep, number)
    starts: dict[str, float] = {}
    lines = loads = 0
    for place, sweep in enumerate(sweeps):
        loads = loads_before.get(place, loads)
        spent = camera.scan_seconds(lines) + (place + 1) * cost.setup_seconds(camera) + loads * cost.reload_s
        starts[sweep.name] = after_s + spent
        lines += sweep.lines
    return starts

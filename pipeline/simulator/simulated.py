"""The simulated source: a scene as a rig sees it line by line, with the effects chosen, and when each sweep starts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep, line_positions, memory_loads
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.pointing import Pointing
from pipeline.simulator.instrument import BLOCK_LINES, USUAL, check_binning, render_lines, sweep_block, take_references
from pipeline.simulator.render import Choice
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import Scene
from pipeline.source import Line, References


@dataclass(frozen=True)
class SimulatedSource:
    """A source that looks at ``scene`` with ``rig``. Quantisation and saturation are always on: raw lines are uint16.

    Every effect draws from streams of its own, keyed (seed, sweep name, effect, line number): neither the first line
    asked for nor the order of sweeps nor other effects change a line.

    ``chosen`` are the effects that are on, {effect: variant}, in the order of the chain. ``clock`` says when sweeps
    start, by name, after the survey did [s]; None, and a sweep it does not name, is at once. With ``pointing`` the
    mirror looks beside the planned positions and still reports those.
    """

    scene: Scene
    rig: Rig
    seed: int = 0
    chosen: Mapping[Any, str] | Choice = USUAL
    name: str = "sim"
    clock: Mapping[str, float] | None = None
    pointing: Pointing | None = None

    def __post_init__(self) -> None:
        _ = self.choice  # refuses variants that effects do not have

    @cached_property
    def choice(self) -> Choice:
        """All effects that are on, pointing among them."""
        chosen = Choice.of(self.chosen)
        return chosen if self.pointing is None else Choice(((self.pointing, "exact"), *chosen.effects))

    @property
    def camera(self) -> LineCamera:
        """The rig's camera."""
        return self.rig.camera

    @property
    def wavelength_nm(self) -> NDArray[np.float64]:
        """(band,) centre wavelengths [nm]."""
        return self.scene.wavelength_nm

    @property
    def field_shape(self) -> tuple[int, int]:
        """(y, x) size of the field [px]."""
        return self.scene.shape

    def started_s(self, sweep: Sweep) -> float:
        """When a sweep starts, after the survey did [s]."""
        return 0.0 if self.clock is None else float(self.clock.get(sweep.name, 0.0))

    def block(self, sweep: Sweep, lines: range) -> SweepBlock:
        """Some lines of a sweep, as effects ask about them."""
        return sweep_block(self.scene, self.rig, sweep, lines, seed=self.seed, started_s=self.started_s(sweep))

    def render(self, sweep: Sweep, lines: range) -> NDArray[np.uint16]:
        """Give raw numbers (line, sample, band) of some lines; see `render_lines`."""
        started_s = self.started_s(sweep)
        return render_lines(self.scene, self.rig, self.choice, sweep, lines, seed=self.seed, started_s=started_s)

    def lines(self, sweep: Sweep, first: int = 0) -> Iterator[Line]:
        """Give the sweep's lines one by one, from line ``first`` on.

        Raises
        ------
        ShapeError : sums of ``sweep.binning`` samples at full scale do not fit uint16.
        PoseError : a position of the sweep is out of the mirror's reach.
        """
        check_binning(sweep, self.camera)
        for start in range(first, sweep.lines, BLOCK_LINES):
            yield from self.lines_of(sweep, range(start, min(start + BLOCK_LINES, sweep.lines)))

    def lines_of(self, sweep: Sweep, numbers: range) -> list[Line]:
        """Give some lines of the sweep, as `lines` does. Threads may ask at the same time.

        Raises
        ------
        ShapeError : sums of ``sweep.binning`` samples at full scale do not fit uint16.
        PoseError : a position of the sweep is out of the mirror's reach.
        """
        camera, middle = self.camera, line_positions(sweep, self.camera)
        return [
            Line(
                number=number,
                data=data,
                mirror_x=float(middle[number, 0]),
                mirror_y=float(middle[number, 1]),
                time_s=(number * camera.frame_ms + camera.exposure_ms / 2) * 1e-3,
                exposure_ms=camera.exposure_ms,
            )
            for number, data in zip(numbers, self.render(sweep, numbers), strict=True)
        ]

    def lines_again(self, sweep: Sweep, numbers: Sequence[int]) -> Iterator[Line]:
        """Give single lines that were given before: the same, bit for bit."""
        for number in numbers:
            yield from self.lines_of(sweep, range(number, number + 1))

    @property
    def record(self) -> None:
        """Nothing: the manifest of the effects tells all."""
        return None

    def references(self, sweep: Sweep) -> References:
        """Mean dark and white frames with the sweep's binning, as the effects that are on have them."""
        return take_references(self.scene, self.rig, self.choice, sweep)


@dataclass(frozen=True)
class SimulatedSweep:
    """The lines of one simulated sweep, made when they are read and never stored."""

    source: SimulatedSource
    sweep: Sweep

    @property
    def references(self) -> References:
        """Dark and white frames."""
        return self.source.references(self.sweep)

    @property
    def position(self) -> NDArray[np.float64]:
        """(line, 2) mirror X and Y at mid exposure."""
        return line_positions(self.sweep, self.source.camera)

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(line,) of mid exposure, since the start of the sweep [s]."""
        camera = self.source.camera
        return (np.arange(self.sweep.lines, dtype=np.float64) * camera.frame_ms + camera.exposure_ms / 2) * 1e-3

    @property
    def valid_line(self) -> NDArray[np.bool_]:
        """Every line can be used."""
        return np.ones(self.sweep.lines, bool)

    def read(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Make the lines ``start`` to ``stop``, (line, sample, band) uint16."""
        return self.source.render(self.sweep, range(start, min(stop, self.sweep.lines)))


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

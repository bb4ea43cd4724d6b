"""The simulated source: a scene as a rig sees it line by line, whatever the block, and the frames that calibrate it.

Calibration sees the detector and the spectrograph: dark current, response, smile, gains and defects of elements. The
rest stays in the data: stray light, blur and keystone, air, sky, and the sun's course.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import wire_positions
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep, exposing, line_positions, memory_loads
from spectralzoom.pipeline.simulator.effects.counting import DEFECTS, dead_elements, hot_electrons
from spectralzoom.pipeline.simulator.effects.effect import OFF, Chosen, SweepBlock
from spectralzoom.pipeline.simulator.effects.lighting import VIGNETTING
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.pipeline.simulator.effects.spectrometer import PRNU, RESPONSE, SMILE, STRIPING
from spectralzoom.pipeline.simulator.readout import dark_frame, read_out
from spectralzoom.pipeline.simulator.render import EFFECTS, USUAL, expected_light
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from spectralzoom.pipeline.source import AT_REST, Line, References

Raw = NDArray[np.uint16]
REFERENCE_FRAMES = 32  # of whole numbers, of which a dark or white frame is the mean
BLOCK_LINES = 16  # rendered at a time: 11 MB of light with 640 samples and 270 bands
TIMED_BLOCKS, TIMED_LINES = 3, 4  # at most, spread evenly over the lines of all sweeps, and lines of each
LINES_A_BLOCK = 512  # of a capture, for each timed block: the tables of a block take as long as hundreds of lines
Frame = NDArray[np.float32]
SEEN = frozenset({RESPONSE, SMILE, PRNU, STRIPING})  # by light of the white reference


@dataclass(frozen=True)
class SimulatedSource:
    """A source that looks at ``scene`` with ``rig``. Quantisation and saturation are always on: raw lines are uint16.

    Streams are keyed (seed, sweep name, effect, line number). So a line does not depend on the first line asked for,
    the order of sweeps, or other effects. ``clock`` says when sweeps start, by name, after the survey did [s]; a sweep
    it does not name is at once. With ``pointing`` the mirror looks beside the planned positions and reports those.
    Raises SettingsError: an effect has no such variant.
    """

    scene: RasterScene
    rig: Rig
    seed: int = 0
    chosen: Chosen = field(default_factory=USUAL.copy)
    clock: Mapping[str, float] | None = None
    pointing: PointingErrors | None = None
    name = "sim"
    effects = EFFECTS  # to choose from

    def __post_init__(self) -> None:
        for effect, variant in self.chosen.items():
            if variant not in (*effect.variants, OFF):
                raise SettingsError(f"effect {effect.name} has no variant {variant!r}; choose from {effect.variants}")

    @property
    def key(self) -> dict[str, Any]:
        """Return seed and pointing errors; a survey stores the chosen effects."""
        return {"seed": self.seed, "pointing": self.pointing}

    def with_effects(self, chosen: Chosen, clock: Mapping[str, float]) -> SimulatedSource:
        """Return the source with these effects, and the start of each sweep by its name [s]."""
        return replace(self, chosen=chosen, clock=clock)

    def opened(self, kept: Path) -> AbstractContextManager[SimulatedSource]:
        """Return the source itself, which has no device."""
        return nullcontext(self)

    @cached_property
    def active(self) -> Chosen:
        """Return all effects that are on, pointing among them."""
        on = {effect: variant for effect, variant in self.chosen.items() if variant != OFF}
        return on if self.pointing is None else {self.pointing: "exact"} | on

    @property
    def camera(self) -> LineCamera:
        return self.rig.camera

    @property
    def wavelength_nm(self) -> NDArray[np.float64]:
        return self.scene.wavelength_nm

    def started_s(self, sweep: Sweep) -> float:
        return 0.0 if self.clock is None else float(self.clock.get(sweep.name, 0.0))

    def render(self, sweep: Sweep, lines: range) -> Raw:
        """Return the raw numbers of some lines, (line, sample, band) uint16 [DN]. Threads may ask at the same time.

        Neither the other lines asked for nor the order of calls changes a number. Raises PoseError: a position is out
        of the mirror's reach.
        """
        raw = np.empty((len(lines), self.camera.samples, len(self.wavelength_nm)), np.uint16)
        started_s = self.started_s(sweep)
        for first in range(0, len(lines), BLOCK_LINES):
            some = slice(first, first + BLOCK_LINES)
            block = sweep_block(self.scene, self.rig, sweep, lines[some], seed=self.seed, started_s=started_s)
            raw[some] = read_out(expected_light(self.scene, block, self.active), block, self.active)
        return raw

    def lines(self, sweep: Sweep, first: int = 0) -> Iterator[Line]:
        """Yield the sweep's lines from line ``first`` on. Raises PoseError as `render`."""
        for start in range(first, sweep.lines, BLOCK_LINES):
            yield from self.lines_of(sweep, range(start, min(start + BLOCK_LINES, sweep.lines)))

    def lines_of(self, sweep: Sweep, numbers: range) -> list[Line]:
        """Return some lines of the sweep, as `lines` does. Threads may ask at the same time."""
        camera = exposing(self.camera, sweep)
        middle = wire_positions(line_positions(sweep, self.camera))
        return [
            Line(
                number=number,
                data=data,
                mirror_x=float(middle[number, 0]),
                mirror_y=float(middle[number, 1]),
                time_s=camera.mid_exposure_s(number),
                exposure_ms=camera.exposure_ms,
            )
            for number, data in zip(numbers, self.render(sweep, numbers), strict=True)
        ]

    def saved_seconds(
        self, exact: Chosen, sweeps: Sequence[Sweep], clock: Callable[[], float] = time.thread_time
    ) -> float:
        """Return the processor time [s] that the lines would take with the effects ``exact``, beyond what they take.

        Some lines are rendered by both choices in turn. A table of costs cannot tell it: effects share kernels, their
        costs depend on the light, and machines differ.
        """
        spent: dict[bool, float] = {True: 0.0, False: 0.0}
        numbers = [(sweep, line) for sweep in sweeps for line in range(sweep.lines)]
        timed, blocks = 0, min(TIMED_BLOCKS, 1 + len(numbers) // LINES_A_BLOCK)
        for block in range(blocks if numbers and dict(self.chosen) != dict(exact) else 0):
            sweep, line = numbers[(2 * block + 1) * len(numbers) // (2 * blocks)]
            lines = range(line, sweep.lines)[:TIMED_LINES]
            for every, source in ((True, replace(self, chosen=exact)), (False, self)):
                source.render(sweep, lines[:1])  # makes the tables of the sweep
                start = clock()
                source.render(sweep, lines)
                spent[every] += clock() - start
            timed += len(lines)
        return len(numbers) * (spent[True] - spent[False]) / max(timed, 1)

    def references(self, sweep: Sweep) -> References:
        """Return means of dark and white frames (sample, band), free of noise [DN]; dead and hot elements are bad.

        The white frame is scaled from a shorter exposure, so that it does not saturate, and taken with the mirror at
        rest, by the light of the survey's start. The white reference's values are in the rig's bands.
        """
        rig = self.rig.taking(sweep)
        block = sweep_block(self.scene, rig, AT_REST, range(1))
        dark = dark_frame(block, self.active)
        light = np.full((1, rig.camera.samples, len(block.wavelength_nm)), block.white_e, np.float32)
        for effect in (one for one in self.active if one in SEEN):
            if hasattr(effect, "gain"):
                light = light * effect.gain(block, self.active[effect])
            else:
                light = effect.change(light, block, self.active[effect])
        seen: Frame = light[0]
        bad = None
        if DEFECTS in self.active:
            dead = dead_elements(rig, seen.shape[1])
            seen[dead] = 0
            elements = dead | (hot_electrons(rig, seen.shape[1]) > 0)
            bad = elements if elements.any() else None
        white_reference = self.scene.white_reference.astype(np.float32)
        if RESPONSE in self.active:
            white_reference = RESPONSE.change(white_reference[None, None], block, self.active[RESPONSE])[0, 0]
        return References(
            dark=_rounded(dark),
            white=_rounded(dark + seen / np.float32(rig.camera.electrons_per_dn)),
            white_reference=white_reference,
            bad=bad,
            by_mirror=VIGNETTING in self.active,
        )


@dataclass(frozen=True)
class SimulatedSweep:
    """The lines of one simulated sweep, made when they are read and never stored."""

    source: SimulatedSource
    sweep: Sweep

    @property
    def references(self) -> References:
        return self.source.references(self.sweep)

    @property
    def position(self) -> NDArray[np.float64]:
        return wire_positions(line_positions(self.sweep, self.source.camera)).astype(np.float64)

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Return the time of each line at mid exposure, since the start of the sweep [s]."""
        return exposing(self.source.camera, self.sweep).mid_exposure_s(np.arange(self.sweep.lines, dtype=np.float64))

    @property
    def exposure_ms(self) -> NDArray[np.float64]:
        return np.full(self.sweep.lines, exposing(self.source.camera, self.sweep).exposure_ms)

    @property
    def valid_line(self) -> NDArray[np.bool_]:
        return np.ones(self.sweep.lines, bool)

    def read(self, start: int, stop: int, samples: slice = slice(None)) -> NDArray[np.uint16]:
        """Make the lines ``start`` to ``stop``, (line, sample, band) uint16."""
        return self.source.render(self.sweep, range(start, min(stop, self.sweep.lines)))[:, samples]


def sweep_starts(
    sweeps: Sequence[Sweep], camera: LineCamera, cost: CostModel, *, after_s: float = 0.0
) -> dict[str, float]:
    """Return when the first line of each sweep begins, by the sweep's name, since the survey's start. [s]

    ``sweeps`` are in the order in which they are taken, ``after_s`` is what the survey has spent before. The sweeps
    before, their set-ups and loads of the vector memory come first; a load within a sweep delays the next one only.
    """
    loads_before: dict[int, int] = {}
    for number, load in enumerate(memory_loads(sweeps, cost.vector_pairs), 1):
        for part in load.parts:
            loads_before.setdefault(part.sweep, number)
    starts: dict[str, float] = {}
    taken: dict[LineCamera, tuple[int, int]] = {}
    loads = 0
    for place, sweep in enumerate(sweeps):
        loads = loads_before.get(place, loads)
        exposed = exposing(camera, sweep)
        lines, count = taken.get(exposed, (0, 0))
        taken[exposed] = lines, count + 1
        starts[sweep.name] = after_s + (cost.line_seconds(taken) + loads * cost.reload_s)
        taken[exposed] = lines + sweep.lines, count + 1
    return starts


def sweep_block(
    scene: RasterScene, rig: Rig, sweep: Sweep, lines: range, *, seed: int = 0, started_s: float = 0.0
) -> SweepBlock:
    """Return some lines of a sweep, which starts ``started_s`` after the survey did, as effects ask about them."""
    rig = rig.taking(sweep)
    white = scene.white_reference_electrons.astype(np.float64) * (rig.camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    return SweepBlock(rig, sweep, lines, scene.wavelength_nm, scene.shape, seed, started_s, scene.fwhm_nm, white)


def _rounded(frame: Frame) -> Frame:
    """Return a frame rounded as a mean of `REFERENCE_FRAMES` frames of whole numbers is."""
    return (np.floor(frame.astype(np.float64) * REFERENCE_FRAMES + 0.5) / REFERENCE_FRAMES).astype(np.float32)

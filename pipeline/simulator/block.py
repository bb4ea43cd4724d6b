"""Some lines of one sweep as a rig takes them: what effects may ask about where and when, and their random streams."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mirror import position_to_normal
from pipeline.geometry.scan import Sweep, line_positions, sweep_positions
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SweepBlock:
    """Lines ``lines`` (numbers within the sweep) and samples ``samples`` (of the camera, before binning).

    A line's result never depends on which others are in the block, nor a sample's. ``started_s`` is when the sweep
    starts, counted from the survey's start.
    """

    rig: Rig
    sweep: Sweep
    lines: range
    wavelength_nm: Floats  # (band,)
    shape: tuple[int, int]  # of the scene [px]
    seed: int = 0
    samples: range | None = None  # None is all of the camera
    started_s: float = 0.0
    fwhm_nm: Floats | None = None  # (band,) of the scene's own bands; None where not known
    white_e: Floats | None = None  # (band,) electrons of the white panel in one exposure; None where not known

    @property
    def numbers(self) -> NDArray[np.int64]:
        """(line,) numbers within the sweep."""
        return np.arange(self.lines.start, self.lines.stop, self.lines.step, dtype=np.int64)

    @property
    def columns(self) -> NDArray[np.int64]:
        """(sample,) of the camera."""
        taken = range(self.rig.camera.samples) if self.samples is None else self.samples
        return np.arange(taken.start, taken.stop, taken.step, dtype=np.int64)

    @property
    def slopes(self) -> Floats:
        """(sample,) tangent of each sample's ray along the line."""
        return self.rig.camera.pixel_slopes()[self.columns]

    @property
    def time_s(self) -> Floats:
        """(line,) of mid exposure, since the survey's start [s]."""
        camera = self.rig.camera
        return self.started_s + (self.numbers.astype(np.float64) * camera.frame_ms + camera.exposure_ms / 2) * 1e-3

    @cached_property
    def positions(self) -> Floats:
        """(line, step, 2) device X and Y that are held, as planned."""
        return sweep_positions(self.sweep, self.rig.camera)[self.numbers]

    @cached_property
    def middle(self) -> Floats:
        """(line, 2) device X and Y at mid exposure, as planned."""
        return line_positions(self.sweep, self.rig.camera)[self.numbers]

    @cached_property
    def normals(self) -> Floats:
        """(line, 3) of the mirror at mid exposure, as planned; ``-n_z`` is the cosine of incidence of the chief ray."""
        # Of the whole sweep: the product with the axes rounds otherwise for a single line than for several.
        whole: Floats = position_to_normal(line_positions(self.sweep, self.rig.camera))
        return whole[self.numbers]

    @property
    def scan_px(self) -> Floats:
        """(line,) scan coordinate at mid exposure [px]."""
        centres: Floats = self.sweep.line_px()[self.numbers]
        return centres

    def stream(self, effect: str, number: int) -> np.random.Generator:
        """Give an effect's random stream at one line: blocks, order and other effects never change it."""
        return _stream(self.seed, self.sweep.name, effect, number)


def sweep_stream(seed: int, sweep: str, effect: str) -> np.random.Generator:
    """Give the stream of one effect for a whole sweep."""
    return _stream(seed, sweep, effect)


def unit_stream(unit: int, effect: str) -> np.random.Generator:
    """Give the stream of what belongs to one copy of the rig, whatever it looks at: its fixed patterns."""
    return _stream(unit, effect)


def _stream(entropy: int, *key: str | int) -> np.random.Generator:
    """Give a stream whose key is hashed to its state; words of SFC64 take half the time of a counter-based Philox."""
    words = [zlib.crc32(one.encode()) if isinstance(one, str) else one for one in key]
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(entropy=entropy, spawn_key=words)))

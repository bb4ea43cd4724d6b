"""Read lines of a sweep as scene values or scores, only those that are needed.

Raw lines are cached for neighbouring tiles in blocks of whole shards; the least recently used block is dropped first.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.signal.calibrate import Elements, calibrate, judge_elements
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.source import SweepLines

BLOCK_LINES = 64  # a shard of a stored sweep: one line of it takes as long to read as all
CHUNK_SAMPLES = 32  # likewise along the line

Raw = NDArray[np.integer[Any]]  # numbers of the camera, or scores in steps
ReadWindow = Callable[[slice, slice], Raw]  # (lines, samples) -> (line, sample, band)


@dataclass(frozen=True)
class Signal:
    """A sweep's lines in scene values, calibrated as they are read."""

    lines: SweepLines
    gain: NDArray[np.float32] | None = None  # (band,) what the sweep's values are multiplied by

    @property
    def samples(self) -> int:
        """Return the samples of a line."""
        return len(self.lines.references.dark)

    @property
    def bands(self) -> int:
        """Return the bands of a line."""
        return len(self.lines.references.white_reference)

    @cached_property
    def elements(self) -> Elements:
        """Return the detector's elements, judged by all of the references, with the gain in their white reference."""
        plain = self.lines.references
        if self.gain is None:
            return judge_elements(plain)
        return judge_elements(replace(plain, white_reference=(plain.white_reference * self.gain).astype(np.float32)))

    def spectra(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the scene values of resampled ones: the same."""
        return values

    def values(
        self, read: ReadWindow, numbers: NDArray[np.intp], samples: slice, full_scale_dn: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Read and calibrate some lines and samples; return values and validity as `calibrate` does.

        Lines that are not valid are out. With elements to fill whole lines are read, since an element may be filled
        from beyond the samples. ``full_scale_dn`` is the camera's, of one sample.
        """
        whole = len(self.elements.fill.element) > 0
        elements = self.elements if whole else self.elements.part(samples)
        raw = _raw_of(read, numbers, slice(0, self.samples) if whole else samples)
        position, exposure_ms = self.lines.position[numbers], self.lines.exposure_ms[numbers]
        saturated = full_scale_dn * self.lines.sweep.binning
        values, valid = calibrate(raw, elements, saturated_dn=saturated, position=position, exposure_ms=exposure_ms)
        if whole:
            values, valid = values[:, samples], valid[:, samples]
        return values, valid & self.lines.valid_line[numbers].reshape(-1, *[1] * (valid.ndim - 1))


@runtime_checkable
class CondensedLines(SweepLines, Protocol):
    """The lines of a sweep as scores of components, which it reads in steps, (line, sample, component)."""

    @property
    def components(self) -> Components:
        """Return the law that restores spectra."""

    @property
    def step(self) -> float:
        """Return the size of one step of a stored score."""

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Return (line, sample) spectra that can be used."""

    @property
    def source(self) -> str:
        """Return the name of the source of its lines."""


@dataclass(frozen=True)
class CondensedSignal:
    """A condensed sweep's lines in scores: they are resampled and blended as scene values are."""

    lines: CondensedLines
    gain: NDArray[np.float32] | None = None  # (band,) what the sweep's values are multiplied by

    @property
    def samples(self) -> int:
        """Return the samples of a line."""
        return int(self.lines.usable.shape[1])

    @property
    def bands(self) -> int:
        """Return the components of a line."""
        return len(self.lines.components)

    @cached_property
    def _gain(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        return None if self.gain is None else self.lines.components.scaled(self.gain)

    def spectra(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the scene values (..., band) of resampled scores (..., component)."""
        return self.lines.components.restore(values)

    def values(
        self, read: ReadWindow, numbers: NDArray[np.intp], samples: slice, full_scale_dn: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Read (line, sample, component) scores of some lines, and which (line, sample) can be used."""
        scores = _raw_of(read, numbers, samples).astype(np.float32) * np.float32(self.lines.step)
        if self._gain is not None:
            matrix, shift = self._gain
            scores = scores @ matrix + shift
        return scores, self.lines.usable[numbers, samples] & self.lines.valid_line[numbers, None]


def signal_of(lines: SweepLines, gain: NDArray[np.float32] | None = None) -> Signal | CondensedSignal:
    """Return the calibrated values of raw lines, or the scores of condensed ones."""
    return CondensedSignal(lines, gain) if isinstance(lines, CondensedLines) else Signal(lines, gain)


@dataclass
class _Block:
    """One block of one sweep: its raw numbers once read, and the lock of the thread that reads it."""

    lines: SweepLines  # held so that its id stays its own
    raw: Raw | None = None
    reading: threading.Lock = field(default_factory=threading.Lock)


class LineCache:
    """Cache of blocks of 64 raw lines of any number of sweeps, at most ``most_bytes``. Threads may share it.

    Two threads that need the same block wait for one read. ``reads`` counts blocks read, ``bytes_held`` the cached
    bytes.
    """

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self.bytes_held = 0
        self._blocks: OrderedDict[tuple[int, int, int, int], _Block] = OrderedDict()  # sweep, block, samples held
        self._lock = threading.Lock()

    def window(self, lines: SweepLines, wanted: slice, samples: slice, *, likely: slice | None = None) -> Raw:
        """Return raw numbers (line, sample, band) of some lines and samples, from the cache or read now; read-only.

        ``likely`` are samples that later calls will need of the same lines. They are read together, and calls that name
        the same ones share them.
        """
        held = held_samples(lines, samples, likely)
        within = slice(samples.start - held.start, samples.stop - held.start)
        parts = []
        for number in line_blocks(wanted):
            origin = number * BLOCK_LINES
            rows = slice(max(wanted.start - origin, 0), min(wanted.stop - origin, BLOCK_LINES))
            parts.append(self._block(lines, number, held)[rows, within])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _block(self, lines: SweepLines, number: int, samples: slice) -> Raw:
        key = (id(lines), number, samples.start, samples.stop)
        with self._lock:
            block = self._blocks.setdefault(key, _Block(lines))
            self._blocks.move_to_end(key)
        with block.reading:
            if block.raw is None:
                stop = min((number + 1) * BLOCK_LINES, len(lines.valid_line))
                raw = lines.read(number * BLOCK_LINES, stop, samples)
                with self._lock:
                    block.raw = raw
                    self.bytes_held += raw.nbytes
                    for old, held in list(self._blocks.items()):  # the newest and those still being read stay
                        if self.bytes_held > self.most_bytes and old != key and held.raw is not None:
                            self.bytes_held -= held.raw.nbytes
                            del self._blocks[old]
            return block.raw


def line_blocks(lines: slice) -> range:
    """Return the numbers of the blocks that hold some lines."""
    return range(lines.start // BLOCK_LINES, -(-lines.stop // BLOCK_LINES))


def held_samples(lines: SweepLines, samples: slice, likely: slice | None = None) -> slice:
    """Return the samples to read and cache: whole chunks of those wanted and likely."""
    count = signal_of(lines).samples
    other = samples if likely is None else likely
    first, stop = min(samples.start, other.start), max(samples.stop, other.stop)
    return slice(first // CHUNK_SAMPLES * CHUNK_SAMPLES, min(-(-stop // CHUNK_SAMPLES) * CHUNK_SAMPLES, count))


def _raw_of(read: ReadWindow, members: NDArray[np.intp], samples: slice) -> Raw:
    """Return raw numbers of the lines ``members``, in their order."""
    first, last = int(members.min()), int(members.max()) + 1
    raw = read(slice(first, last), samples)
    if last - first == len(members):
        if (np.diff(members) == 1).all():
            return raw
        if (np.diff(members) == -1).all():
            return raw[::-1]
    return raw[members - first]

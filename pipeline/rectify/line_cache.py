"""Raw lines kept while neighbouring tiles still need them: blocks of whole shards, least recently used out first."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pipeline.source import SweepLines

BLOCK_LINES = 64  # a shard of a stored sweep: reading one line of it costs as much as reading all
CHUNK_SAMPLES = 32  # likewise across

_Key = tuple[int, int, int, int]  # sweep, block, samples held
Raw = NDArray[np.uint16]
ReadWindow = Callable[[slice, slice], Raw]  # (lines, samples) -> (line, sample, band)


@runtime_checkable
class WindowedLines(Protocol):
    """A sweep that can be read a part of its samples at a time."""

    def read_window(self, lines: slice, samples: slice) -> Raw:
        """Raw numbers of some lines and samples, (line, sample, band)."""


@dataclass
class _Block:
    """One block of one sweep: its raw numbers once read, None before, and what threads wait on for them."""

    lines: SweepLines  # held so that its id stays its own
    raw: Raw | None = None
    reading: threading.Lock = field(default_factory=threading.Lock)


class LineCache:
    """Blocks of 64 raw lines of any number of sweeps, at most ``most_bytes`` of them. Threads may share it.

    Two threads that want the same block wait for one read. ``reads`` counts blocks read, ``bytes_held`` what is kept.
    """

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self.reads = 0
        self.bytes_held = 0
        self._blocks: OrderedDict[_Key, _Block] = OrderedDict()
        self._lock = threading.Lock()

    def window(self, lines: SweepLines, wanted: slice, samples: slice, *, likely: slice | None = None) -> Raw:
        """Give raw numbers (line, sample, band) of some lines and samples, read before or now; not to be written to.

        ``likely`` are samples that later calls will want of the same lines: they are read together, and only calls that
        name the same ones share what was read.
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
                rows = slice(number * BLOCK_LINES, min((number + 1) * BLOCK_LINES, len(lines.valid_line)))
                if isinstance(lines, WindowedLines):
                    raw = lines.read_window(rows, samples)
                else:
                    raw = lines.read(rows.start, rows.stop)
                with self._lock:
                    block.raw = raw
                    self.reads += 1
                    self.bytes_held += raw.nbytes
                    for old, held in list(self._blocks.items()):  # the newest and those still being read stay
                        if self.bytes_held > self.most_bytes and old != key and held.raw is not None:
                            self.bytes_held -= held.raw.nbytes
                            del self._blocks[old]
            return block.raw


def line_blocks(lines: slice) -> range:
    """Numbers of the blocks that hold some lines."""
    return range(lines.start // BLOCK_LINES, -(-lines.stop // BLOCK_LINES))


def held_samples(lines: SweepLines, samples: slice, likely: slice | None = None) -> slice:
    """Samples to read and hold: those wanted and likely, in whole chunks; all of a sweep read by whole lines."""
    count = lines.references.dark.shape[0]
    if not isinstance(lines, WindowedLines):
        return slice(0, count)
    other = samples if likely is None else likely
    first, stop = min(samples.start, other.start), max(samples.stop, other.stop)
    return slice(first // CHUNK_SAMPLES * CHUNK_SAMPLES, min(-(-stop // CHUNK_SAMPLES) * CHUNK_SAMPLES, count))

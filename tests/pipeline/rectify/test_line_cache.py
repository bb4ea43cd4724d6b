"""Line cache: what is read, what is kept, what is let go, and threads that want the same."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.rectify.line_cache import LineCache

LINES, SAMPLES, BANDS = 300, 100, 2
BLOCK_BYTES = 64 * SAMPLES * BANDS * 2


@dataclass
class Numbered:
    """Lines whose numbers say where they lie; notes what is read, slowly if asked."""

    delay_s: float = 0.0
    asked: list[tuple[int, int]] = field(default_factory=list)
    valid_line: np.ndarray = field(default_factory=lambda: np.ones(LINES, np.bool_))
    references: Any = field(default_factory=lambda: SimpleNamespace(dark=np.zeros((SAMPLES, BANDS), np.float32)))
    raw: np.ndarray = field(
        default_factory=lambda: (
            np.arange(LINES * SAMPLES * BANDS, dtype=np.uint32).astype(np.uint16).reshape(LINES, SAMPLES, BANDS)
        )
    )

    def read(self, start: int, stop: int) -> np.ndarray:
        """Whole lines."""
        time.sleep(self.delay_s)
        self.asked.append((start, stop))
        return self.raw[start:stop]


@given(st.integers(0, LINES - 1), st.integers(1, LINES), st.integers(0, SAMPLES - 1), st.integers(1, SAMPLES))
@settings(max_examples=40, deadline=None)
def test_a_window_is_that_part_of_the_lines(first: int, count: int, left: int, width: int) -> None:
    """Any range of lines and samples comes back as it is, from however many blocks."""
    lines = Numbered()
    wanted, samples = slice(first, min(first + count, LINES)), slice(left, min(left + width, SAMPLES))
    window = LineCache(0).window(lines, wanted, samples)  # type: ignore[arg-type]
    np.testing.assert_array_equal(window, lines.raw[wanted, samples])


def test_the_block_used_longest_ago_goes_first() -> None:
    """With room for two blocks, the one just used again outlives one used before it."""
    lines, cache = Numbered(), LineCache(2 * BLOCK_BYTES)
    for block in (0, 1, 0, 2, 0, 1):
        cache.window(lines, slice(block * 64, block * 64 + 5), slice(0, 10))  # type: ignore[arg-type]
        assert cache.bytes_held <= cache.most_bytes
    assert [start // 64 for start, _ in lines.asked] == [0, 1, 2, 1]


def test_the_newest_block_stays_even_without_room() -> None:
    """A cache too small for one block still keeps the last one read, for who reads on in it."""
    lines, cache = Numbered(), LineCache(0)
    for first in (0, 5, 70, 80):
        cache.window(lines, slice(first, first + 5), slice(0, 10))  # type: ignore[arg-type]
    assert [start // 64 for start, _ in lines.asked] == [0, 1]


def test_a_block_being_read_is_not_let_go() -> None:
    """While one thread reads a block another fills a full cache: both get their lines."""
    started, go = threading.Event(), threading.Event()

    class Held(Numbered):
        def read(self, start: int, stop: int) -> np.ndarray:
            if start == 0:
                started.set()
                go.wait(10)
            return super().read(start, stop)

    lines, cache = Held(), LineCache(0)
    got: list[np.ndarray] = []
    slow = threading.Thread(target=lambda: got.append(cache.window(lines, slice(0, 4), slice(0, 4))))  # type: ignore[arg-type]
    slow.start()
    assert started.wait(10)
    try:
        other = cache.window(lines, slice(70, 74), slice(0, 4))  # type: ignore[arg-type]
    finally:
        go.set()
        slow.join()
    np.testing.assert_array_equal(other, lines.raw[70:74, :4])
    np.testing.assert_array_equal(got[0], lines.raw[:4, :4])


def test_sweeps_do_not_share_blocks() -> None:
    """The same lines of two sweeps are two blocks."""
    one, other, cache = Numbered(), Numbered(), LineCache(2**20)
    other.raw = other.raw + np.uint16(1)
    first, second = (cache.window(lines, slice(0, 4), slice(0, 4)) for lines in (one, other))  # type: ignore[arg-type]
    np.testing.assert_array_equal(second, first + 1)


def test_threads_wait_for_one_read() -> None:
    """Eight threads that want the same block at once cause one read, and all get it."""
    lines, cache = Numbered(delay_s=0.05), LineCache(2**20)
    got: list[np.ndarray] = []
    threads = [
        threading.Thread(target=lambda: got.append(cache.window(lines, slice(70, 80), slice(0, 9))))  # type: ignore[arg-type]
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert lines.asked == [(64, 128)]
    assert all((window == lines.raw[70:80, :9]).all() for window in got)
    assert len(got) == 8


def test_a_failed_read_is_tried_again() -> None:
    """An error reaches who asked, and does not stay in the cache."""
    lines, cache = Numbered(), LineCache(2**20)
    whole, lines.raw = lines.raw, None  # type: ignore[assignment]
    try:
        cache.window(lines, slice(0, 4), slice(0, 4))  # type: ignore[arg-type]
    except TypeError:
        lines.raw = whole
    np.testing.assert_array_equal(cache.window(lines, slice(0, 4), slice(0, 4)), whole[:4, :4])  # type: ignore[arg-type]

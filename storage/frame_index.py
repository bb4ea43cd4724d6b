"""Frame indices of Headwall cameras: which frame was taken when.

``frameIndex_<n>.txt`` lies beside ``raw_<n>``: a heading, then a line a frame with its number and its time in
microseconds. Versions of the camera's program differ in what stands between the two (a tab or spaces) and in the line
ends; frames may be missing or listed twice. Tested on small files made in these layouts.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError

LONGEST_LINE = 1000  # characters; a frame's line has about 25
_LARGEST = 2**62
_WHOLE = re.compile(r"-?\d{1,19}")


@dataclass(frozen=True)
class FrameIndex:
    """Frames by ascending number, each once."""

    frame: NDArray[np.int64]  # (entry,)
    stamp_us: NDArray[np.int64]  # (entry,) microseconds, of an origin that the file does not say
    exposure_ms: NDArray[np.float64] | None  # (entry,) where the heading names such a column
    notes: tuple[str, ...]


@dataclass(frozen=True)
class LineTimes:
    """What an index says of the lines of one file; -1 or NaN where it says nothing."""

    frame: NDArray[np.int64]  # (line,)
    stamp_us: NDArray[np.int64]  # (line,)
    exposure_ms: NDArray[np.float64]  # (line,)
    notes: tuple[str, ...]


def load_frame_index(path: Path) -> FrameIndex:
    """Read one index. Lines that are no frame are passed over and counted; of a frame listed twice the first counts.

    Raises
    ------
    SceneError : the file cannot be read, or no line of it is a frame.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            heading, rows, odd = _rows(iter(lambda: file.readline(LONGEST_LINE), ""))
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error}; take it away to go on without times") from error
    if not rows:
        raise SceneError(f"{path} lists no frame, expected lines of number and microseconds; take it away or repair it")
    numbers, first = np.unique(np.array([row[0] for row in rows], np.int64), return_index=True)
    notes = [f"{path.name}: {odd} lines are no frames"] if odd else []
    if len(numbers) < len(rows):
        notes.append(f"{path.name}: {len(rows) - len(numbers)} frames are listed twice, the first counts")
    column = _exposure_column(heading)
    exposures = None if column is None else np.array([_number(row[1], column) for row in rows])[first]
    stamps = np.array([row[2] for row in rows], np.int64)[first]
    if (np.diff(stamps) < 0).any():
        notes.append(f"{path.name}: time goes back {np.count_nonzero(np.diff(stamps) < 0)} times")
    return FrameIndex(numbers, stamps, exposures, tuple(notes))


def times_of_lines(index: FrameIndex, first_frame: int, lines: int) -> LineTimes:
    """Give each of a file's ``lines`` its frame and time.

    Lines are frames in order, the first of them ``first_frame`` (the number in the file's name). Where as many frames
    are listed as there are lines, they are its lines whatever their numbers: the camera dropped those missing. An index
    whose numbers begin at 0 in a later file counts from that file's start.
    """
    if len(index.frame) == lines:
        exposure = np.full(lines, np.nan) if index.exposure_ms is None else index.exposure_ms
        dropped = int(index.frame[-1] - index.frame[0]) + 1 - lines
        notes = (f"{dropped} frames between the first and the last were dropped by the camera",) if dropped else ()
        return LineTimes(index.frame, index.stamp_us, exposure, notes)
    origin = 0 if index.frame[0] == 0 else first_frame
    found = LineTimes(np.full(lines, -1), np.full(lines, -1), np.full(lines, np.nan), ())
    place = index.frame - origin
    inside = (place >= 0) & (place < lines)
    found.frame[place[inside]] = index.frame[inside]
    found.stamp_us[place[inside]] = index.stamp_us[inside]
    if index.exposure_ms is not None:
        found.exposure_ms[place[inside]] = index.exposure_ms[inside]
    return LineTimes(found.frame, found.stamp_us, found.exposure_ms, _count_notes(inside, lines))


def _count_notes(inside: NDArray[np.bool_], lines: int) -> tuple[str, ...]:
    told, beyond = int(np.count_nonzero(inside)), int(np.count_nonzero(~inside))
    notes = [] if told == lines else [f"the frame index tells the time of {told} of {lines} lines"]
    return (*notes, *([f"the frame index lists {beyond} frames beyond the lines"] if beyond else []))


def _rows(lines: Iterator[str]) -> tuple[list[str], list[tuple[int, list[str], int]], int]:
    """Heading, (frame, words, stamp) of each frame, and how many lines are neither."""
    heading: list[str] = []
    rows: list[tuple[int, list[str], int]] = []
    odd = 0
    for number, line in enumerate(lines):
        words = [word for word in re.split(r"[\t ,;]+", line.strip()) if word]
        if len(words) >= 2 and all(_WHOLE.fullmatch(word) for word in words[:2]):
            frame, stamp = int(words[0]), int(words[1])
            if 0 <= frame < _LARGEST and 0 <= stamp < _LARGEST:
                rows.append((frame, words, stamp))
                continue
        if number == 0:
            heading = [word.lower() for word in re.split(r"\t|,|;| {2,}|(?<=\S) (?=\S)", line.strip()) if word]
        elif words:
            odd += 1
    return heading, rows, odd


def _exposure_column(heading: list[str]) -> int | None:
    return next((column for column, word in enumerate(heading) if column > 1 and word.startswith("exposure")), None)


def _number(words: list[str], column: int) -> float:
    try:
        return float(words[column])
    except (ValueError, IndexError):
        return float("nan")

"""Frame indices of Headwall cameras: which frame was taken when.

``frameIndex_<n>.txt`` lies beside ``raw_<n>``: a heading, then a line a frame with its number and its time in
microseconds. Versions of the camera's program differ in what stands between the two (a tab or spaces) and in the line
ends; frames may be missing or listed twice. Lines of text come in here; files are opened in storage. Tested on small
indices made in these layouts.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError

LONGEST_LINE = 1000  # characters; a frame's line has about 25
_LARGEST = 2**62
_WHOLE = re.compile(r"-?\d{1,19}")
_BETWEEN_COLUMNS = re.compile(r"[\t,;]+|\s{2,}")  # where a heading has such; a single space may stand in a name
_MS = {"us": 1e-3, "µs": 1e-3, "μs": 1e-3, "microseconds": 1e-3, "s": 1e3, "sec": 1e3, "seconds": 1e3}


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


@dataclass
class _Rows:
    """Lines of an index, as they stand in it."""

    frame: array[int] = field(default_factory=lambda: array("q"))
    stamp: array[int] = field(default_factory=lambda: array("q"))
    exposure_ms: array[float] | None = None
    odd: int = 0  # lines that are no frame


def parse_frame_index(lines: Iterable[str], name: str = "the frame index", where: str = "") -> FrameIndex:
    """Read an index's lines; what is no frame is passed over and counted, of a frame listed twice the first counts.

    Parameters
    ----------
    name
        What notes call it.
    where
        What messages call it, where its name alone does not say.

    Raises
    ------
    SceneError : no line is a frame.
    """
    rows = _rows(lines)
    if not rows.frame:
        raise SceneError(
            f"{where or name} lists no frame, expected lines of number and microseconds; take it away or repair it"
        )
    numbers, first = np.unique(np.array(rows.frame, np.int64), return_index=True)
    notes = [f"{name}: {rows.odd} lines are no frames"] if rows.odd else []
    if len(numbers) < len(rows.frame):
        notes.append(f"{name}: {len(rows.frame) - len(numbers)} frames are listed twice, the first counts")
    exposures = None if rows.exposure_ms is None else np.array(rows.exposure_ms)[first]
    stamps = np.array(rows.stamp, np.int64)[first]
    if (np.diff(stamps) < 0).any():
        notes.append(f"{name}: time goes back {np.count_nonzero(np.diff(stamps) < 0)} times")
    return FrameIndex(numbers, stamps, exposures, tuple(notes))


def times_of_lines(index: FrameIndex, first_frame: int, lines: int, lost: int = 0) -> LineTimes:
    """Give each of a file's ``lines`` its frame and time.

    Lines are frames in order, the first of them ``first_frame`` (the number in the file's name). Where as many frames
    are listed as there are lines, they are its lines whatever their numbers: the camera dropped those missing. So they
    are where as many are listed as there were lines before the file lost its last ``lost`` ones. An index whose numbers
    begin at 0 in a later file counts from that file's start.
    """
    if len(index.frame) in (lines, lines + lost):
        exposure = np.full(lines, np.nan) if index.exposure_ms is None else index.exposure_ms[:lines]
        dropped = int(index.frame[-1] - index.frame[0]) + 1 - len(index.frame)
        notes = (f"{dropped} frames between the first and the last were dropped by the camera",) if dropped else ()
        return LineTimes(index.frame[:lines], index.stamp_us[:lines], exposure, notes)
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


def _rows(lines: Iterable[str]) -> _Rows:
    """Numbers of all lines that are frames; other lines are counted."""
    rows = _Rows()
    column, scale = None, 1.0
    for number, line in enumerate(lines):
        words = [word for word in re.split(r"[\t ,;]+", line.strip()) if word]
        if len(words) >= 2 and all(_WHOLE.fullmatch(word) for word in words[:2]):
            frame, stamp = int(words[0]), int(words[1])
            if 0 <= frame < _LARGEST and 0 <= stamp < _LARGEST:
                rows.frame.append(frame)
                rows.stamp.append(stamp)
                if rows.exposure_ms is not None and column is not None:
                    rows.exposure_ms.append(_number(words, column) * scale)
                continue
        if number == 0:
            column, scale = _exposure_column(line.strip().lower())
            rows.exposure_ms = None if column is None else array("d")
        elif words:
            rows.odd += 1
    return rows


def _exposure_column(heading: str) -> tuple[int | None, float]:
    """Which column holds exposures, and what one of its units is in ms; they are ms where nothing is said."""
    titles = [word for word in _BETWEEN_COLUMNS.split(heading) if word]
    if len(titles) < 2:
        titles = heading.split()
    column = next((at for at, word in enumerate(titles) if at > 1 and word.strip().startswith("exposure")), None)
    unit = "" if column is None else re.sub(r"^exposure[^(\[]*[(\[]?|[)\]\s]+$", "", titles[column].strip())
    return column, _MS.get(unit, 1.0)


def _number(words: list[str], column: int) -> float:
    try:
        return float(words[column])
    except (ValueError, IndexError):
        return float("nan")

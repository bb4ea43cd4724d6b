"""Frame indices beside a camera's cubes.

``frameIndex_<n>.txt`` belongs to ``raw_<n>``: a heading, then one line per frame with its number and its time in
microseconds. Versions of the camera's program differ in the separator (a tab or spaces) and in the line ends. Frames
may be missing or listed twice. It was tested on small indices made in these layouts.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError

FRAME_INDEX = re.compile(r"frameindex_(\d{1,12})\.txt", re.IGNORECASE)  # names of its files
_LARGEST = 2**62
_WHOLE = re.compile(r"-?\d{1,19}")


@dataclass(frozen=True)
class FrameIndex:
    """Frames by ascending number, each once."""

    frame: NDArray[np.int64]  # (entry,)
    stamp_us: NDArray[np.int64]  # (entry,) microseconds, of an origin that the file does not say
    notes: tuple[str, ...]


@dataclass(frozen=True)
class LineTimes:
    """Times of the lines of one file by its index; -1 where it has none."""

    frame: NDArray[np.int64]  # (line,)
    stamp_us: NDArray[np.int64]  # (line,)
    notes: tuple[str, ...] = ()

    @classmethod
    def unknown(cls, lines: int) -> LineTimes:
        """Return lines without any time."""
        return cls(np.full(lines, -1), np.full(lines, -1))


def parse_frame_index(lines: Iterable[str], name: str = "the frame index", where: str = "") -> FrameIndex:
    """Read an index's lines; other lines than frames are counted, the second of two equal frames is dropped.

    Notes call it ``name``, messages ``where`` or ``name``. Raises SceneError: no line is a frame.
    """
    frames, stamps = array("q"), array("q")
    odd = 0
    for number, line in enumerate(lines):
        words = [word for word in re.split(r"[\t ,;]+", line.strip()) if word]
        whole = [int(word) for word in words[:2] if _WHOLE.fullmatch(word)]
        if len(whole) == 2 and all(0 <= one < _LARGEST for one in whole):
            frames.append(whole[0])
            stamps.append(whole[1])
        elif words and number:  # the first is the heading
            odd += 1
    if not frames:
        raise SceneError(
            f"{where or name} lists no frame, expected lines of number and microseconds; remove or repair it"
        )
    numbers, first = np.unique(np.array(frames, np.int64), return_index=True)
    notes = [f"{name}: {odd} lines are no frames"] if odd else []
    if len(numbers) < len(frames):
        notes.append(f"{name}: {len(frames) - len(numbers)} frames are listed twice, the first counts")
    found = np.array(stamps, np.int64)[first]
    if (np.diff(found) < 0).any():
        notes.append(f"{name}: time goes back {np.count_nonzero(np.diff(found) < 0)} times")
    return FrameIndex(numbers, found, tuple(notes))


def times_of_lines(index: FrameIndex, first_frame: int, lines: int, lost: int = 0) -> LineTimes:
    """Return frame and time of each of a file's ``lines``.

    Lines are frames in order from ``first_frame`` on, the number in the file's name. The index may list as many frames
    as the file has lines, with or without the ``lost`` ones at its end. Then it lists these lines, whatever the
    numbers: the camera dropped the others. An index of a later file that begins at 0 counts from that file's start.
    """
    frame = index.frame + (first_frame if index.frame[0] == 0 else 0)
    if len(frame) in (lines, lines + lost):
        dropped = int(frame[-1] - frame[0]) + 1 - len(frame)
        notes = (f"{dropped} frames between the first and the last were dropped by the camera",) if dropped else ()
        return LineTimes(frame[:lines], index.stamp_us[:lines], notes)
    found = LineTimes.unknown(lines)
    place = frame - first_frame
    inside = (place >= 0) & (place < lines)
    found.frame[place[inside]] = frame[inside]
    found.stamp_us[place[inside]] = index.stamp_us[inside]
    known, beyond = int(np.count_nonzero(inside)), int(np.count_nonzero(~inside))
    findings: tuple[str, ...] = () if known == lines else (f"the frame index has the time of {known} of {lines} lines",)
    findings += (f"the frame index lists {beyond} frames beyond the lines",) if beyond else ()
    return replace(found, notes=findings)

"""Frame indices of Headwall cameras from files; their lines are read by :mod:`pipeline.rig.camera.frame_index`."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import SceneError
from pipeline.rig.camera.frame_index import LONGEST_LINE, FrameIndex, LineTimes, parse_frame_index, times_of_lines

__all__ = ["FrameIndex", "LineTimes", "load_frame_index", "times_of_lines"]


def load_frame_index(path: Path) -> FrameIndex:
    """Read one index. Lines that are no frame are passed over and counted; of a frame listed twice the first counts.

    Raises
    ------
    SceneError : the file cannot be read, or no line of it is a frame.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            return parse_frame_index(iter(lambda: file.readline(LONGEST_LINE), ""), path.name, str(path))
    except SceneError:
        raise
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error}; take it away to go on without times") from error

"""How large a camera's files can be by what it was asked for: what claims more is refused before a byte is fetched."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pipeline.errors import RigError
from pipeline.rig.camera.kept_files import RemoteFile

MOST_TEXT = 1 << 26  # bytes of a header, a frame index or another text: an index of two million frames
MOST_OFFSET = 1 << 16  # bytes before the first frame of a cube; cameras write none
MOST_REFERENCE_FRAMES = 2048
MOST_FILES = 4096
_RAW = re.compile(r"raw_\d+", re.IGNORECASE)
_REFERENCE = re.compile(r"(dark|white)[a-z_]*", re.IGNORECASE)


@dataclass(frozen=True)
class FrameClaim:
    """What a capture was asked for: frames, in all its cubes, of so many numbers of 16 bits."""

    frames: int
    samples: int
    bands: int

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame."""
        return 2 * self.samples * self.bands


def bounded(files: Sequence[RemoteFile], claim: FrameClaim) -> list[RemoteFile]:
    """Give the files with the most that each can have: cubes what was asked for, references and texts a fixed number.

    Raises
    ------
    RigError : one claims more, or all cubes together do, or there are too many files.
    """
    if len(files) > MOST_FILES:
        raise RigError(f"the camera lists {len(files)} files in one capture, expected {MOST_FILES} at most; look there")
    found = [replace(file, most=_most(file, claim)) for file in files]
    for file in found:
        _check(file.name, file.size or 0, file.most or 0)
    cubes = [file for file in found if _RAW.fullmatch(_base(file))]
    if cubes:
        most = claim.frames * claim.frame_bytes + len(cubes) * MOST_OFFSET
        _check(f"{cubes[0].name} with the cubes beside it", sum(file.size or 0 for file in cubes), most)
    return found


def _most(file: RemoteFile, claim: FrameClaim) -> int:
    if _RAW.fullmatch(_base(file)):
        return claim.frames * claim.frame_bytes + MOST_OFFSET
    return MOST_REFERENCE_FRAMES * claim.frame_bytes + MOST_OFFSET if _REFERENCE.fullmatch(_base(file)) else MOST_TEXT


def _check(name: str, size: int, most: int) -> None:
    if size > most:
        raise RigError(
            f"{name} is said to have {size} bytes, expected {most} at most; nothing of it is fetched: look at what the "
            "camera wrote, and at camera.samples and the wavelengths in the settings"
        )


def _base(file: RemoteFile) -> str:
    return file.name.rsplit("/", 1)[-1]

"""Define the errors of the package, and write names and text from files and devices into messages.

A message names the wrong value, what is allowed, and what to do.
"""

from __future__ import annotations

import errno
import re
import unicodedata
from collections.abc import Callable, Sequence

_LAYOUT = "\n\t"  # control characters that stay
MOST_LETTERS = 1500  # of a message
_DIRECTION = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
_UNSEEN = "\u00ad\u061c\u200b\u200e\u200f\u2060\ufeff"  # marks of direction, and characters without width
_SUSPECT = re.compile(r"[^\n\t\x20-\x7e\u00a1-\u00ac\u00ae-\u02ff\u0370-\u058f\u2010-\u2027\u2030-\u205e\u4e00-\u9fff]")


def visible(text: str, escaped: Callable[[str], str] = lambda one: one.encode("unicode_escape").decode("ascii")) -> str:
    r"""Return text with escapes (``\x1b``, ``\u202e``) for control characters, marks of direction and unseen ones.

    Line ends, tabs and the letters of all scripts stay, also the joiners that some scripts need.
    """
    return _SUSPECT.sub(lambda found: found[0] if is_visible(found[0]) else escaped(found[0]), text)


def shortened(text: str, most: int = MOST_LETTERS) -> str:
    """Return a text without the middle of what exceeds so many characters."""
    if len(text) <= most:
        return text
    return f"{text[: most * 2 // 3]} [... {len(text) - most} characters ...] {text[-most // 3 :]}"


def is_visible(character: str) -> bool:
    """Return whether `visible` leaves a character as it is."""
    if character in _LAYOUT:
        return True
    if character in _UNSEEN or unicodedata.bidirectional(character) in _DIRECTION:
        return False
    tag = "\U000e0000" <= character <= "\U000e007f"
    return not tag and unicodedata.category(character) not in ("Cc", "Cs", "Zl", "Zp")


def list_some(names: Sequence[str], most: int = 5) -> str:
    """Return the first names, and how many there are beyond them."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


_DISK_ADVICE = {
    errno.ENOSPC: "the disk is full: free some space and run again",
    errno.EDQUOT: "the disk quota is used up: free some space and run again",
    errno.EROFS: "the file system is read-only: mount it for writing or choose another folder",
    **dict.fromkeys((errno.EACCES, errno.EPERM), "permission is denied: change the rights or choose another folder"),
    errno.EIO: "the disk reports an error: check the disk, then run again",
    errno.EFBIG: "a file may not grow so large here: raise ulimit -f, or choose a folder on another file system",
    errno.EMFILE: "too many files are open: raise ulimit -n",
    errno.ENAMETOOLONG: "the name is too long for this file system: give a shorter one",
    errno.ENOLCK: "the file system has no locks: choose a folder on a local disk",
    errno.ELOOP: "a link stands where a file of its own belongs: see where it leads, remove it and run again",
}


def disk_advice(error: OSError) -> str | None:
    """Return the meaning of a disk error and what to do; None for other errors."""
    return _DISK_ADVICE.get(error.errno or 0)


class PipelineError(Exception):
    """Base of every error with a message for the user; ``exit_code`` is that of the process.

    Text of files and devices in the message is escaped by `visible`, and a long message is without its middle.
    """

    exit_code = 1

    def __str__(self) -> str:
        return shortened(visible(super().__str__()))


class SettingsError(PipelineError, ValueError):
    """A flag, a settings file or a combination of them cannot be used."""

    exit_code = 2


class BudgetError(PipelineError, ValueError):
    """A budget is out of range or less than the least possible."""

    exit_code = 2


class SceneError(PipelineError, ValueError):
    """A scene, label or mask file cannot be used."""


class FileChangedError(SceneError):
    """A file changed while it was read."""


class NotRecordedError(SceneError):
    """A requested line is not part of the recording."""


class NoSceneYet(SceneError):  # noqa: N818 - named for what is missing
    """A pattern matches no file yet."""


class WavelengthError(SceneError):
    """Wavelengths do not fit the bands, the unit or the allowed range."""


class EmptySceneError(SceneError):
    """A scene has no valid value."""


class ShapeError(PipelineError, ValueError):
    """Arrays whose shapes do not fit each other."""


class PoseError(PipelineError, ValueError):
    """A direction or mirror position is out of reach or not finite."""


class ZoneError(PipelineError, ValueError):
    """Polygons of an area, of zones or plots cannot be used, or lie off the field."""


class WeightsError(PipelineError, ValueError):
    """Model weights that are damaged or do not fit."""


class RigError(PipelineError, OSError):
    """A device failed, or its data could not be stored."""


class ArchiveError(PipelineError, OSError):
    """The archive cannot be read or written."""


class NoRunError(ArchiveError, KeyError):
    """An archive has no run of a name."""

    exit_code = 2


class IncompleteStoreError(PipelineError, LookupError):
    """A store has no valid manifest, or its content does not match it."""


class WorkerError(PipelineError, RuntimeError):
    """Worker processes died, or the connection to their scheduler was lost."""


class SurveyStopped(Exception):  # noqa: N818 - no error: the settings stop a survey before its class map
    """A survey stored the last product of the stage ``until`` of its settings, at ``uri`` of its archive."""

    def __init__(self, until: str, uri: str, archive: str) -> None:
        super().__init__(
            f"stopped after {until}: stored in {archive}/{uri}; the same command without --until goes on, here or on "
            "another machine with a copy of this archive"
            + (f". To label it: spectralzoom export {archive} {uri} -o FOLDER" if until == "mosaic" else "")
        )
        self.until, self.uri, self.archive = until, uri, archive

    def __reduce__(self) -> tuple[type[SurveyStopped], tuple[str, str, str]]:
        return type(self), (self.until, self.uri, self.archive)

"""The error tree, and how text from files and devices is shown.

Every message says what was expected, what came, where, and what to do.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable

_LAYOUT = "\n\t"  # control characters that text for people has
_DIRECTION = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
_UNSEEN = "\u00ad\u061c\u200b\u200e\u200f\u2060\ufeff"  # marks of direction, and what takes no room
_SUSPECT = re.compile(r"[^\n\t\x20-\x7e\u00a1-\u00ac\u00ae-\u02ff\u0370-\u058f\u2010-\u2027\u2030-\u205e\u4e00-\u9fff]")


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def visible(text: str, escaped: Callable[[str], str] = _escaped) -> str:
    r"""Text in which control characters, marks of direction and unseen ones stand as escapes: ``\x1b``, ``\u202e``.

    Lines, tabs and the letters of all scripts stay; so do the joiners that some scripts are written with.
    """
    return _SUSPECT.sub(lambda found: found[0] if is_visible(found[0]) else escaped(found[0]), text)


def is_visible(character: str) -> bool:
    """Return whether a character is one that `visible` leaves as it is."""
    if character in _LAYOUT:
        return True
    if character in _UNSEEN or unicodedata.bidirectional(character) in _DIRECTION:
        return False
    tag = "\U000e0000" <= character <= "\U000e007f"
    return not tag and unicodedata.category(character) not in ("Cc", "Cs", "Zl", "Zp")


class PipelineError(Exception):
    """Base of every error that the user is meant to read; ``exit_code`` is the process's.

    Words of files and devices in it are shown as `visible` shows them.
    """

    exit_code = 1

    def __str__(self) -> str:
        return visible(super().__str__())


class SettingsError(PipelineError, ValueError):
    """A flag, a settings file or a combination of them cannot be used."""

    exit_code = 2


class BudgetError(PipelineError, ValueError):
    """A budget is out of range or less than the least possible."""

    exit_code = 2


class NoScanPaidFor(BudgetError):  # noqa: N818 - said of scans
    """No uniform scan that some weights read costs as little; others may read fewer lines."""


class SceneError(PipelineError, ValueError):
    """A scene, label or mask file cannot be used."""


class NotRecordedError(SceneError):
    """A line is asked of a recording that was never taken."""


class NoSceneYet(SceneError):  # noqa: N818 - said of files
    """A pattern stands for no file yet; one may come."""


class WavelengthError(SceneError):
    """Wavelengths do not fit the bands, the unit or the range."""


class EmptySceneError(SceneError):
    """A scene has no value anywhere."""


class SeriesError(SceneError):
    """A file holds several steps of time, and none is named."""

    def __init__(self, message: str, steps: int) -> None:
        super().__init__(message)
        self.steps = steps


class ShapeError(PipelineError, ValueError):
    """Arrays whose shapes do not fit each other."""


class PoseError(PipelineError, ValueError):
    """A direction or mirror position out of reach, or not finite."""


class ZoneError(PipelineError, ValueError):
    """Polygons of an area, of zones or plots cannot be used, or do not lie on the field."""


class WeightsError(PipelineError, ValueError):
    """Model weights that are damaged or do not fit."""


class RigError(PipelineError, OSError):
    """A device failed, or what it sent could not be kept."""


class ArchiveError(PipelineError, OSError):
    """The archive cannot be read or written."""


class ChunkError(PipelineError, ValueError):
    """A region splits stored chunks."""


class IncompleteStoreError(PipelineError, LookupError):
    """A store has no valid manifest, or its content does not match it."""


class WorkerError(PipelineError, RuntimeError):
    """Processes that work for this one died, or their scheduler went away."""


class BoundError(PipelineError, ArithmeticError):
    """A simulated effect, left out or cheapened, changes light by more than its bound says."""


class NothingToMend(Exception):  # noqa: N818 - no error: a survey that ends well without a look
    """The prior map of a field is sure enough, and no capture is needed; ``run`` is the one whose map stands."""

    def __init__(self, run: str, why: str) -> None:
        super().__init__(why)
        self.run = run

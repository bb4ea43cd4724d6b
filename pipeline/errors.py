"""The error tree. Every message says what was expected, what came, where, and what to do.

=====================  ==========================================================  ========
error                  when                                                        exit code
=====================  ==========================================================  ========
SettingsError          a flag or a settings file says something that cannot be     2
BudgetError            a budget or a number of seats that cannot be met            2
SceneError             a scene, label or mask file that cannot be used             1
WavelengthError        wavelengths that do not fit the bands or the unit           1
ShapeError             arrays whose shapes do not fit each other                   1
PoseError              a direction or position the mirror cannot take              1
WeightsError           weights that do not fit the scene or are damaged            1
RigError               a device (or the spool behind it) failed                    1
ArchiveError           the archive cannot be read or written                       1
ChunkError             a region that splits stored chunks                          1
IncompleteStoreError   a store without a valid manifest, or one that fails it      1
WorkerError            processes that work for this one died or went away          1
BoundError             a simulated effect changes more than its bound says         1
=====================  ==========================================================  ========
"""

from __future__ import annotations

from pipeline.visible_text import visible


class PipelineError(Exception):
    """Base of every error that the user is meant to read; ``exit_code`` is the process's.

    Words of files and devices in it are shown as `visible_text` shows them.
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


class SceneError(PipelineError, ValueError):
    """A scene, label or mask file cannot be used."""


class WavelengthError(SceneError):
    """Wavelengths do not fit the bands, the unit or the range."""


class ShapeError(PipelineError, ValueError):
    """Arrays whose shapes do not fit each other."""


class PoseError(PipelineError, ValueError):
    """A direction or mirror position out of reach, or not finite."""


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

"""SpectralZoom from Python: survey a field, open what an archive holds as xarray, judge and train weights.

The import is light: functions load their modules when they are called.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipeline.errors import PipelineError as Error
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import importlib.metadata as metadata

    import spectralzoom.opened as opened
    import spectralzoom.verbs as verbs
    from spectralzoom.opened import OpenedArchive, OpenedRun, open
    from spectralzoom.verbs import evaluate, plan, survey, train

    __version__: str
else:
    metadata = deferred("importlib.metadata")
    opened = deferred("spectralzoom.opened")
    verbs = deferred("spectralzoom.verbs")

__all__ = ["Error", "OpenedArchive", "OpenedRun", "__version__", "evaluate", "open", "plan", "survey", "train"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return metadata.version("spectralzoom")
    if name in ("OpenedArchive", "OpenedRun", "open"):
        return getattr(opened, name)
    if name in __all__:
        return getattr(verbs, name)
    raise AttributeError(f"spectralzoom has no {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__

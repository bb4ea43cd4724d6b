"""SpectralZoom from Python: survey a field, open what an archive holds as xarray, judge and train weights.

The import is light: functions load their modules when they are called.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if Path(__file__).with_name("pipeline").is_file():
    raise ImportError(
        "git wrote links of this checkout as text; allow links (on Windows the developer mode), then run: "
        "git config core.symlinks true, and git checkout -- src"
    )

from spectralzoom.pipeline.errors import PipelineError as Error

if TYPE_CHECKING:
    from spectralzoom.opened import OpenedArchive, OpenedRun, open
    from spectralzoom.storage.readers.open_cubes import open_cube
    from spectralzoom.verbs import evaluate, plan, survey, train

    __version__: str

_MODULES = {
    "OpenedArchive": "opened",
    "OpenedRun": "opened",
    "open": "opened",
    "open_cube": "storage.readers.open_cubes",
}
_MODULES |= dict.fromkeys(("evaluate", "plan", "survey", "train"), "verbs")
__all__ = [
    "Error",
    "OpenedArchive",
    "OpenedRun",
    "__version__",
    "evaluate",
    "open",
    "open_cube",
    "plan",
    "survey",
    "train",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("spectralzoom")
    if name in _MODULES:
        return getattr(importlib.import_module(f"spectralzoom.{_MODULES[name]}"), name)
    raise AttributeError(f"spectralzoom has no {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__

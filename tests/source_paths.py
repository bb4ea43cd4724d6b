"""Where processes that tests start find the package and the tests."""

from __future__ import annotations

import os
from pathlib import Path


def python_path(root: Path) -> str:
    """Return PYTHONPATH for a checkout or a copy of it."""
    return os.pathsep.join((str(root), str(root / "src")))


ROOT = Path(__file__).resolve().parents[1]
PYTHON_PATH = python_path(ROOT)

"""Split the address of an array in a file: ``scene.mat:cube``."""

from __future__ import annotations

import re
from pathlib import Path

_WITH_VARIABLE = re.compile(
    r"(.+\.(?:(?:mat|zarr|npy)(?=:[^/\\:]+$)|nc4?|h5|hdf5|he5)):([^:]+)", re.IGNORECASE | re.DOTALL
)


def split_variable(address: str | Path) -> tuple[Path, str | None]:
    """Return path and variable of ``scene.mat:cube``."""
    found = _WITH_VARIABLE.fullmatch(str(address))
    return (Path(address), None) if found is None else (Path(found[1]), found[2])

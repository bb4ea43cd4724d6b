"""What has to be the same wherever blocks are made, for the same bytes to come out: code, threads and files."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pipeline.errors import SettingsError

ROOMS = ("pipeline", "models", "storage", "flows")  # blocks of regions are made in flows
LIBRARIES = ("numpy", "zarr", "numcodecs", "torch", "distributed")
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_SET_THERE = " in its environment, as dask's nannies set it: sums of several threads are rounded otherwise"
_SAME_FILES = (
    " as here; workers must see the same files under the same path: put the archive on a disk that all of them mount"
)
_SAME_CODE = " as here; install the same there"


def about_here(folders: Sequence[str]) -> dict[str, str]:
    """What this process runs, on how many threads, and what it sees in some folders, by name."""
    all_threads = os.environ.get("OMP_NUM_THREADS", "not set")  # which counts where the others do not stand
    threads = {name: os.environ.get(name, all_threads) for name in ONE_THREAD}
    return versions_here() | threads | {folder: _seen(Path(folder)) for folder in folders}


@cache
def versions_here() -> dict[str, str]:
    """What this process runs, by name, as it was when first asked: so it runs whatever changes on the disk."""
    facts = {"python": platform.python_version(), "spectralzoom": _code_digest()}
    for name in LIBRARIES:
        try:
            facts[name] = version(name)
        except PackageNotFoundError:
            facts[name] = "missing"
    return facts


def check_facts(who: str, facts: Mapping[str, str], expected: Mapping[str, str]) -> None:
    """Refuse somebody of whom not all is as expected.

    Raises
    ------
    SettingsError : names who it is, the first thing that differs, both values and what to do.
    """
    for what, value in expected.items():
        if facts.get(what) != value:
            cure = _SET_THERE if what in ONE_THREAD else _SAME_FILES if what.startswith("/") else _SAME_CODE
            raise SettingsError(f"{who} has {what} {facts.get(what)}, expected {value}{cure}")


def _code_digest() -> str:
    """Hash of the source that blocks run: a version number does not tell one checkout from another."""
    root, found = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (root / room).rglob("*.py")):
        found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return f"of code {found.hexdigest()[:12]}"


def _seen(folder: Path) -> str:
    """What a folder holds, in a few letters."""
    if not folder.is_dir():
        return "not there"
    names = sorted(path.name for path in folder.iterdir())
    return f"with {len(names)} names ({hashlib.sha256(repr(names).encode()).hexdigest()[:8]})"

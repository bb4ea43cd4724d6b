"""Where libraries keep what they work out once: the user's cache folder, or a private one where there is none to write.

A service's user may have no home. numba then refuses to start (the farm's canopies are compiled with it), matplotlib
and fontconfig warn at each start. Whatever is kept there can be made again.
"""

from __future__ import annotations

import atexit
import importlib.util
import os
import pwd
import shutil
import stat
import tempfile
from collections.abc import Mapping, MutableMapping
from contextlib import suppress
from pathlib import Path

from pipeline.errors import SettingsError

NO_HOME = "/nonexistent"  # as Debian calls the home of users that have none
OF_LIBRARIES = {"NUMBA_CACHE_DIR": "numba", "MPLCONFIGDIR": "matplotlib"}  # those that ask for more than XDG's folder


def place_caches(environment: MutableMapping[str, str] | None = None) -> Path | None:
    """Name a private folder in the environment, for this process and those that it starts, where it is needed.

    It is `spectralzoom-UID` in the temporary folder, so that the next process finds what this one compiled: where it
    is not ours alone, a new one that goes with this process. What is in it is run as code, so nobody else may write it.
    ``environment`` is this process's own unless given.

    Returns
    -------
    The folder, or None where the usual one (XDG_CACHE_HOME, or ~/.cache) can be written.

    Raises
    ------
    SettingsError : nothing can be written, the temporary folder included.
    """
    environment = os.environ if environment is None else environment
    if not _has_home(environment):
        environment["HOME"] = NO_HOME  # Prefect asks for one before anybody tells it where to keep its files
    usual = _usual_folder(environment)
    if usual is not None and _can_be_made(usual):
        return None
    folder = _private_folder(usual)
    environment["XDG_CACHE_HOME"] = str(folder)
    for name, part in OF_LIBRARIES.items():
        environment.setdefault(name, str(folder / part))
    return folder


def place_pages(environment: Mapping[str, str] | None = None) -> dict[str, str]:
    """Tell Prefect's server to unpack its pages into the cache folder, where it cannot do so beside its own code."""
    found = importlib.util.find_spec("prefect")
    places = [] if found is None else [Path(place) / "server" for place in found.submodule_search_locations or ()]
    folder = _usual_folder(os.environ if environment is None else environment)
    if folder is None or all(os.access(place, os.W_OK | os.X_OK) for place in places):
        return {}
    return {"PREFECT_SERVER_UI_STATIC_DIRECTORY": str(folder / "spectralzoom" / "prefect-pages")}


def _has_home(environment: Mapping[str, str]) -> bool:
    """Whether the environment or the system's list of users names a home, be it there or not."""
    if environment.get("HOME"):
        return True
    try:
        return bool(pwd.getpwuid(os.getuid()).pw_dir)
    except KeyError:
        return False


def _usual_folder(environment: Mapping[str, str]) -> Path | None:
    """Where caches belong; None where there is no home to hold them."""
    named = Path(environment.get("XDG_CACHE_HOME", ""))
    if named.is_absolute():
        return named
    home = Path(environment.get("HOME") or pwd.getpwuid(os.getuid()).pw_dir)
    return home / ".cache" if home.is_absolute() and home.is_dir() else None


def _can_be_made(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def _private_folder(usual: Path | None) -> Path:
    try:
        folder = Path(tempfile.gettempdir()) / f"spectralzoom-{os.geteuid()}"
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        if _is_ours_alone(folder):
            return folder
        other = Path(tempfile.mkdtemp(prefix="spectralzoom-"))
    except OSError as error:
        raise SettingsError(
            f"no folder for what libraries keep: neither {usual or 'a home'} nor a temporary folder can be written "
            f"({error}); set XDG_CACHE_HOME to a folder that this user can write"
        ) from None
    atexit.register(shutil.rmtree, other, ignore_errors=True)
    return other


def _is_ours_alone(folder: Path) -> bool:
    """Whether it is a folder, no link, that this user owns and no other may enter."""
    found = folder.lstat()
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077

"""This process and its children: signals, refusals of the operating system, and caches without a home folder."""

from __future__ import annotations

import atexit
import importlib.util
import os
import pwd
import resource
import shutil
import signal
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from spectralzoom.pipeline.errors import ArchiveError, PipelineError, SettingsError, disk_advice

DONE, FAILED, PARTLY = 0, 1, 3  # exit codes
AT_ONCE_S = 0.3
TERMINATED = 128 + signal.SIGTERM  # the exit code that a shell reports after SIGTERM


class Terminated(KeyboardInterrupt):
    """SIGTERM ends the process; the clean-up is that of Ctrl-C."""


@contextmanager
def terminable(*, last: bool = False) -> Iterator[None]:
    """Raise `Terminated` in the main thread on SIGTERM while the block runs; do nothing in other threads.

    After the ``last`` block of a process SIGTERM is ignored, so that the exit code stays, and Ctrl-C ends it at once.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN if last else before)
        if last:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def answered(answer: Callable[[], None]) -> Iterator[None]:
    """Call ``answer`` in a thread where the block has not ended a moment after Ctrl-C or SIGTERM.

    Python writes a signal into a pipe at once, and raises it in the main thread only after the call that runs there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ended, (reading, writing) = threading.Event(), os.pipe()
    os.set_blocking(writing, False)

    def listen() -> None:
        while signals := os.read(reading, 1):
            if signals[0] in (signal.SIGINT, signal.SIGTERM) and not ended.wait(AT_ONCE_S):
                return answer()
        return None

    threading.Thread(target=listen, daemon=True).start()
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(before)
        os.close(writing)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


# texts of other exceptions than MemoryError: of torch and threads, and of the loader where memory is limited
_OF_MEMORY = ("can't allocate memory", "not enough memory", "can't start new thread", "cannot allocate memory")
_OF_LIMITED_MEMORY = ("failed to map segment", "could not find/load shared object")


def format_refusal(error: BaseException) -> str | None:
    """Return the message for an error of memory or disk, with what to do; None for other errors."""
    text = str(error)
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    limited = limit != resource.RLIM_INFINITY
    known = (*_OF_MEMORY, *(_OF_LIMITED_MEMORY if limited else ()))
    if isinstance(error, MemoryError) or any(sign in text.lower() for sign in known):
        allowed = f"; this process may take {limit / 1e9:.1f} GB (ulimit -v)" if limited else ""
        cause = text.partition(". ")[0].rstrip(".") or "the machine has no more"
        return (
            f"memory ran out: {cause}{allowed}. Make room or raise the limit, or ask for less: a smaller scene, fewer "
            f"--bands, less --memory, fewer --workers"
        )
    if isinstance(error, FileNotFoundError) and error.errno and error.filename is None:  # of os.getcwd
        return "the current folder was removed: change to another folder and run again"
    if isinstance(error, OSError) and (advice := disk_advice(error)) is not None:
        where = f" {error.filename}" if error.filename else ""
        return f"the system refused to read or write{where}: {advice}"
    return None


def format_failure(error: Exception) -> tuple[str, int]:
    """Return the message for any error, and its exit code; the traceback of a defect is written to a file."""
    if isinstance(error, PipelineError):
        return str(error), error.exit_code
    if (refused := format_refusal(error)) is not None:
        return refused, 1
    with tempfile.NamedTemporaryFile("w", prefix="spectralzoom-", suffix=".log", delete=False) as file:
        traceback.print_exception(error, file=file)
    return f"{type(error).__name__}: {error}; this is a defect of SpectralZoom: please report {file.name}", 1


@contextmanager
def writing(out: Path, flag: str = "--out") -> Iterator[None]:
    """Raise ArchiveError where the block cannot write to ``out``."""
    try:
        yield
    except ArchiveError:
        raise
    except OSError as error:
        raise ArchiveError(f"cannot write to {out}: {error.strerror or error}; choose another {flag}") from error


def send_no_analytics() -> None:
    """Let Prefect send no usage data and print no notice on them; it reads the variable when it is imported."""
    os.environ.setdefault("DO_NOT_TRACK", "1")


NO_HOME = "/nonexistent"  # Debian's name for the home of users without one
OF_LIBRARIES = {"NUMBA_CACHE_DIR": "numba", "MPLCONFIGDIR": "matplotlib", "PREFECT_HOME": "prefect"}


def place_caches() -> Path | None:
    """Set environment variables to a temporary cache folder where the usual one cannot be written; return it or None.

    The usual one is XDG_CACHE_HOME or ~/.cache; the temporary one ends with the process. Raises SettingsError: no
    temporary folder can be written either.
    """
    try:
        home = os.environ.get("HOME") or pwd.getpwuid(os.getuid()).pw_dir
    except KeyError:
        home = None
    if not home:
        os.environ["HOME"] = NO_HOME  # Prefect needs one at its import
    usual = cache_folder()
    with suppress(OSError):
        if usual is not None:
            usual.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(usual, os.W_OK | os.X_OK):
                return None
    try:
        folder = Path(tempfile.mkdtemp(prefix="spectralzoom-"))
    except OSError as error:
        raise SettingsError(
            f"no folder for the caches of libraries: neither {usual or 'a home'} nor a temporary folder can be written "
            f"({error}); set XDG_CACHE_HOME to a folder that this user can write"
        ) from None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["XDG_CACHE_HOME"] = str(folder)
    for name, part in OF_LIBRARIES.items():
        os.environ.setdefault(name, str(folder / part))
    return folder


def place_pages() -> dict[str, str]:
    """Return a setting that lets Prefect's server unpack its pages in the cache folder, if its own is read-only."""
    found = importlib.util.find_spec("prefect")
    folder = cache_folder()
    if folder is None or os.access(Path(str(found and found.origin)).parent / "server", os.W_OK | os.X_OK):
        return {}
    return {"server.ui.static_directory": str(folder / "spectralzoom" / "prefect-pages")}


def cache_folder() -> Path | None:
    """Return the usual cache folder; None without a home."""
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if named.is_absolute():
        return named
    home = Path(os.environ.get("HOME") or pwd.getpwuid(os.getuid()).pw_dir)
    return home / ".cache" if home.is_absolute() and home.is_dir() else None

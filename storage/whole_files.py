"""Read and write the files of an archive, of exports and of settings: errors with advice, names, syncing, locks.

A file or folder is written aside, under a name that ends in ``.part``, and gets its name only when it is complete.
Files of an archive are opened by `open_own`, which follows no link.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import logging
import math
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from spectralzoom.pipeline.errors import ArchiveError, PipelineError, disk_advice, visible
from spectralzoom.pipeline.words import PART

_PREFIX = ".export-"
PROBE_BYTES = 1 << 20  # a disk without room for so much is full

log = logging.getLogger(__name__)


@contextmanager
def refusals(path: Path, doing: str, *, every: bool = False) -> Iterator[None]:
    """Turn errors of files below ``path``, of a full or broken disk, or ``every`` OSError into one ArchiveError."""
    try:
        yield
    except PipelineError:
        raise
    except OSError as error:
        named = None if error.filename is None else Path(os.fsdecode(error.filename))
        inside = every or (named is not None and (named.is_relative_to(path) or path.is_relative_to(named)))
        advice = disk_advice(error)
        if not inside and (advice is None or (named is not None and named.is_absolute())):
            raise
        if advice is None:
            gone = isinstance(error, FileNotFoundError)
            cure = "another process has removed it, run again" if gone else "see what stands there"
            advice = f"{error.strerror or error}{'' if named is None else f' ({named})'}: {cure}"
        raise ArchiveError(f"cannot {doing} {path}: {advice} (nothing published was changed)") from error


def entries(folder: Path) -> list[Path]:
    """Return the entries of a folder, sorted; none if it is gone or is a file."""
    try:
        return sorted(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []


def files_in(folder: Path) -> dict[str, os.stat_result]:
    """Return all files below a folder by their names in it, without those that go meanwhile. Links are not followed."""
    found: dict[str, os.stat_result] = {}
    waiting = [] if folder.is_symlink() else [str(folder)]
    while waiting:
        with suppress(FileNotFoundError, NotADirectoryError), os.scandir(waiting.pop()) as listed:
            for one in listed:
                if one.is_dir(follow_symlinks=False):
                    waiting.append(one.path)
                else:
                    with suppress(FileNotFoundError):
                        found[one.path[len(str(folder)) + 1 :]] = one.stat(follow_symlinks=False)
    return found


def bytes_in(folder: Path) -> int:
    """Return the bytes of all files below a folder."""
    return sum(one.st_size for one in files_in(folder).values())


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder, and no link to one."""
    return path.is_dir() and not path.is_symlink()


def check_no_link(path: Path, root: Path) -> None:
    """Raise ArchiveError where a name between an archive and a path in it is a link; ``stages`` alone may be one."""
    for part in (path, *path.parents):
        if part == root:
            return
        if part.is_symlink() and part != root / "stages":
            raise _link_refusal(part)


def open_own(path: Path, mode: str = "rb", buffering: int = -1) -> IO[Any]:
    """Open a file of an archive. Neither it nor its folder may be a link, and it is never a pipe.

    Raises ArchiveError: one of them is a link; OSError: as `open`.
    """
    return open(path, mode, buffering, None if "b" in mode else "utf-8", opener=_without_links)


def _without_links(name: str, flags: int) -> int:
    path = Path(name)
    try:
        above = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            descriptor = os.open(path.name, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666, dir_fd=above)
        finally:
            os.close(above)
    except OSError as error:
        if link := next((one for one in (path.parent, path) if one.is_symlink()), None):
            raise _link_refusal(link) from error
        error.filename = name  # that of the descriptor is relative to the folder
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is no file of its own", name)
    return descriptor


def read_own(path: Path) -> bytes:
    """Return the content of a file of an archive. Raises as `open_own`."""
    with open_own(path) as file:
        return bytes(file.read())


def write_new(path: Path, content: bytes | str) -> None:
    """Write a new file of an archive. Raises FileExistsError: the name is taken, also by a link that leads nowhere."""
    with open_own(path, "xb") as file:
        file.write(content if isinstance(content, bytes) else content.encode())


def make_folder(path: Path, root: Path) -> None:
    """Make a folder in an archive, and those above it. Raises ArchiveError: one of them is a link."""
    check_no_link(path, root)
    path.mkdir(parents=True, exist_ok=True)


def _link_refusal(path: Path) -> ArchiveError:
    return ArchiveError(
        f"{path} is a link, and in an archive only the archive itself and its folder stages may be one; remove the "
        "link, or put what it leads to in its place"
    )


def remove(path: Path) -> None:
    """Remove a folder, file or link if it exists: first its name, in one step; what the disk keeps is left."""
    away = path
    with suppress(OSError):
        if not path.name.endswith(PART) or is_folder(path):  # another process may be writing into it
            away = aside(path)
            path.rename(away)
            sync(away.parent)  # or a power cut leaves the name, and not the files
    if is_folder(away):
        shutil.rmtree(away, ignore_errors=True)
    else:
        with suppress(OSError):
            away.unlink()


def aside(final: Path, ending: str = PART) -> Path:
    """Return a new name beside ``final`` for a folder that is not published."""
    return final.with_name(f"{final.name.split('.')[0]}.{secrets.token_hex(4)}{ending}")


def sync(path: Path) -> None:
    """Sync a file's content, or a folder's names, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256(path: Path, opened: Callable[[Path, str], Any] = Path.open) -> str:
    """Return the SHA-256 of a file's content, in hex; `open_own` opens a file of an archive."""
    with opened(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def locked(path: Path, *, wait: bool = True, shared: bool = False) -> Iterator[bool]:
    """Hold ``path`` against other processes and threads while the block runs; the lock ends with the process.

    Yields False where another holds it and ``wait`` is false; a ``shared`` lock excludes only others. Raises
    ArchiveError: the path cannot be locked.
    """
    kind, is_held = fcntl.LOCK_SH if shared else fcntl.LOCK_EX, False
    with ExitStack() as opened:
        with refusals(path, "lock", every=True), suppress(BlockingIOError):
            path.parent.mkdir(parents=True, exist_ok=True)
            while not is_held:
                file = opened.enter_context(open_own(path, "a"))
                try:
                    fcntl.flock(file, kind | fcntl.LOCK_NB)
                except BlockingIOError:
                    if not wait:
                        raise
                    log.info("waiting for another run that holds %s", path.stem)
                    fcntl.flock(file, kind)
                is_held = path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())  # else gc removed it
        yield is_held


# --- single files -----------------------------------------------------------------------------------------------------


@contextmanager
def written_aside(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder to write ``names`` into; when the block ends well they replace those in ``folder``.

    Old and new files are never mixed: old files of all names but the first are removed before the first is replaced.
    When the block fails, ``folder`` is unchanged. Raises ArchiveError: the folder is or lies below a file, or the disk
    refuses.
    """
    with refusals(folder, "write to"):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise ArchiveError(f"{folder} is or lies below a file, expected a folder; choose another --out") from error
        with tempfile.TemporaryDirectory(prefix=_PREFIX, suffix=PART, dir=folder) as aside:
            with _disk_errors(Path(aside)):
                yield Path(aside)
            for name in names:
                sync(Path(aside) / name)
            for name in names[1:]:
                (folder / name).unlink(missing_ok=True)
            for name in names:
                (Path(aside) / name).replace(folder / name)
            sync(folder)


@contextmanager
def _disk_errors(folder: Path) -> Iterator[None]:
    """Raise the disk's own OSError where a library such as GDAL reports a full disk as another error."""
    try:
        yield
    except PipelineError:
        raise
    except Exception as error:
        if not isinstance(error, OSError) or error.errno is None:
            with tempfile.TemporaryFile(dir=folder) as file:
                file.write(bytes(PROBE_BYTES))
        raise


def write_whole(path: Path, content: str) -> None:
    """Write one text file aside and rename it into place."""
    with written_aside(path.parent, [path.name]) as aside:
        (aside / path.name).write_text(content, encoding="utf-8")


def remove_leftovers(folder: Path) -> None:
    """Remove the leftovers of killed writers from a folder; no process may be writing there."""
    for part in folder.glob(f"{_PREFIX}*{PART}"):
        remove(part)


def to_json(content: Mapping[str, object]) -> str:
    """Return JSON text, two spaces a level, in the content's own order; numbers that are not finite become null.

    Characters that would steer a terminal or reverse text are written as JSON escapes.
    """
    text = json.dumps(_plain(content), indent=2, ensure_ascii=False, allow_nan=False)
    return visible(text, lambda letter: json.dumps(letter)[1:-1]) + "\n"


def _plain(value: object) -> object:
    """Return plain lists, dictionaries and numbers; numpy's scalars by their ``item``."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value

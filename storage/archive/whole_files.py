"""Write exported files aside, and give them their names only when they are complete."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from spectralzoom.pipeline.errors import ArchiveError, PipelineError, visible
from spectralzoom.storage.archive.staging import PART_SUFFIX, refusals, remove_tree, sync_path

_PREFIX = ".export-"
PROBE_BYTES = 1 << 20  # a disk without room for so much is full


@contextmanager
def written_aside(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder to write ``names`` into; when the block ends well they replace those in ``folder``.

    Old and new files are never mixed: old files of all names but the first are removed before the first is replaced.
    When the block fails, ``folder`` is unchanged. Raises ArchiveError: the folder is or lies below a file, or the disk
    refuses.
    """
    with refusals(folder, "write to"):
        make_folder(folder)
        with tempfile.TemporaryDirectory(prefix=_PREFIX, suffix=PART_SUFFIX, dir=folder) as aside:
            with _disk_errors(Path(aside)):
                yield Path(aside)
            for name in names:
                sync_path(Path(aside) / name)
            for name in names[1:]:
                (folder / name).unlink(missing_ok=True)
            for name in names:
                (Path(aside) / name).replace(folder / name)
            sync_path(folder)


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


def make_folder(folder: Path) -> None:
    """Create a folder to export to (ArchiveError: it is or lies below a file)."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise ArchiveError(f"{folder} is or lies below a file, expected a folder; choose another --out") from error


def write_whole(path: Path, content: str) -> None:
    """Write one text file aside and rename it into place."""
    with written_aside(path.parent, [path.name]) as aside:
        (aside / path.name).write_text(content, encoding="utf-8")


def remove_leftovers(folder: Path) -> None:
    """Remove the leftovers of killed writers from a folder; no process may be writing there."""
    for part in folder.glob(f"{_PREFIX}*{PART_SUFFIX}"):
        remove_tree(part)


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

"""Files that people take away: written aside, synced, and given their names only when they are whole."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from storage.staging import PART_SUFFIX, refusals, remove_tree, sync_path

_PREFIX = ".export-"


@contextmanager
def written_aside(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Give an empty folder to write ``names`` into; when the block ends well they replace those in ``folder``.

    What belongs together is never mixed: old files of all names but the first go before the first is replaced, and
    the last one to appear vouches for the others. When the block fails, ``folder`` is as before.

    Raises
    ------
    ArchiveError : the disk refuses; the message names the folder and what to do.
    """
    with refusals(folder, "export to"):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=_PREFIX, suffix=PART_SUFFIX, dir=folder) as aside:
            yield Path(aside)
            for name in names:
                sync_path(Path(aside) / name)
            for name in names[1:]:
                (folder / name).unlink(missing_ok=True)
            for name in names:
                (Path(aside) / name).replace(folder / name)
            sync_path(folder)


def write_whole(path: Path, content: str) -> None:
    """Write one text file as a whole."""
    with written_aside(path.parent, [path.name]) as aside:
        (aside / path.name).write_text(content, encoding="utf-8")


def remove_leftovers(folder: Path) -> None:
    """Remove what killed writers left in a folder; nobody may be writing there."""
    for part in folder.glob(f"{_PREFIX}*{PART_SUFFIX}"):
        remove_tree(part)

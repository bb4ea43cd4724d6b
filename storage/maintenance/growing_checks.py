"""Reading again what grows in an archive: spools of captures under way, and the rig's files beside them.

Nothing is changed. What a crash leaves torn at the end of a file is no damage: whoever goes on cuts it off.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from pipeline.json_lines import read_checked
from pipeline.rig.capture import JOURNAL
from storage.archive.staging import NotPlainError, kind_of, plain_reader, read_plain
from storage.arrays.fetched_files import SUMS, first_unlike
from storage.arrays.spool import envi_header, line_words
from storage.arrays.spool_index import FORMAT, known_head, read_head

SPOOLS = "spool"
_LINES = re.compile(rb"\nlines = (\d{1,9})\n")
_AGAIN = "asked for again when the capture goes on"


def growing_problems(root: Path) -> Iterator[tuple[str, str]]:
    """Give address and problem of each spool of an archive that is not as it was written."""
    for folder in _inside(root / SPOOLS):
        if kind_of(folder) == "a folder":
            for problem in _spool_folder(folder):
                yield f"{SPOOLS}/{folder.name}", problem


def _inside(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if kind_of(folder) == "a folder" else []


def _spool_folder(folder: Path) -> Iterator[str]:
    for path in _inside(folder):
        if path.name.endswith(".index"):
            yield from _told(spool_problems, path)
        for file in _inside(path):
            if file.name == JOURNAL:
                found = _told(_line_problems, file)
                yield from (f"{path.name}/{one}" for one in found)
            elif file.name.endswith(SUMS) and (at := first_unlike(path / file.name.removesuffix(SUMS))) is not None:
                name = f"{path.name}/{file.name.removesuffix(SUMS)}"
                yield f"{name} is not as it was fetched from byte {at} on; it is {_AGAIN}"


def _told(problems: Callable[[Path], Iterator[str]], path: Path) -> list[str]:
    """Problems of a file; of one that changes meanwhile those that it has in the end, of one that goes away none."""
    try:
        found, before = list(problems(path)), b""
        while found and (now := read_plain(path)) != before:
            found, before = list(problems(path)), now
    except (FileNotFoundError, NotPlainError):
        return []  # its lines are published; or it is a link and the like, which is told of every such thing
    except OSError as error:
        return [f"{path.name} cannot be read: {error.strerror}"]
    return found


def _line_problems(path: Path) -> Iterator[str]:
    for line in read_checked(read_plain(path)):
        if line.state == "changed":
            yield f"{path.name}: line {line.number} has changed since it was written, and counts for nothing"


def spool_problems(path: Path) -> Iterator[str]:
    """What is not as it was captured of the lines whose index lies at a path."""
    index = read_plain(path)
    head, name = known_head(index), path.stem
    if head is None:
        yield from _head_problems(index, path.name)
        return
    entries = head.entries(index)
    end = max(entries, default=-1) + 1
    lost = [number for number in range(end) if number not in entries]
    last = entries[end - 1].text[:-1] if entries else head.text[:-1]
    behind = read_checked(index[index.rfind(last) + len(last) :])
    lost += [end] if any(line.state == "changed" for line in behind) else []  # which was whole once
    if lost:
        yield f"{path.name}: {line_words(lost)} changed since written: {_AGAIN}"
    elif not index.startswith(head.text + b"".join(entries[number].text for number in sorted(entries))):
        yield f"{path.name}: the end of a line has changed; nothing is lost by it"
    samples, bands = head.facts["samples"], head.facts["bands"]
    unlike, size = list[int](), samples * bands * 2
    with plain_reader(path.with_suffix(".bil")) as file:
        for number, entry in sorted(entries.items()):
            file.seek(number * size)
            content = file.read(size)
            if len(content) < size or not entry.fits(content):
                unlike.append(number)
    if unlike:
        yield f"{name}.bil: {line_words(unlike)} not as captured (CRC-32), or never on the disk: {_AGAIN}"
    header = path.with_suffix(".hdr")
    if kind_of(header) is not None:
        text = read_plain(header)
        found = _LINES.search(text)
        if found is None or text != envi_header(samples, bands, int(found[1])):
            yield f"{header.name} is not as it was written; it is written anew when the capture goes on"


def _head_problems(index: bytes, name: str) -> Iterator[str]:
    found = read_head(index)
    if found is None or (found.state == "torn" and b"\n" not in index):
        return  # about to be begun
    if found.content is not None and found.content.get("format") != FORMAT:
        yield f"{name} was begun by another version ({found.content.get('format')!r}), which alone can go on with it"
    else:
        yield f"{name}: its header has changed; lines that belong to it are told when the capture goes on"

"""Reading again what grows in an archive: spools of captures under way, the rig's files beside them, and ledgers.

Nothing is changed. What a crash leaves torn at the end of a file is no damage: whoever goes on cuts it off.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from pipeline.checked_lines import read_checked
from pipeline.rig.capture import JOURNAL
from storage.archive.ledger import FOLDER, SUFFIX
from storage.archive.plain_files import NotPlainError, kind_of, plain_reader, read_plain
from storage.arrays.fetched_files import SUMS, first_unlike
from storage.arrays.spool import envi_header, line_words
from storage.arrays.spool_index import FORMAT, Head, SpoolEntry, known_head, read_head

SPOOLS = "spool"
_LINES = re.compile(rb"\nlines = (\d{1,9})\n")
_AGAIN = "asked for again when the capture goes on"


def growing_problems(root: Path) -> Iterator[tuple[str, str]]:
    """Give address and problem of each spool and ledger of an archive that is not as it was written."""
    for folder in _inside(root / SPOOLS):
        if kind_of(folder) == "a folder":
            for problem in _spool_folder(folder):
                yield f"{SPOOLS}/{folder.name}", problem
    for path in _inside(root / FOLDER):
        if path.name.endswith(SUFFIX):
            for problem in _told(ledger_problems, path):
                yield f"{FOLDER}/{path.name}", problem


def _inside(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if kind_of(folder) == "a folder" else []


def _spool_folder(folder: Path) -> Iterator[str]:
    for path in _inside(folder):
        if path.name.endswith(".index"):
            yield from _told(spool_problems, path)
        if kind_of(path) != "a folder":
            continue
        for file in _inside(path):
            name = f"{path.name}/{file.name}"
            if file.name == JOURNAL:
                yield from (f"{path.name}/{one}" for one in _told(journal_problems, file))
            elif file.name.endswith(SUMS) and (at := first_unlike(path / file.name.removesuffix(SUMS))) is not None:
                yield f"{name.removesuffix(SUMS)} is not as it was fetched from byte {at} on; it is {_AGAIN}"


def _told(problems: Callable[[Path], Iterator[str]], path: Path) -> list[str]:
    """Problems of a file; of one that changes meanwhile those that it has in the end, of one that goes away none."""
    try:
        found, before = list(problems(path)), b""
        while found and (now := read_plain(path)) != before:
            found, before = list(problems(path)), now
    except FileNotFoundError:
        return []  # its lines are published
    except NotPlainError:
        return []  # which is told of every such thing
    except OSError as error:
        return [f"{path.name} cannot be read: {error.strerror}"]
    return found


def ledger_problems(path: Path) -> Iterator[str]:
    """Lines of a ledger that have changed."""
    for line in read_checked(read_plain(path)):
        if line.state == "changed":
            yield f"line {line.number} has changed since it was written; the other lines are read"


def journal_problems(path: Path) -> Iterator[str]:
    """Lines of a rig's journal that have changed."""
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
    lost += [end] if _changed_behind(index, head, entries) else []
    if lost:
        yield f"{path.name}: {line_words(lost)} changed since written: {_AGAIN}"
    elif not index.startswith(_text(head, entries)):
        yield f"{path.name}: the end of a line has changed; nothing is lost by it"
    unlike = list(_unlike(path.with_suffix(".bil"), head, entries))
    if unlike:
        yield f"{name}.bil: {line_words(unlike)} not as captured (CRC-32), or never on the disk: {_AGAIN}"
    yield from _envi_problems(path.with_suffix(".hdr"), head)


def _head_problems(index: bytes, name: str) -> Iterator[str]:
    found = read_head(index)
    if found is None or (found.state == "torn" and b"\n" not in index):
        return  # about to be begun
    if found.content is not None and found.content.get("format") != FORMAT:
        yield f"{name} was begun by another version ({found.content.get('format')!r}), which alone can go on with it"
    else:
        yield f"{name}: its header has changed; lines that belong to it are told when the capture goes on"


def _text(head: Head, entries: dict[int, SpoolEntry]) -> bytes:
    return head.text + b"".join(entries[number].text for number in sorted(entries))


def _changed_behind(index: bytes, head: Head, entries: dict[int, SpoolEntry]) -> bool:
    """Whether behind the last whole entry there is one that was whole once."""
    last = entries[max(entries)].text[:-1] if entries else head.text[:-1]
    return any(line.state == "changed" for line in read_checked(index[index.rfind(last) + len(last) :]))


def _unlike(path: Path, head: Head, entries: dict[int, SpoolEntry]) -> Iterator[int]:
    size = head.facts["samples"] * head.facts["bands"] * 2
    with plain_reader(path) as file:
        for number, entry in sorted(entries.items()):
            file.seek(number * size)
            content = file.read(size)
            if len(content) < size or not entry.fits(content):
                yield number


def _envi_problems(path: Path, head: Head) -> Iterator[str]:
    if kind_of(path) is None:
        return
    text = read_plain(path)
    found = _LINES.search(text)
    if found is None or text != envi_header(head.facts["samples"], head.facts["bands"], int(found[1])):
        yield f"{path.name} is not as it was written; it is written anew when the capture goes on"

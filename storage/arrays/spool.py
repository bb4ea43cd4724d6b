"""The line spool: what a capture writes while it runs, so that a crash loses at most the lines since the last sync.

::

    <name>.bil      raw numbers, one line after the other, bands by samples in each (an ENVI file with <name>.hdr)
    <name>.index    one JSON object a line: the header first, then number, mirror, time, exposure, valid, CRC-32

A line counts when its index entry is whole by its own checksum and its numbers have the CRC that the entry states.
Lines that do not count lie either behind the last that does, and are cut off: the capture goes on there; or before it:
these are lost, and are put back in their places when the source gives them again. Spools of earlier versions, whose
entries have no checksum, are refused: nothing tells which of their numbers are those of the capture.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError
from pipeline.source import Line
from storage.archive.staging import disk_words, open_plain, plain_reader, read_plain, sync_path
from storage.arrays.spool_index import FORMAT, Head, SpoolEntry, difference, read_head

SYNC_LINES = 64
MOST_NAMED = 8
LOG = logging.getLogger(__name__)
_APPEND = os.O_WRONLY | os.O_APPEND | os.O_CREAT
_ANEW = os.O_WRONLY | os.O_CREAT | os.O_TRUNC


class Spool:
    """Lines on disk, appended one by one. Use as a context manager, or close it."""

    def __init__(self, path: Path, shape: tuple[int, int], header: Mapping[str, Any]) -> None:
        self.path = path  # of the numbers
        self.index_path = path.with_suffix(".index")
        self.samples, self.bands = shape
        self.count = 0  # lines that are there or lost: the number of the next one appended
        self.lost: list[int] = []  # numbers of those that are lost, in order: `mend` them before the lines are read
        self._head = Head.of(*shape, header)
        self._index_end = 0
        self._line_bytes = shape[0] * shape[1] * 2
        self._data: BinaryIO | None = None
        self._index: BinaryIO | None = None

    @classmethod
    def open(cls, folder: Path, samples: int, bands: int, *, header: Mapping[str, Any], name: str = "lines") -> Spool:
        """Open the spool in ``folder``, or begin it; lines from an earlier, broken capture are kept and counted.

        ``header`` is what the lines belong to (the sweep, the source, the seed). Raises RigError: the spool holds lines
        of anything else or of an earlier version, or the disk refuses.
        """
        spool = cls(folder / f"{name}.bil", (samples, bands), header)
        with _refusals(spool.path, 0):
            folder.mkdir(parents=True, exist_ok=True)
            there = os.path.lexists(spool.index_path) and os.path.lexists(spool.path)
            if not there or b"\n" not in read_plain(spool.index_path):  # nor is a header that is torn
                for path, content in ((spool.path, b""), (spool.index_path, spool._head.text)):
                    _write_anew(path, content)
                for named in (folder, folder.parent, folder.parent.parent):  # lines need their files' names
                    sync_path(named)
            spool.recover()
            spool._write_envi_header()
        return spool

    def __enter__(self) -> Spool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except RigError:
            if kind is None:  # else what went wrong first is what the user should read
                raise

    def append(self, line: Line) -> None:
        """Write the next line; every 64th call waits until the disk has them.

        Raises RigError: the line is out of order or of another size, or the disk refuses. The lines before it are kept.
        """
        self._check_line(line, self.count)
        content = _to_bytes(line.data)
        entry = self._head.entry(line, content).text
        with _refusals(self.path, self.count):
            try:
                data, index = self._files()
                _write_all(data, content)
                _write_all(index, entry)
            except OSError:
                self._cut_back()
                raise
        self.count += 1
        self._index_end += len(entry)
        if self.count % SYNC_LINES == 0:
            self.sync()

    def mend(self, lines: Iterable[Line]) -> None:
        """Put lost lines back: one for each number in `lost`, in that order.

        Afterwards both files are what they would be had nothing been lost; killed in between, some are lost yet. Raises
        RigError: a line is out of order or of another size, or the disk refuses.
        """
        if not self.lost:
            return
        waiting, lost = list[SpoolEntry](), list(self.lost)
        for number, line in zip(lost, lines, strict=True):
            self._check_line(line, number)
            content = _to_bytes(line.data)
            with _refusals(self.path, number):
                self.close()
                with os.fdopen(open_plain(self.path, os.O_WRONLY), "wb", buffering=0) as file:
                    file.seek(number * self._line_bytes)
                    _write_all(file, content)
                waiting.append(self._head.entry(line, content))
                if len(waiting) == SYNC_LINES or number == lost[-1]:
                    self._add_entries(waiting)
                    waiting.clear()

    def sync(self) -> None:
        """Wait until the disk has every line, numbers first. Raises RigError where it refuses."""
        with _refusals(self.path, self.count):
            for file in self._files():
                os.fdatasync(file.fileno())
            self._write_envi_header()

    def recover(self) -> int:
        """Find the good lines and those that are lost, cut off what a crash left torn behind the last good one.

        Gives the number of the line to go on with. Every line is read and compared with its CRC. Raises RigError: the
        lines are of another sweep or of an earlier version.
        """
        index = read_plain(self.index_path)
        if not self._head.is_head_of(index):
            self._refuse_another(index)
        good: dict[int, SpoolEntry] = {}  # by number, of lines whose numbers are those that were written
        with plain_reader(self.path) as data:
            for number, entry in sorted(self._head.entries(index).items()):
                content = self._read(data, number)
                if len(content) == self._line_bytes and entry.fits(content):
                    good[number] = entry
        self.count = max(good, default=-1) + 1
        self.lost = [number for number in range(self.count) if number not in good]
        if self.lost:
            LOG.warning("%s: not as it was captured, and asked for again: %s", self.path, line_words(self.lost))
        self._keep_entries(index, good)
        self._cut_back()
        return self.count

    def blocks(self, size: int = SYNC_LINES) -> Iterator[list[Line]]:
        """Give the lines in blocks of ``size``; the last may be shorter.

        Raises RigError: a line has changed since it was written, or is lost and not mended; names it.
        """
        if self._data is not None:
            self.sync()
        entries = self._head.entries(read_plain(self.index_path))
        with plain_reader(self.path) as data:
            for first in range(0, self.count, size):
                numbers = range(first, min(first + size, self.count))
                yield [self._line(number, entries.get(number), data) for number in numbers]

    def close(self, *, sync: bool = True) -> None:
        """Close the files; what was appended stays."""
        try:
            if sync and self._data is not None:
                self.sync()
        finally:
            for file in (self._data, self._index):
                if file is not None:
                    file.close()
            self._data = self._index = None

    # --- files --------------------------------------------------------------------------------------------------------

    def _check_line(self, line: Line, number: int) -> None:
        if line.number != number or line.data.shape != (self.samples, self.bands):
            raise RigError(
                f"{self.path}: got line {line.number} of shape {line.data.shape}, expected line {number} of shape "
                f"{(self.samples, self.bands)} (sample, band); lines come in order, invalid ones with valid=False"
            )

    def _files(self) -> tuple[BinaryIO, BinaryIO]:
        if self._data is None or self._index is None:
            self._data = os.fdopen(open_plain(self.path, _APPEND), "ab", buffering=0)
            self._index = os.fdopen(open_plain(self.index_path, _APPEND), "ab", buffering=0)
        return self._data, self._index

    def _cut_back(self) -> None:
        """Take away what stands behind the last good line, so that the next one begins in its place."""
        self.close(sync=False)
        for path, size in ((self.path, self.count * self._line_bytes), (self.index_path, self._index_end)):
            with os.fdopen(open_plain(path, os.O_WRONLY), "wb") as file:
                file.truncate(size)

    def _refuse_another(self, index: bytes) -> None:
        """Raise RigError where an index begins with another header; one that is damaged is judged by its entries."""
        found = read_head(index)
        if found is None or found.content is None:
            LOG.warning("%s: its header has changed; lines that belong to this sweep are kept", self.index_path)
            return
        if found.content.get("format") != FORMAT:
            raise RigError(
                f"{self.index_path} was begun by another version ({found.content.get('format')!r}, this one writes "
                f"{FORMAT!r}): its lines have no checksums that this one knows; finish that capture with the version "
                f"that began it, or remove the folder to start anew"
            )
        raise RigError(
            f"{self.index_path} holds lines of another sweep ({difference(found.content, self._head.facts)}); "
            f"finish that capture, or remove the folder to start anew"
        )

    def _keep_entries(self, index: bytes, entries: Mapping[int, SpoolEntry]) -> None:
        """Have the index begin with these entries and nothing else, without a write where it does so already."""
        wanted = self._head.text + b"".join(entries[number].text for number in sorted(entries))
        self._index_end = len(wanted)
        if not index.startswith(wanted):
            staged = self.index_path.with_suffix(".index.part")
            _write_anew(staged, wanted)
            sync_path(staged)
            staged.replace(self.index_path)
            sync_path(self.index_path.parent)

    def _add_entries(self, entries: list[SpoolEntry]) -> None:
        """Enter lines that were put back, once the disk has their numbers."""
        sync_path(self.path)
        index = read_plain(self.index_path)
        known = {number: one for number, one in self._head.entries(index).items() if number not in self.lost}
        self._keep_entries(index, known | {entry.number: entry for entry in entries})
        back = {entry.number for entry in entries}
        self.lost = [number for number in self.lost if number not in back]

    def _read(self, data: BinaryIO, number: int) -> bytes:
        data.seek(number * self._line_bytes)
        return data.read(self._line_bytes)

    def _line(self, number: int, entry: SpoolEntry | None, data: BinaryIO) -> Line:
        content = self._read(data, number)
        if entry is None or not entry.fits(content):
            what = "its entry in the index" if entry is None else "CRC-32"
            raise RigError(
                f"{self.path}: line {number} has changed since it was captured ({what} differs); run again: it is "
                f"asked for again, and the other lines are kept"
            )
        numbers = np.frombuffer(content, "<u2").reshape(self.bands, self.samples)
        facts = entry.facts
        return Line(
            number=number,
            data=np.ascontiguousarray(numbers.T, np.uint16),
            mirror_x=facts["mirror_x"],
            mirror_y=facts["mirror_y"],
            time_s=facts["time_s"],
            exposure_ms=facts["exposure_ms"],
            valid=facts["valid"],
        )

    def _write_envi_header(self) -> None:
        """Say how many whole lines the ENVI file has, in one step."""
        staged = self.path.with_suffix(".hdr.part")
        _write_anew(staged, envi_header(self.samples, self.bands, self.count))
        staged.replace(self.path.with_suffix(".hdr"))


def envi_header(samples: int, bands: int, lines: int) -> bytes:
    """Header by which any ENVI program reads the numbers of a spool."""
    return (
        "ENVI\ndescription = {line spool of SpectralZoom}\n"
        f"samples = {samples}\nlines = {lines}\nbands = {bands}\n"
        "header offset = 0\nfile type = ENVI Standard\ndata type = 12\ninterleave = bil\nbyte order = 0\n"
    ).encode("ascii")


def line_words(numbers: Sequence[int]) -> str:
    """Numbers of lines for a message: the first few, and how many more."""
    named = ", ".join(str(number) for number in numbers[:MOST_NAMED])
    more = f" and {len(numbers) - MOST_NAMED} more" if len(numbers) > MOST_NAMED else ""
    return f"line{'s' if len(numbers) > 1 else ''} {named}{more}"


@contextmanager
def _refusals(path: Path, lines: int) -> Iterator[None]:
    """Turn a disk's refusal into a RigError that says how many lines are safe."""
    try:
        yield
    except RigError:
        raise
    except OSError as error:
        raise RigError(
            f"cannot write line {lines} to {path}: {disk_words(error)}; the {lines} lines before it are kept"
        ) from error


def _write_anew(path: Path, content: bytes) -> None:
    with os.fdopen(open_plain(path, _ANEW), "wb") as file:
        file.write(content)


def _write_all(file: BinaryIO, content: bytes | memoryview) -> None:
    """Write every byte; a full disk may take only some of them before it refuses."""
    view = memoryview(content)
    while view:
        view = view[os.write(file.fileno(), view) :]


def _to_bytes(data: NDArray[np.uint16]) -> memoryview:
    return np.ascontiguousarray(data.T, "<u2").data.cast("B")

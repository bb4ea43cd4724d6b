"""The line spool: what a capture writes while it runs, so that a crash loses at most the lines since the last sync.

::

    <name>.bil      raw numbers, one line after the other, bands by samples in each (an ENVI file with <name>.hdr)
    <name>.index    one JSON object a line: the header first, then number, mirror, time, exposure, valid, CRC-32

A line counts when its index entry is whole and its numbers have the CRC that the entry states.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError
from pipeline.source import Line
from storage.keys import plain
from storage.staging import sync_path

SYNC_LINES = 64
FORMAT = "spectralzoom line spool 1"


class Spool:
    """Lines on disk, appended one by one. Use as a context manager, or close it.

    Attributes
    ----------
    count
        Lines that are there; the next one appended has this number.
    """

    def __init__(self, path: Path, shape: tuple[int, int], header: Mapping[str, Any]) -> None:
        self.path = path  # of the numbers
        self.index_path = path.with_suffix(".index")
        self.samples, self.bands = shape
        self.count = 0
        self._index_end = 0
        self._head = {"format": FORMAT, "samples": shape[0], "bands": shape[1], "header": plain(dict(header))}
        self._line_bytes = shape[0] * shape[1] * 2
        self._data: BinaryIO | None = None
        self._index: BinaryIO | None = None

    @classmethod
    def open(
        cls,
        folder: Path,
        samples: int,
        bands: int,
        *,
        header: Mapping[str, Any],
        name: str = "lines",
    ) -> Spool:
        """Open the spool in ``folder``, or begin it; lines from an earlier, broken capture are kept and counted.

        Parameters
        ----------
        header
            What the lines belong to (the sweep, the source, the seed): lines of anything else are not continued.

        Raises
        ------
        RigError : the spool holds lines of another sweep, or the disk refuses.
        """
        spool = cls(folder / f"{name}.bil", (samples, bands), header)
        with _refusals(spool.path, 0):
            folder.mkdir(parents=True, exist_ok=True)
            found = spool._read_head()
            if found is not None and found != spool._head:
                raise RigError(
                    f"{spool.index_path} holds lines of another sweep ({_difference(found, spool._head)}); "
                    f"finish that capture, or remove the folder to start anew"
                )
            if found is None:
                spool._begin()
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

        Raises
        ------
        RigError : the line is out of order or of another size, or the disk refuses. The lines before it are kept.
        """
        if line.number != self.count or line.data.shape != (self.samples, self.bands):
            raise RigError(
                f"{self.path}: got line {line.number} of shape {line.data.shape}, expected line {self.count} of shape "
                f"{(self.samples, self.bands)} (sample, band); lines come in order, invalid ones with valid=False"
            )
        content = _to_bytes(line.data)
        entry = _entry(line, content)
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

    def sync(self) -> None:
        """Wait until the disk has every line, numbers first. Raises RigError where it refuses."""
        with _refusals(self.path, self.count):
            for file in self._files():
                os.fdatasync(file.fileno())
            self._write_envi_header()

    def recover(self) -> int:
        """Cut off what a crash left torn and give the number of good lines, read and compared with their CRC."""
        entries, index_end = self._entries()
        good = 0
        with self.path.open("rb") as data:
            for entry in entries:
                content = data.read(self._line_bytes)
                if len(content) < self._line_bytes or zlib.crc32(content) != entry["crc32"]:
                    break
                good += 1
        self.count, self._index_end = good, index_end[good]
        self._cut_back()
        return good

    def blocks(self, size: int = SYNC_LINES) -> Iterator[list[Line]]:
        """Give the lines in blocks of ``size``; the last may be shorter.

        Raises
        ------
        RigError : numbers have changed since they were written; names the line.
        """
        if self._data is not None:
            self.sync()
        entries, _ = self._entries()
        with self.path.open("rb") as data:
            for first in range(0, self.count, size):
                yield [self._line(entry, data) for entry in entries[first : min(first + size, self.count)]]

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

    def _files(self) -> tuple[BinaryIO, BinaryIO]:
        if self._data is None or self._index is None:
            self._data = self.path.open("ab", buffering=0)
            self._index = self.index_path.open("ab", buffering=0)
        return self._data, self._index

    def _cut_back(self) -> None:
        """Take away what stands behind the last good line, so that the next one begins in its place."""
        self.close(sync=False)
        os.truncate(self.path, self.count * self._line_bytes)
        os.truncate(self.index_path, self._index_end)

    def _begin(self) -> None:
        self.path.write_bytes(b"")
        self.index_path.write_bytes(json.dumps(self._head).encode() + b"\n")

    def _read_head(self) -> dict[str, Any] | None:
        """Header of an index that is there; None where there is none, or not even its first line is whole."""
        if not self.index_path.exists() or not self.path.exists():
            return None
        with self.index_path.open("rb") as file:
            first = file.readline()
        return _parse(first)

    def _entries(self) -> tuple[list[dict[str, Any]], list[int]]:
        """Whole index entries, in order, and where the index ends after the header and after each of them."""
        entries: list[dict[str, Any]] = []
        with self.index_path.open("rb") as file:
            ends = [len(file.readline())]
            for text in file:
                entry = _parse(text)
                if entry is None or entry.get("line") != len(entries):
                    break
                entries.append(entry)
                ends.append(ends[-1] + len(text))
        return entries, ends

    def _line(self, entry: Mapping[str, Any], data: BinaryIO) -> Line:
        content = data.read(self._line_bytes)
        if zlib.crc32(content) != entry["crc32"]:
            raise RigError(
                f"{self.path}: line {entry['line']} has changed since it was captured (CRC-32 differs); "
                f"run again: the capture goes on from the line before it"
            )
        numbers = np.frombuffer(content, "<u2").reshape(self.bands, self.samples)
        return Line(
            number=entry["line"],
            data=np.ascontiguousarray(numbers.T, np.uint16),
            mirror_x=entry["mirror_x"],
            mirror_y=entry["mirror_y"],
            time_s=entry["time_s"],
            exposure_ms=entry["exposure_ms"],
            valid=entry["valid"],
        )

    def _write_envi_header(self) -> None:
        """Say how many whole lines the ENVI file has, in one step."""
        text = (
            "ENVI\ndescription = {line spool of SpectralZoom}\n"
            f"samples = {self.samples}\nlines = {self.count}\nbands = {self.bands}\n"
            "header offset = 0\nfile type = ENVI Standard\ndata type = 12\ninterleave = bil\nbyte order = 0\n"
        )
        staged = self.path.with_suffix(".hdr.part")
        staged.write_text(text, encoding="ascii")
        staged.replace(self.path.with_suffix(".hdr"))


def read_spooled(folder: Path, name: str, shape: tuple[int, int], lines: slice) -> NDArray[np.uint16]:
    """Raw numbers of some lines of a spool, (line, sample, band), also while more are appended.

    ``shape`` is (sample, band) of a line. What is read was written by the same process: no CRC is compared.
    """
    samples, bands = shape
    count = (lines.stop - lines.start) * samples * bands
    numbers = np.fromfile(folder / f"{name}.bil", "<u2", count, offset=lines.start * samples * bands * 2)
    return np.ascontiguousarray(numbers.reshape(-1, bands, samples).transpose(0, 2, 1), np.uint16)


@contextmanager
def _refusals(path: Path, lines: int) -> Iterator[None]:
    """Turn a disk's refusal into a RigError that says how many lines are safe."""
    try:
        yield
    except RigError:
        raise
    except OSError as error:
        raise RigError(
            f"cannot write line {lines} to {path}: {error.strerror or error}; free space or rights and run again: "
            f"the {lines} lines before it are kept"
        ) from error


def _write_all(file: BinaryIO, content: bytes) -> None:
    """Write every byte; a full disk may take only some of them before it refuses."""
    view = memoryview(content)
    while view:
        view = view[os.write(file.fileno(), view) :]


def _to_bytes(data: NDArray[np.uint16]) -> bytes:
    return np.ascontiguousarray(data.T, "<u2").tobytes()


def _entry(line: Line, content: bytes) -> bytes:
    entry = {
        "line": int(line.number),
        "mirror_x": float(line.mirror_x),
        "mirror_y": float(line.mirror_y),
        "time_s": float(line.time_s),
        "exposure_ms": float(line.exposure_ms),
        "valid": bool(line.valid),
        "crc32": zlib.crc32(content),
    }
    return json.dumps(entry).encode() + b"\n"


def _parse(text: bytes) -> dict[str, Any] | None:
    """One line of the index, or None where it is torn."""
    if not text.endswith(b"\n"):
        return None
    try:
        entry = json.loads(text)
    except ValueError:
        return None
    return entry if isinstance(entry, dict) else None


def _difference(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """First thing in which two headers differ, in words."""
    have, want = ({**head, **head.get("header", {})} for head in (found, wanted))
    for name in sorted((set(have) | set(want)) - {"header"}):
        if have.get(name) != want.get(name):
            return f"{name} is {have.get(name)!r}, expected {want.get(name)!r}"
    return "its header differs"

"""ENVI cubes, lazily: the numbers stay in their file until a part of the view is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.envi_header import EnviHeader, load_envi_header

# where a data file's name may differ from its header's
DATA_ENDINGS = ("", ".bin", ".dat", ".img", ".raw", ".bil", ".bip", ".bsq", ".cube")


@dataclass(frozen=True)
class EnviCube:
    """An ENVI cube, opened. ``values`` is a read-only view of the file, (line, sample, band) in the file's type."""

    path: Path
    header: EnviHeader
    values: NDArray[Any]
    lost_lines: int  # that the header promises and the file does not hold whole
    notes: tuple[str, ...]


def open_envi_cube(path: str | Path) -> EnviCube:
    """Open a cube by its header or its data file, of any interleave, type, byte order and header offset.

    A file that is cut off keeps the lines that are whole in all bands, and ``lost_lines`` and a note say so.

    Raises
    ------
    SceneError : header or data are missing or cannot be used, or no line is whole.
    """
    header_path, data_path = find_envi_pair(Path(path))
    header = load_envi_header(header_path)
    if "spectral library" in header.kind.lower():
        raise SceneError(f"{header_path} describes a spectral library, expected a cube (line, sample, band)")
    size = data_path.stat().st_size - header.offset
    item = header.dtype.itemsize
    line_bytes = header.samples * header.bands * item
    promised = size // line_bytes if header.lines is None else header.lines
    held = min(promised, _whole_lines(header, promised, size))
    if held < 1:
        raise SceneError(
            f"{data_path} holds {max(size, 0)} bytes after an offset of {header.offset}, no whole line of "
            f"{header.samples} samples x {header.bands} bands x {item} bytes in all bands; copy it again"
        )
    notes = list(header.notes)
    if header.lines is None:
        notes.append(f"the header does not say how many lines there are; the file holds {held}")
    if held < promised:
        notes.append(f"{data_path.name} is cut off: {held} of {promised} lines are whole")
    elif size > promised * line_bytes:
        notes.append(f"{data_path.name} holds {size - promised * line_bytes} bytes more than its header says")
    values = _view(data_path, header, promised, held)
    return EnviCube(data_path, header, values, promised - held, tuple(notes))


def find_envi_pair(path: Path) -> tuple[Path, Path]:
    """Give header and data file of an address that names either.

    Raises
    ------
    SceneError : one of them is missing.
    """
    if path.suffix.lower() == ".hdr":
        stem = path.with_suffix("")
        endings = (ending for name in DATA_ENDINGS for ending in {name: None, name.upper(): None})
        data = next((file for file in (stem.with_name(stem.name + end) for end in endings) if file.is_file()), None)
        if data is None:
            raise SceneError(
                f"no data file beside {path}; expected {stem.name} or {stem.name}.bin, .dat, .img, .raw, ..."
            )
        return path, data
    if not path.is_file():
        raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
    names = [path.name + ".hdr", path.stem + ".hdr", path.name + ".HDR", path.stem + ".HDR"]
    header = next((file for file in map(path.with_name, names) if file.is_file()), None)
    if header is None:
        raise SceneError(f"no header beside {path}; expected {names[0]} or {names[1]}")
    return header, path


def _whole_lines(header: EnviHeader, lines: int, size: int) -> int:
    """Lines that ``size`` bytes hold in all bands."""
    row = header.samples * header.dtype.itemsize
    if header.interleave == "bsq":  # band after band: the last one says how far all of them reach
        return max(size - (header.bands - 1) * lines * row, 0) // row
    return max(size, 0) // (row * header.bands)


def _view(path: Path, header: EnviHeader, lines: int, held: int) -> NDArray[Any]:
    """(line, sample, band) over the file's bytes; strides alone tell the interleaves apart."""
    item, samples, bands = header.dtype.itemsize, header.samples, header.bands
    strides = {
        "bil": (bands * samples * item, item, samples * item),
        "bip": (samples * bands * item, bands * item, item),
        "bsq": (samples * item, item, lines * samples * item if bands > 1 else item),  # lines may be any promise
    }[header.interleave]
    content = np.memmap(path, np.uint8, mode="r")
    return np.ndarray((held, samples, bands), header.dtype, content, header.offset, strides)

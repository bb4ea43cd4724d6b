"""Paths into the controller's vector memory, and back to compare; cells go ten to a frame."""

from __future__ import annotations

from itertools import chain

from pipeline.errors import RigError, ShapeError
from pipeline.rig.mirror.mirror_requests import ProLink
from pipeline.rig.mirror.pro_payloads import CELL, VECTOR_CELLS, cell_float, get_vector, set_vector, split_cells
from pipeline.rig.mirror.registers import VECTOR_MEMORY
from pipeline.rig.mirror.steering import Progress, ReadBack

SAMPLED_EVERY = 10  # frames: the share that "sampled" reads back, besides the ends of both channels


def upload(link: ProLink, cells: bytes, read_back: ReadBack, progress: Progress | None = None) -> None:
    """Write cells to the vector memory from 0 on, and compare what it holds then.

    Parameters
    ----------
    cells
        X of all positions, then Y of all.
    read_back
        "none", "sampled" (every tenth frame and the ends of both channels) or "all".
    progress
        Called with cells done and cells in all, those read back included.

    Raises
    ------
    RigError : a cell holds something else; the message names it. DeviceRefused, DeadlinePassed, DeviceGone
    """
    starts = range(0, len(cells) // CELL, VECTOR_CELLS)
    checks = frames_to_check(len(starts), read_back)
    total = len(cells) // CELL + sum(_count(cells, starts[number]) for number in checks)
    done = 0
    for start in starts:
        part = _part(cells, start)
        link.tell(set_vector(VECTOR_MEMORY, start, part), f"writing cells {start} to {start + len(part) // CELL}")
        done += len(part) // CELL
        _tell(progress, done, total)
    for number in checks:
        start = starts[number]
        _compare(cells, start, read_cells(link, VECTOR_MEMORY, start, _count(cells, start)), link.wire.port)
        done += _count(cells, start)
        _tell(progress, done, total)


def frames_to_check(frames: int, read_back: ReadBack) -> list[int]:
    """Give the numbers of the frames that are read back."""
    if read_back == "none":
        return []
    if read_back == "all":
        return list(range(frames))
    half = frames // 2  # X ends and Y begins here
    ends = (0, half - 1, half, frames - 1)
    return sorted({number for number in chain(range(0, frames, SAMPLED_EVERY), ends) if 0 <= number < frames})


def read_cells(link: ProLink, register: int, start: int, count: int) -> bytes:
    """Read cells of a vector, at most as many as one frame takes."""

    def parse(payload: bytes) -> bytes:
        if len(payload) != count * CELL:
            raise ShapeError(f"expected {count} cells, got {len(payload)} bytes")
        return payload

    return link.ask(get_vector(register, start, count), f"reading cells {start} to {start + count}", parse)


def _part(cells: bytes, start: int) -> bytes:
    return cells[start * CELL : (start + VECTOR_CELLS) * CELL]


def _count(cells: bytes, start: int) -> int:
    return len(_part(cells, start)) // CELL


def _compare(cells: bytes, start: int, held: bytes, port: str) -> None:
    sent = _part(cells, start)
    if sent == held:
        return
    pairs = len(cells) // CELL // 2
    for number, (one, other) in enumerate(zip(split_cells(sent), split_cells(held), strict=True), start):
        if one != other:
            axis, position = ("X", number) if number < pairs else ("Y", number - pairs)
            raise RigError(
                f"cell {number} of the vector memory on {port} ({axis} of position {position}) holds "
                f"{cell_float(other):.9g}, {cell_float(one):.9g} was sent; nothing was moved: load the path again"
            )


def _tell(progress: Progress | None, done: int, total: int) -> None:
    if progress is not None:
        progress(done, total)

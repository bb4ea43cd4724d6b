"""Source of raw lines: what the rig, the simulator and an archive have in common."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep

AT_REST = Sweep("references", "fine", "x", 0.0, 0.0, 1)  # a line for references: the mirror at 0; 0, nothing summed


@dataclass(frozen=True)
class Line:
    """One captured line. ``data`` is (sample, band) uint16 DN, a sum over ``Sweep.binning`` neighbours."""

    number: int
    data: NDArray[np.uint16]
    mirror_x: float  # measured position at mid exposure, -1..1
    mirror_y: float
    time_s: float  # of mid exposure, since the start of the sweep
    exposure_ms: float
    valid: bool = True


@dataclass(frozen=True)
class References:
    """Dark and white frames of one sweep's binning, (sample, band) float32 DN, and the white reference's value a band.

    A sample's scene value is ``(raw - dark) / (white - dark) * white_reference``, over ``flat`` where there is one,
    over the mirror's throughput where ``by_mirror`` says that the light falls off with its tilt. ``bad`` elements of
    the detector are not trusted.
    """

    dark: NDArray[np.float32]
    white: NDArray[np.float32]
    white_reference: NDArray[np.float32]
    bad: NDArray[np.bool_] | None = None  # (sample, band)
    flat: NDArray[np.float32] | None = None  # (sample, band) relative response left over by the white frame
    by_mirror: bool = False  # white was taken at rest; away from it the mirror passes another fraction of the light

    def same_as(self, other: References) -> bool:
        """Return True if all frames of two references are equal bit for bit."""
        frames = ("dark", "white", "white_reference", "bad", "flat")
        pairs = [(getattr(self, name), getattr(other, name)) for name in frames]
        return self.by_mirror == other.by_mirror and all(
            (left is None) == (right is None) and (left is None or np.array_equal(left, right)) for left, right in pairs
        )


class Source(Protocol):
    """Something that can look at a field line by line."""

    @property
    def name(self) -> str:
        """Return what the receipt calls it: ``sim``, ``rig``, or an archive's address."""

    @property
    def camera(self) -> LineCamera:
        """The camera that takes the lines."""

    @property
    def wavelength_nm(self) -> NDArray[np.float64]:
        """(band,) centre wavelengths [nm]."""

    @property
    def field_shape(self) -> tuple[int, int]:
        """(y, x) size of the field to survey [px]."""

    def lines(self, sweep: Sweep, first: int = 0) -> Iterator[Line]:
        """Give the sweep's lines one by one, from line ``first`` on."""

    def lines_again(self, sweep: Sweep, numbers: Sequence[int]) -> Iterator[Line]:
        """Give single lines that it gave before, in order; not valid where it no longer has them."""

    def references(self, sweep: Sweep) -> References:
        """Dark and white frames with the sweep's binning."""

    @property
    def record(self) -> Mapping[str, Any] | None:
        """Return what its captures were like, for their store; None where its effects tell all of it."""


class SweepLines(Protocol):
    """The lines of one sweep, wherever they are: a stored cube, or a source that gives them when asked."""

    @property
    def sweep(self) -> Sweep:
        """The sweep that the lines belong to."""

    @property
    def references(self) -> References:
        """Dark and white frames of its binning."""

    @property
    def position(self) -> NDArray[np.float64]:
        """(line, 2) mirror X and Y at mid exposure."""

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(line,) of mid exposure, since the start of the sweep [s]."""

    @property
    def valid_line(self) -> NDArray[np.bool_]:
        """(line,) lines that can be used."""

    def read(self, start: int, stop: int) -> NDArray[np.integer[Any]]:
        """Numbers of the lines ``start`` to ``stop``: raw, (line, sample, band), or scores in steps of components."""

"""Define the interface of sources of raw lines: a rig, a recording and a simulator."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.scan import Sweep

if TYPE_CHECKING:
    from spectralzoom.pipeline.simulator.effects.effect import Chosen, Effect

RECORD = "rig.json"  # file of a source with facts of its captures
AT_REST = Sweep("references", "fine", "x", 0.0, 0.0, 1)  # a line for references: mirror at (0, 0), no binning


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
    """Dark and white frames of one sweep's binning, (sample, band) float32 DN, and the white reference's value by band.

    A sample's scene value is ``(raw - dark) / (white - dark) * white_reference``.
    With ``by_mirror`` it is divided by the mirror's throughput, which falls off with its tilt. With ``exposure_ms`` it
    is multiplied by that over the exposure of the line. ``bad`` marks unreliable elements of the detector.
    """

    dark: NDArray[np.float32]
    white: NDArray[np.float32]
    white_reference: NDArray[np.float32]
    bad: NDArray[np.bool_] | None = None  # (sample, band)
    by_mirror: bool = False  # white was taken at rest; away from it the mirror passes another fraction of the light
    exposure_ms: float | None = None  # of the white frame at the gain of the lines; None: that of every line

    def same_as(self, other: References) -> bool:
        """Return whether all frames of two references are equal bit for bit."""
        names = (one.name for one in fields(self))
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)


class Source(Protocol):
    """Lines of a field, one by one: a rig, a recording or a simulator."""

    @property
    def name(self) -> str:
        """Return its name in receipts and stores."""

    @property
    def key(self) -> Mapping[str, Any]:
        """Return what its light depends on besides scene, visit, camera, bands and sweeps; part of a capture's key."""

    @property
    def effects(self) -> Sequence[Effect]:
        """Return the simulated effects to choose from; empty of a rig and of a recording."""

    def opened(self, kept: Path) -> AbstractContextManager[Source]:
        """Return the source with its devices connected for the block.

        It may write files into the folder ``kept``, which outlives a killed process; the next one gets it again. Its
        file `RECORD`, facts of the captures, is stored with their lines.
        """

    def lines(self, sweep: Sweep, first: int = 0) -> Iterator[Line]:
        """Yield the sweep's lines one by one, from line ``first`` on."""

    def references(self, sweep: Sweep) -> References:
        """Return dark and white frames with the sweep's binning."""


class SimulatedLight(Source, Protocol):
    """A source with effects to choose from: a simulator, or a rig whose camera is a fake."""

    def with_effects(self, chosen: Chosen, clock: Mapping[str, float]) -> Source:
        """Return the source with the chosen effects, and the start of each sweep by its name [s]."""


class SweepLines(Protocol):
    """The lines of one sweep: a stored cube, or a source that computes them on request."""

    @property
    def sweep(self) -> Sweep:
        """Return the sweep of the lines."""

    @property
    def references(self) -> References:
        """Return dark and white frames of its binning."""

    @property
    def position(self) -> NDArray[np.float64]:
        """Return (line, 2) mirror X and Y at mid exposure."""

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Return (line,) times of mid exposure, since the start of the sweep [s]."""

    @property
    def exposure_ms(self) -> NDArray[np.float64]:
        """Return (line,) exposures."""

    @property
    def valid_line(self) -> NDArray[np.bool_]:
        """Return (line,) whether a line can be used."""

    def read(self, start: int, stop: int, samples: slice = slice(None)) -> NDArray[np.integer[Any]]:
        """Return the lines ``start`` to ``stop``: raw DN (line, sample, band), or scores in steps of components."""

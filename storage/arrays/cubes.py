"""Store the raw cube of one sweep, (line, sample, band) uint16, with facts of every line and statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.signal.subspace import SignalStatistics
from spectralzoom.pipeline.source import Line, References
from spectralzoom.storage.arrays import layout


@dataclass(frozen=True)
class SweepHeader:
    """Facts of a sweep that are known before its first line."""

    sweep: Sweep
    references: References
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None = None
    source: str = ""  # the source's name
    started: str | None = None  # ISO 8601; None leaves ``time`` counted from the start of the sweep
    simulation: Mapping[str, Any] | None = None  # effects that were simulated or left out; None for a rig

    @property
    def shape(self) -> tuple[int, int, int]:
        """(line, sample, band) of the cube."""
        return self.sweep.lines, self.references.dark.shape[0], len(self.wavelength_nm)

    @property
    def attributes(self) -> dict[str, Any]:
        """Facts that a store of the sweep has as attributes."""
        facts = {
            "sweep": asdict(self.sweep),
            "source": self.source,
            "started": self.started,
            "by_mirror": True if self.references.by_mirror else None,
            "white_exposure_ms": self.references.exposure_ms,
            "simulation": None if self.simulation is None else dict(self.simulation),
        }
        return {name: fact for name, fact in facts.items() if fact is not None}


class RawCubeWriter:
    """Write a sweep's lines as they come, 64 at a time, each into one shard. Use as a context manager.

    ``passed_on`` is called with every block that was written: its lines, and their numbers (line, sample, band).
    """

    def __init__(
        self,
        path: Path,
        header: SweepHeader,
        passed_on: Callable[[Sequence[Line], NDArray[np.uint16]], None] = lambda lines, raw: None,
    ) -> None:
        self._header = header
        self._group = layout.create_group(path, f"raw sweep {header.sweep.name}", header.attributes)
        bands = layout.write_bands(self._group, header.wavelength_nm, header.fwhm_nm)
        coordinates = f"{bands} time mirror_x mirror_y exposure_ms valid_line"
        about = {"long_name": "raw numbers of the camera", "units": "1", "coordinates": coordinates}
        layout.write_counts(self._group, line=header.shape[0], sample=header.shape[1])
        spec = layout.image_spec(("line", "sample", "band"), header.shape, "<u2", whole=True)
        self._dn = layout.create_array(self._group, "dn", spec, about, packing=layout.RAW_PACKING)
        write_references(self._group, header.references)
        self._passed_on = passed_on
        self._waiting: list[Line] = []
        self._facts: list[tuple[float, float, float, float, bool]] = []

    def __enter__(self) -> RawCubeWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()

    def write(self, lines: Sequence[Line]) -> None:
        """Write the next lines, in order, any number of them."""
        for line in lines:
            self._waiting.append(line)
            self._facts.append((line.time_s, line.mirror_x, line.mirror_y, line.exposure_ms, line.valid))
            if len(self._waiting) == layout.SHARD_ROWS:
                self._flush()

    def close(self) -> None:
        """Write the last lines and the lines' coordinates (IncompleteStoreError: lines are missing)."""
        if len(self._facts) != self._header.sweep.lines:
            raise IncompleteStoreError(
                f"sweep {self._header.sweep.name} has {len(self._facts)} of {self._header.sweep.lines} lines; "
                f"capture the rest before closing the cube"
            )
        self._flush()
        write_line_facts(self._group, zip(*self._facts, strict=True), self._header.started)

    def _flush(self) -> None:
        if self._waiting:
            first = self._waiting[0].number
            block = np.stack([line.data for line in self._waiting])
            self._dn[first : first + len(block)] = block
            self._passed_on(self._waiting, block)
            self._waiting.clear()


def write_references(group: zarr.Group, references: References) -> None:
    """Store the dark and white frames of a sweep, and the state of its detector."""
    about = {"units": "1", "coordinates": "wavelength"}
    frames: dict[str, tuple[tuple[str, ...], Any, type[np.generic], str]] = {
        "dark": (("sample", "band"), references.dark, np.float32, "dark reference frame"),
        "white": (("sample", "band"), references.white, np.float32, "white reference frame"),
        "white_reference": (("band",), references.white_reference, np.float32, "scene value of the white reference"),
        "bad": (("sample", "band"), references.bad, np.bool_, "bad elements of the detector"),
    }
    for name, (dims, values, kind, title) in frames.items():
        if values is not None:
            layout.write_small(group, name, dims, np.asarray(values, kind), {"long_name": title, **about})


def write_line_facts(group: zarr.Group, facts: Iterable[ArrayLike], started: str | None) -> None:
    """Store the columns ``facts``: time, mirror position X and Y, exposure and validity of every line."""
    times, x, y, exposures, valid = (np.array(column) for column in facts)
    since = {"units": "s"} if started is None else {"units": f"seconds since {started}", "standard_name": "time"}
    position = {"long_name": "mirror position at mid exposure", "units": "1", "valid_range": [-1.0, 1.0]}
    columns: dict[str, tuple[NDArray[Any], type[np.generic], dict[str, Any]]] = {
        "time": (times, np.float64, {"long_name": "mid exposure, since the start of the sweep", **since}),
        "mirror_x": (x, np.float64, position),
        "mirror_y": (y, np.float64, position),
        "exposure_ms": (exposures, np.float64, {"units": "ms"}),
        "valid_line": (valid, np.bool_, {"long_name": "line can be used"}),
    }
    for name, (values, kind, about) in columns.items():
        layout.write_small(group, name, ("line",), values.astype(kind), about)


@dataclass(frozen=True)
class StoredSweep:
    """A stored sweep, opened. Facts of lines and bands are in memory; spectra are read on request."""

    sweep: Sweep
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None
    position: NDArray[np.float64]  # (line, 2) mirror X and Y at mid exposure
    time_s: NDArray[np.float64]  # (line,) since the start of the sweep
    exposure_ms: NDArray[np.float64]  # (line,)
    valid_line: NDArray[np.bool_]  # (line,)
    source: str
    started: str | None
    group: zarr.Group

    @property
    def simulation(self) -> Mapping[str, Any] | None:
        """Effects that were simulated or left out; None for a rig's lines."""
        found = dict(self.group.attrs).get("simulation")
        return found if isinstance(found, Mapping) else None


@dataclass(frozen=True)
class RawCube(StoredSweep):
    """A stored sweep of raw numbers, opened."""

    references: References

    @property
    def shape(self) -> tuple[int, int, int]:
        """(line, sample, band)."""
        return len(self.time_s), self.references.dark.shape[0], len(self.wavelength_nm)

    def read(self, start: int = 0, stop: int | None = None, samples: slice = slice(None)) -> NDArray[np.uint16]:
        """Return the raw numbers of the lines ``start`` to ``stop``, (line, sample, band) uint16.

        Fastest on multiples of 64.
        """
        return layout.read_array(self.group, "dn", (slice(start, stop), samples))

    def read_lines(self, numbers: NDArray[np.intp]) -> NDArray[np.uint16]:
        """Return the raw numbers of single lines in ascending order, (line, sample, band) uint16.

        Each chunk is decoded once.
        """
        parts = np.split(numbers, np.flatnonzero(np.diff(numbers // layout.SHARD_ROWS)) + 1)
        return np.concatenate([self.read(int(part[0]), int(part[-1]) + 1)[part - part[0]] for part in parts])


def read_line_facts(group: zarr.Group, path: object) -> dict[str, Any]:
    """Return the values of `StoredSweep` by their names (IncompleteStoreError: damaged)."""
    wavelength, fwhm = layout.read_bands(group)
    with layout.damage_named(str(path)):
        sweep = Sweep(**dict(group.attrs)["sweep"])  # type: ignore[arg-type]
    return {
        "sweep": sweep,
        "wavelength_nm": wavelength,
        "fwhm_nm": fwhm,
        "position": np.stack([layout.read_array(group, "mirror_x"), layout.read_array(group, "mirror_y")], axis=-1),
        "time_s": layout.read_array(group, "time"),
        "exposure_ms": layout.read_array(group, "exposure_ms"),
        "valid_line": layout.read_array(group, "valid_line"),
        "source": str(group.attrs.get("source", "")),
        "started": None if "started" not in group.attrs else str(group.attrs["started"]),
        "group": group,
    }


def read_references(group: zarr.Group) -> References:
    """Read the frames that `write_references` stored."""
    dark, white, white_reference = (layout.read_array(group, name) for name in ("dark", "white", "white_reference"))
    bad = layout.read_array(group, "bad") if "bad" in group else None
    exposure = group.attrs.get("white_exposure_ms")
    exposure_ms = float(exposure) if isinstance(exposure, int | float) else None
    return References(dark, white, white_reference, bad, bool(group.attrs.get("by_mirror", False)), exposure_ms)


def open_raw_cube(path: Path) -> RawCube:
    """Open a sweep that `RawCubeWriter` stored (IncompleteStoreError: it is missing, was not closed, or is damaged)."""
    group = layout.open_group(path)
    return RawCube(**read_line_facts(group, path), references=read_references(group))


def open_raw_cubes(folder: Path) -> list[RawCube]:
    """Open the sweeps of a capture, in the order of their names; raises as `open_raw_cube`."""
    return [open_raw_cube(path) for path in sorted(folder.glob("*.zarr"))]


STATISTICS = "statistics.npz"


def read_statistics(folder: Path) -> SignalStatistics:
    """Read the statistics of a capture (IncompleteStoreError: they are missing or damaged)."""
    with layout.damage_named(str(folder / STATISTICS)), np.load(folder / STATISTICS) as stored:
        return SignalStatistics.of_arrays(stored)

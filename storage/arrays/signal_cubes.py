"""Store condensed sweeps: scores of every spectrum (component, line, sample), and the data that restore raw lines.

    spectrum = scores * step @ axes + mean          # axes in the unit of scene values

Any Zarr v3 reader opens the arrays ``scores`` (``scale_factor`` is the step), ``axes``, ``mean`` and ``noise``.
``quality`` of a spectrum is 0 where all bands were seen and 1 where some were restored from the others. It is 2 where
less than half were seen. ``rare_*`` are the residuals of spectra that the components do not represent. The dark and
white frames of the sweep are stored for a later calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from numpy.typing import NDArray

from spectralzoom.pipeline.signal.calibrate import judge_elements, line_gain
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.signal.condense import RESIDUAL_STEP, UNUSABLE
from spectralzoom.pipeline.source import References
from spectralzoom.storage.arrays import cubes, layout

FRAMES_OF = "frames_of"  # attribute: the sweep beside it that holds the dark and white frames of both
MOST_DN = np.iinfo(np.uint16).max


class LineRows(NamedTuple):
    """Facts of every line, (line,) each, in the order that `write_line_facts` takes."""

    time_s: NDArray[np.float64]
    mirror_x: NDArray[np.float64]
    mirror_y: NDArray[np.float64]
    exposure_ms: NDArray[np.float64]
    valid: NDArray[np.bool_]


class SignalCubeWriter:
    """Write a sweep's scores, some lines at a time."""

    def __init__(
        self,
        path: Path,
        header: cubes.SweepHeader,
        components: Components,
        *,
        step: float,
        largest: float,
        frames_of: str | None = None,
    ) -> None:
        """Create a sweep; ``largest`` is the greatest absolute score, ``frames_of`` a sweep with the same frames."""
        lines, samples, _ = header.shape
        self._header = header
        self._step = step
        shared = {} if frames_of is None else {FRAMES_OF: frames_of}
        self.group = layout.create_group(path, f"condensed sweep {header.sweep.name}", header.attributes | shared)
        layout.write_bands(self.group, header.wavelength_nm, header.fwhm_nm)
        layout.write_counts(self.group, line=lines, sample=samples, component=len(components))
        layout.write_components(self.group, components)
        if frames_of is None:
            cubes.write_references(self.group, header.references)
        about = {"long_name": "score of a component", "units": "1", "scale_factor": step, "largest": largest}
        shape = (len(components), lines, samples)
        spec = layout.score_spec(("component", "line", "sample"), shape, largest / step)
        self._scores = layout.create_array(self.group, "scores", spec, about)
        about = {"long_name": "0 all bands seen, 1 some restored from the others, 2 less than half seen", "units": "1"}
        spec = layout.ArraySpec(("line", "sample"), shape[1:], "|u1", (min(512, lines), samples))
        self._quality = layout.create_array(self.group, "quality", spec, about)
        self._seen: NDArray[np.uint8] = np.zeros(shape[1:], np.uint8)

    def write(self, first: int, scores: NDArray[np.floating], quality: NDArray[np.uint8]) -> None:
        """Store (line, sample, component) scores from a line on, a multiple of 64."""
        steps = layout.steps_within(scores, self._step, self._scores.dtype)
        stop = first + len(scores)
        if steps.shape[2]:
            self._scores[:, first:stop] = np.ascontiguousarray(steps.transpose(2, 0, 1)).astype(self._scores.dtype)
        self._seen[first:stop] = quality

    def close(self, facts: LineRows, rare: NDArray[np.intp], residuals: NDArray[np.int32]) -> None:
        """Store quality, facts of lines, and (rare, 2) lines and samples with (rare, band) residual steps."""
        self._quality[...] = self._seen
        cubes.write_line_facts(self.group, facts, self._header.started)
        for name, column in (("rare_line", 0), ("rare_sample", 1)):
            layout.write_small(self.group, name, ("rare",), rare[:, column].astype(np.int32), {"units": "1"})
        about = {"long_name": "residual of a rare spectrum", "units": "1", "scale_factor": RESIDUAL_STEP}
        chunk = (min(1024, max(len(residuals), 1)), residuals.shape[1])
        dtype = layout.integers_for(float(np.abs(residuals).max(initial=0)))
        spec = layout.ArraySpec(("rare", "band"), residuals.shape, dtype, chunk)
        array = layout.create_array(self.group, "rare_residual", spec, about)
        if residuals.size:
            array[...] = residuals


@dataclass(frozen=True)
class SignalCube(cubes.StoredSweep):
    """A condensed sweep, opened. Scores are read on request."""

    components: Components
    step: float
    largest: float  # greatest absolute score
    path: Path

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """(line, sample) spectra of which at least half of the bands were seen."""
        return np.asarray(layout.read_array(self.group, "quality") != UNUSABLE)

    @cached_property
    def references(self) -> References:
        """Dark and white frames."""
        shared = self.group.attrs.get(FRAMES_OF)
        if shared is not None:
            return cubes.read_references(layout.open_group(self.path.with_name(f"{shared}.zarr")))
        return cubes.read_references(self.group)

    def read(
        self, start: int = 0, stop: int | None = None, samples: slice = slice(None)
    ) -> NDArray[np.signedinteger[Any]]:
        """Return the scores of the lines ``start`` to ``stop`` in steps, (line, sample, component)."""
        return layout.read_array(self.group, "scores", (slice(None), slice(start, stop), samples)).transpose(1, 2, 0)

    @cached_property
    def rare(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Lines and samples of rare spectra, (rare,) each, by line."""
        return layout.read_array(self.group, "rare_line"), layout.read_array(self.group, "rare_sample")

    def spectra(
        self, start: int, stop: int, samples: slice = slice(None), bands: Sequence[int] | None = None
    ) -> NDArray[np.float32]:
        """Return the scene values of the lines ``start`` to ``stop`` and some samples and bands (None: all).

        Rare spectra are included.
        """
        chosen = slice(None) if bands is None else list(bands)
        law = self.components if bands is None else self.components.of_bands(bands)
        first, last, _ = samples.indices(self.usable.shape[1])
        scores = self.read(start, stop, slice(first, last)).astype(np.float32) * np.float32(self.step)
        values = law.restore(scores)
        line, sample = self.rare
        here = slice(*np.searchsorted(line, (start, start + len(values))))
        inside = (sample[here] >= first) & (sample[here] < last)
        if inside.any():
            steps = layout.read_array(self.group, "rare_residual", here)[inside][:, chosen].astype(np.float32)
            steps *= np.float32(RESIDUAL_STEP) * np.nan_to_num(law.noise).astype(np.float32)
            values[line[here][inside] - start, sample[here][inside] - first] += steps
        values[~self.usable[start:stop, first:last]] = np.nan
        return values


def read_coordinates(
    group: zarr.Group, names: Sequence[str]
) -> dict[str, tuple[tuple[str, ...], NDArray[Any], dict[str, Any]]]:
    """Read dimensions, values and attributes of the named arrays that exist (IncompleteStoreError: damaged)."""
    with layout.damage_named(str(group.store_path)):
        there = {name: one for name, one in group.arrays() if name in names}
    dims = {name: getattr(one.metadata, "dimension_names", None) or () for name, one in there.items()}
    return {
        name: (dims[name], layout.read_array(group, name), dict(there[name].attrs)) for name in names if name in there
    }


@layout.opened_once
def open_signal_cube(path: Path) -> SignalCube:
    """Open a condensed sweep. Raises IncompleteStoreError: there is none, it was not closed, or it is damaged."""
    group = layout.open_group(path)
    return SignalCube(
        **cubes.read_line_facts(group, path),
        components=layout.read_components(group),
        step=layout.step_of(group),
        largest=layout.step_of(group, "largest"),
        path=path,
    )


def open_signal_cubes(folder: Path) -> list[SignalCube]:
    """Open the condensed sweeps of a pass, in the order of their names; raises as `open_signal_cube`."""
    return [open_signal_cube(path) for path in sorted(folder.glob("*.zarr"))]


@dataclass(frozen=True)
class RestoredCube(cubes.RawCube):
    """Raw lines restored from their components: the signal in whole numbers, without noise.

    Unusable values become the largest number, which counts as saturated.
    """

    signal: SignalCube

    def read(self, start: int = 0, stop: int | None = None, samples: slice = slice(None)) -> NDArray[np.uint16]:
        """Return the numbers of the lines ``start`` to ``stop``, (line, sample, band) uint16."""
        first, last, _ = slice(start, stop).indices(len(self.time_s))
        values = self.signal.spectra(first, last)
        gain = line_gain(self.references, np.nan_to_num(self.position[first:last]), self.exposure_ms[first:last])
        values = values if gain is None else values / gain[:, None, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            numbers = np.rint(values / self._gain + self.references.dark)
        return np.where(np.isfinite(numbers), np.clip(numbers, 0, MOST_DN), MOST_DN).astype(np.uint16)[:, samples]

    @cached_property
    def _gain(self) -> NDArray[np.float32]:
        return judge_elements(self.references).gain


def open_lines(path: Path) -> cubes.RawCube:
    """Open a raw or condensed sweep as raw lines; raises as `open_raw_cube`."""
    if "dn" in layout.open_group(path):
        return cubes.open_raw_cube(path)
    one = open_signal_cube(path)
    facts = {field.name: getattr(one, field.name) for field in fields(cubes.StoredSweep)}
    return RestoredCube(**facts, references=one.references, signal=one)

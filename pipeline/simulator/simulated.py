"""The simulated source: a scene seen through the simulated instrument, digitised with noise that lines own."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera, bin_samples, digitise
from pipeline.errors import SettingsError, ShapeError
from pipeline.scan import Sweep, line_positions
from pipeline.simulator.instrument import ALL_EFFECTS, expected_lines
from pipeline.simulator.pointing import Pointing
from pipeline.simulator.scene import DEFAULT_EXPOSURE_MS, Scene
from pipeline.source import Line, References

BLOCK_LINES = 16


@dataclass(frozen=True)
class SimulatedSource:
    """A source that looks at ``scene``. Quantisation and saturation are always on, for raw lines are uint16.

    Every line draws its noise from a stream of its own, keyed (seed, sweep name, line number): neither the first line
    asked for nor the order of sweeps changes a line. With ``pointing`` the mirror looks beside the planned positions
    and still reports those.
    """

    scene: Scene
    camera: LineCamera
    seed: int = 0
    effects: frozenset[str] = ALL_EFFECTS
    name: str = "sim"
    pointing: Pointing | None = None

    def __post_init__(self) -> None:
        unknown = self.effects - ALL_EFFECTS
        if unknown:
            raise SettingsError(f"unknown effects {sorted(unknown)}; choose from {sorted(ALL_EFFECTS)}")

    @property
    def wavelength_nm(self) -> NDArray[np.float64]:
        """(band,) centre wavelengths [nm]."""
        return self.scene.wavelength_nm

    @property
    def field_shape(self) -> tuple[int, int]:
        """(y, x) size of the field [px]."""
        return self.scene.shape

    def lines(self, sweep: Sweep, first: int = 0) -> Iterator[Line]:
        """Give the sweep's lines one by one, from line ``first`` on.

        Raises
        ------
        ShapeError : sums of ``sweep.binning`` samples at full scale do not fit uint16.
        PoseError : a position of the sweep is out of the mirror's reach.
        """
        _check_binning(sweep, self.camera)
        middle = line_positions(sweep, self.camera)
        for start in range(first, sweep.lines, BLOCK_LINES):
            numbers = range(start, min(start + BLOCK_LINES, sweep.lines))
            shift = None if self.pointing is None else self.pointing.of_lines(sweep.name, numbers)
            light = expected_lines(self.scene, self.camera, sweep, numbers, effects=self.effects, shift_px=shift)
            for number, electrons in zip(numbers, light, strict=True):
                data = self._read_out(electrons, line_stream(self.seed, sweep.name, number))
                yield Line(
                    number=number,
                    data=bin_samples(data, sweep.binning),
                    mirror_x=float(middle[number, 0]),
                    mirror_y=float(middle[number, 1]),
                    time_s=(number * self.camera.frame_ms + self.camera.exposure_ms / 2) * 1e-3,
                    exposure_ms=self.camera.exposure_ms,
                )

    def references(self, sweep: Sweep) -> References:
        """Mean dark and white frames with the sweep's binning, free of noise.

        The white frame is scaled to the exposure from a shorter one, so that it does not saturate. It is taken with
        the mirror at rest.
        """
        camera, bands = self.camera, len(self.scene.wavelength_nm)
        shape = (camera.samples // sweep.binning, bands)
        dark = np.full(shape, camera.dark_dn * sweep.binning, np.float32)
        gain = sweep.binning * camera.exposure_ms / DEFAULT_EXPOSURE_MS / camera.electrons_per_dn
        white = dark + self.scene.panel_electrons.astype(np.float32) * np.float32(gain)
        panel = self.scene.panel.astype(np.float32)
        return References(dark=dark, white=white, panel=panel, by_mirror="throughput" in self.effects)

    def _read_out(self, electrons: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint16]:
        """Digitise one line with the noises that are on, (sample, band) e- -> DN."""
        shot, read = "shot" in self.effects, "read" in self.effects
        if shot and read:
            return digitise(electrons, self.camera, rng)
        if shot:
            return digitise(electrons, replace(self.camera, read_noise_e=0.0), rng)
        if not read:
            return digitise(electrons, self.camera, None)
        # The dark level goes in as electrons: noise below zero light is kept, as on the converter.
        raised = np.maximum(electrons, 0) + np.float32(self.camera.dark_dn * self.camera.electrons_per_dn)
        raised += rng.standard_normal(electrons.shape, dtype=np.float32) * np.float32(self.camera.read_noise_e)
        return digitise(raised, replace(self.camera, dark_dn=0.0), None)


def line_stream(seed: int, sweep_name: str, number: int) -> np.random.Generator:
    """Give the counter-based noise stream of one line of one sweep."""
    key = np.random.SeedSequence(entropy=seed, spawn_key=(zlib.crc32(sweep_name.encode()), number))
    return np.random.Generator(np.random.Philox(key))


def _check_binning(sweep: Sweep, camera: LineCamera) -> None:
    if sweep.binning > camera.most_binning:
        raise ShapeError(
            f"sweep {sweep.name}: sums of {sweep.binning} samples of {camera.bits} bits do not fit uint16; "
            f"bin at most {camera.most_binning}"
        )


@dataclass(frozen=True)
class SimulatedSweep:
    """The lines of one simulated sweep, made when they are read and never stored."""

    source: SimulatedSource
    sweep: Sweep

    @property
    def references(self) -> References:
        """Dark and white frames."""
        return self.source.references(self.sweep)

    @property
    def position(self) -> NDArray[np.float64]:
        """(line, 2) mirror X and Y at mid exposure."""
        return line_positions(self.sweep, self.source.camera)

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(line,) of mid exposure, since the start of the sweep [s]."""
        camera = self.source.camera
        return (np.arange(self.sweep.lines, dtype=np.float64) * camera.frame_ms + camera.exposure_ms / 2) * 1e-3

    @property
    def valid_line(self) -> NDArray[np.bool_]:
        """Every line can be used."""
        return np.ones(self.sweep.lines, bool)

    def read(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Make the lines ``start`` to ``stop``, (line, sample, band) uint16."""
        lines = islice(self.source.lines(self.sweep, first=start), stop - start)
        return np.stack([line.data for line in lines])

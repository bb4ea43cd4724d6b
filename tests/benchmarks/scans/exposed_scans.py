"""Plain scans of scene files through the camera's own operator, without a mirror: quick enough to try them all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flows.tasks.scene import judged_labels
from models.evaluation.metrics import confusion
from models.network.spectral import patches_of
from models.reading.inference import glance_of_columns, segment
from models.training.examples import electrons_of
from models.weights.files import Description, Weights
from pipeline.geometry.camera import LineCamera, expose, footprint
from pipeline.geometry.grid import SceneGrid, pad_by_reflection
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning.coverage import cheapest_full, plain_sweeps
from pipeline.planning.plain_scans import PlainScan, ScanLimits, ScanRecord, choose_scan, plain_scans
from pipeline.rectify.kernels import kernel_taps
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene

CAMERA, COST = LineCamera(), CostModel()
Scan = tuple[int, float]  # pixels from line to line, and exposure [ms]
Values = NDArray[np.float32]


class ExposedScans:
    """Plain scans of some scenes of one size, read whole by some weights, and what they cost."""

    def __init__(self, weights: Weights, scenes: Sequence[RasterScene]) -> None:
        self.weights, self.scenes = weights, scenes
        self.grid = SceneGrid(*scenes[0].shape, weights.config.patch, weights.config.factor)
        self.along = cheapest_full(self.grid, CAMERA, COST)[0]

    @cached_property
    def _labels(self) -> list[NDArray[np.uint8]]:
        weights = self.weights
        told = Description(weights.config, weights.basis, weights.class_names, weights.record)
        found = [judged_labels(scene, told) for scene in self.scenes]
        return [labels for labels in found if labels is not None]

    def _sweeps(self, step: int, exposure_ms: float | None = None) -> list[Sweep]:
        return plain_sweeps(self.grid, CAMERA, self.along, step=step, exposure_ms=exposure_ms)

    def seconds(self, step: int, exposure_ms: float) -> float:
        """Seconds of the camera of one scene."""
        return COST.seconds(self._sweeps(step, exposure_ms), CAMERA)

    def within(self, scans: Iterable[Scan], seconds: float) -> list[Scan]:
        """Those that take no longer."""
        return [scan for scan in scans if self.seconds(*scan) <= seconds + 1e-9]

    def chosen(self, seconds: float) -> PlainScan:
        """The scan that a survey of so many seconds takes."""
        record, bands = ScanRecord.read(self.weights.record["scans"]), len(self.scenes[0].wavelength_nm)
        sweeps = {step: self._sweeps(step) for step in record.steps}
        return choose_scan(plain_scans(record, sweeps, CAMERA, COST, bands, seconds=seconds), ScanLimits(seconds))

    def counts(self, step: int, exposure_ms: float) -> NDArray[np.int64]:
        """Confusion counts of each scene's map, (scene, class, class); every scan has noise of its own."""
        found = []
        for number, labels in enumerate(self._labels):
            rng = np.random.default_rng([number, step, round(10 * exposure_ms), 0x5CA])
            classes = self._read(self._exposed(number, step, exposure_ms, rng), step)
            found.append(confusion(labels, classes, self.weights.config.classes))
        return np.stack(found)

    @cached_property
    def _electrons(self) -> list[NDArray[np.float32]]:
        """What each scene gives behind the footprint in an exposure of the reference, (y, x, band)."""
        found = []
        for scene in self.scenes:
            planes = np.asarray(pad_by_reflection(scene.planes, self.grid.padded_shape), np.float32)
            found.append(electrons_of(scene, footprint(planes, CAMERA), CAMERA))
        return found

    def _exposed(self, number: int, step: int, exposure_ms: float, rng: np.random.Generator) -> Values:
        """Normalised columns of a scan's lines along y, (line, x, column); the mirror moves while one is exposed."""
        light, scene = exposure_ms / DEFAULT_EXPOSURE_MS, self.scenes[number]
        rows, across, bands = self._electrons[number].shape
        held = self._electrons[number].reshape(rows // step, step, across, bands).mean(axis=1) * np.float32(light)
        scale = (scene.panel / (scene.panel_electrons * light)).astype(np.float32)
        values = expose(held, replace(CAMERA, exposure_ms=exposure_ms), step=1, rng=rng) * scale
        return self.weights.columns(values, scene.wavelength_nm)

    def _read(self, lines: Values, step: int) -> NDArray[np.uint8]:
        """Draw the map; pixels between lines by Catmull-Rom, the coarse look by means of the lines."""
        weights, factor = self.weights, self.weights.config.factor
        count, across, columns = lines.shape
        means = lines.reshape(count * step // factor, factor // step, across // factor, factor, columns).mean(
            axis=(1, 3)
        )
        fine, seats = _between(lines, step), self.grid.valid_seats()
        patches = patches_of(fine, self.grid.patch)[seats]
        return segment(weights, glance_of_columns(weights, means, self.grid), patches, seats).classes


def _between(lines: Values, step: int) -> Values:
    """Rows of pixels, (y, x, column), from lines that are ``step`` of them wide; the border's lines are repeated."""
    if step == 1:
        return lines
    position = (np.arange(len(lines) * step) - (step - 1) / 2) / step
    index, weight = kernel_taps(position, "catmull-rom")
    found = np.zeros((len(position), *lines.shape[1:]), np.float32)
    for tap, own in zip(index.T, weight.T, strict=True):
        found += own[:, None, None] * lines[np.clip(tap, 0, len(lines) - 1)]
    return found

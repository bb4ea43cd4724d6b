"""Compute the model over a field on disk, region by region, with any worker pool.

A worker gets references to stores, opens them, holds one region in memory, and returns arrays.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from spectralzoom.models.network.machine import PROCESSOR, give_back_freed_memory
from spectralzoom.models.network.spectral import Capture, CaptureMap, LineSpec, patches_of
from spectralzoom.models.policies.policies import GLANCING_POLICIES, class_errors, gain_of, score_patches
from spectralzoom.models.reading.expected_errors import PatchExpectedErrors
from spectralzoom.models.reading.inference import (
    CoarsePass,
    CoarsePrediction,
    load_overview,
    overview_values,
    read_coarse_pass,
    read_coarse_prediction,
    save_overview,
)
from spectralzoom.models.reading.regions import HALO_PX, REGION_PX, Region, most_bytes
from spectralzoom.models.weights.checksummed_files import SEAL
from spectralzoom.models.weights.files import Description, Weights, describe_weights, load_reader, load_weights
from spectralzoom.pipeline.errors import WeightsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.kept import free_kept
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.parallel.pool import RESERVED_BYTES, Report, WorkerPool, memory_refusal, mib, run_blocks
from spectralzoom.storage.store import Ref

if TYPE_CHECKING:
    from spectralzoom.models.network.temporal_reader import TemporalReader

NO_PATCHES = np.empty(0, np.int64)
GAIN = "gain"


@dataclass(frozen=True)
class WeightsFile:
    """Path of weights and the hash of the file at the start of the survey; each process reads a part once.

    Reading raises WeightsError: the file has changed.
    """

    path: Path
    seal: str
    weights: str  # their key
    device: str = PROCESSOR  # of the network

    @staticmethod
    def of(path: Path, described: Description, device: str) -> WeightsFile:
        """Return the weights in a file with this record."""
        return WeightsFile(path, described.about[SEAL], described.key, device)

    @property
    def key(self) -> dict[str, str]:
        """Return what results depend on."""
        return {"weights": self.weights, "device": self.device}

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel with the content of the file, which other machines may lack."""
        return _weights_there, (self.seal, self.weights, self.device, self.path.read_bytes())

    def _described(self) -> Description:
        described = describe_weights(self.path)
        if described.about[SEAL] != self.seal:
            raise WeightsError(f"the weights {self.path} have changed since the survey began; start it again")
        return described

    @lru_cache(maxsize=1)  # noqa: B019 - the record is a value
    def load_reader(self) -> TemporalReader | None:
        """Read the temporal reader; None where the weights have none."""
        described = self._described()
        return None if described.reader is None else load_reader(self.path, described)

    @lru_cache(maxsize=1)  # noqa: B019 - the record is a value
    def load(self) -> Weights:
        """Read the network."""
        return load_weights(self.path, self._described()).on(self.device)


@cache
def _folder_of_weights() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="spectralzoom-weights-")


def _weights_there(seal: str, weights: str, device: str, content: bytes) -> WeightsFile:
    """Return weights to a worker, in a temporary file: a file of the same path may be another one there."""
    path = Path(_folder_of_weights().name) / f"{seal}.safetensors"
    if not path.is_file():
        path.write_bytes(content)
    return WeightsFile(path, seal, weights, device)


@dataclass(frozen=True)
class MosaicReader:
    """Base of the workers that read a mosaic by the network."""

    weights: WeightsFile
    mosaic: Ref
    capture: LineSpec  # of pixels for which the mosaic has none
    overviews: Path | None = None  # folder with overviews of regions; None: nothing is known

    def predicted(self, weights: Weights, region: Region) -> CoarsePrediction:
        """Return the coarse prediction of a region, from its overview where that is known."""
        seen = coarse_region(weights, self.mosaic, region, self.capture)
        known = None if self.overviews is None else load_overview(overview_file(self.overviews, region), weights)
        return read_coarse_prediction(weights, seen, known)


class OverviewReader(MosaicReader):
    """Worker that reads the overview of a region."""

    def __call__(self, region: Region) -> NDArray[np.float32]:
        """Return features and logits of the region."""
        return overview_values(self.predicted(self.weights.load(), region))


@dataclass(frozen=True)
class Scoring(MosaicReader):
    """Worker that scores the patches of a region by the coarse prediction."""

    policy: str = GAIN

    def __call__(self, region: Region) -> NDArray[np.float64]:
        """Return the scores of the region's own patches, (patch_y, patch_x).

        For ``gain``, which depends on the whole field, their `class_errors`, (patch_y, patch_x, 2, class).
        """
        weights = self.weights.load()
        if self.policy in GLANCING_POLICIES:
            coarse = self.predicted(weights, region)
        else:  # the policy needs only the coarse image
            seen = coarse_region(weights, self.mosaic, region, self.capture)
            coarse = CoarsePrediction(seen.grid, seen.columns, np.empty((0, 0, 0), np.float32), origin=seen.origin)
        return region.crop_patches(class_errors(coarse) if self.policy == GAIN else score_patches(self.policy, coarse))


def overview_file(folder: Path, region: Region) -> Path:
    """Return the file that keeps the overview of a region."""
    return folder / f"{region.kept.top}-{region.kept.left}.npy"


class ExpectedErrors(MosaicReader):
    """Worker that computes the expected errors of the overview at a region."""

    def __call__(self, region: Region) -> PatchExpectedErrors:
        """Return the expected errors of the region's own patches."""
        weights = self.weights.load()
        coarse = self.predicted(weights, region)
        with np.errstate(divide="ignore"):
            sure = np.log(region.crop(coarse.probability)) / weights.temperature
        sure -= scipy.special.logsumexp(sure, axis=-1, keepdims=True)
        grid = SceneGrid(*region.kept.shape, region.grid.patch)
        return PatchExpectedErrors.of([(sure, np.zeros(sure.shape[:2]))], grid, len(weights.class_names))


def coarse_region(weights: Weights, mosaic: Ref, region: Region, capture: LineSpec) -> CoarsePass:
    """Read a region of a stored mosaic, in blocks of rows, after the memory of the one before is given back.

    ``capture`` is the capture of pixels for which the mosaic has none.
    """
    free_kept()
    give_back_freed_memory()  # regions differ in size: their remainders would add up over a large field
    coarse = open_mosaic(mosaic.path / "mosaic.zarr")
    window = (region.read.rows, region.read.columns)
    mixed = coarse.captures(*window)
    how: Capture = capture if mixed is None else CaptureMap(tuple(LineSpec(*one) for one in mixed[0]), mixed[1])
    return read_coarse_pass(
        weights,
        coarse.row_blocks(*window),
        coarse.wavelength_nm,
        region.grid,
        capture=how,
        origin=region.origin,
        components=coarse.components,
    )


def seen_patches(
    field_index: NDArray[np.integer], coarse: CoarsePass, region: Region
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return numbers and spectral features (patch, p, p, column) of the chosen patches in a region.

    Patches without captured pixels are left out.
    """
    numbers = region.numbers_here(field_index)
    numbers = numbers[numbers >= 0]
    if coarse.filled is not None:
        numbers = numbers[~patches_of(coarse.filled, region.grid.patch)[numbers].all(axis=(1, 2))]
    return numbers, coarse.patches(numbers)


@dataclass(frozen=True)
class FieldWork:
    """Computation of the model over one field: weights, regions, worker pool and memory."""

    weights: WeightsFile
    regions: Sequence[Region]
    pool: WorkerPool
    memory: int  # of this process and its workers [bytes]

    @property
    def key(self) -> dict[str, Any]:
        """Return what results depend on: weights, and the division into regions where there are several."""
        several = len(self.regions) > 1
        return {"weights": self.weights, "regions": [REGION_PX, HALO_PX] if several else None}

    def write_overviews(self, mosaic: Ref, capture: LineSpec, folder: Path, report: Report) -> None:
        """Write the overviews of the regions that a folder lacks. Raises SettingsError: one does not fit the memory."""
        pool = self.pool_for(NO_PATCHES, len(open_mosaic(mosaic.path / "mosaic.zarr").components))

        def take(region: Region, values: NDArray[np.float32]) -> None:
            save_overview(overview_file(folder, region), values)

        lacking = [region for region in self.regions if not overview_file(folder, region).exists()]
        run_blocks(OverviewReader(self.weights, mosaic, capture), lacking, pool, take=take, report=report)

    def renew_overviews(
        self, mosaic: Ref, capture: LineSpec, folder: Path, before: Path, changed: NDArray[np.integer]
    ) -> None:
        """Write overviews of a mosaic into a folder: those of the folder ``before``, read again around new lines.

        ``changed`` (patch,) are those of which the new lines show a part.
        """
        halo = self.weights.load().config.halo_px
        region_of = {part: region for region in self.regions for part in region.parts(changed, halo)}
        for region in self.regions:
            shutil.copyfile(overview_file(before, region), overview_file(folder, region))
        lock = Lock()

        def take(part: Region, values: NDArray[np.float32]) -> None:
            region = region_of[part]
            file = overview_file(folder, region)
            top, left = part.kept.top - region.read.top, part.kept.left - region.read.left
            height, width = part.kept.shape
            with lock:  # parts of one region
                whole = np.load(file)
                whole[..., top : top + height, left : left + width] = values[..., *part.kept_here]
                save_overview(file, whole)

        pool = self.pool_for(NO_PATCHES, len(open_mosaic(mosaic.path / "mosaic.zarr").components))
        run_blocks(OverviewReader(self.weights, mosaic, capture), [*region_of], pool, take=take)

    def score(
        self, policy: str, mosaic: Ref, capture: LineSpec, report: Report, overviews: Path | None = None
    ) -> NDArray[np.float64]:
        """Return the scores of all patches of the padded grid, (patch_y, patch_x).

        Raises SettingsError: one region does not fit the memory.
        """
        work = Scoring(self.weights, mosaic, capture, overviews, policy)
        found = self.joined(self._of_regions(work, mosaic, NO_PATCHES, report))
        return gain_of(found[..., 0, :], found[..., 1, :].sum(axis=(0, 1))) if policy == GAIN else found

    def expected_errors(
        self, mosaic: Ref, capture: LineSpec, report: Report, overviews: Path | None = None
    ) -> PatchExpectedErrors:
        """Return the expected errors of the overview of a mosaic, by patch.

        Raises SettingsError: one region does not fit the memory.
        """
        work = ExpectedErrors(self.weights, mosaic, capture, overviews)
        parts: list[PatchExpectedErrors] = self._of_regions(work, mosaic, NO_PATCHES, report)
        shapes = [(*region.kept_patches.shape, *parts[0].wrong.shape) for region in self.regions]
        pixels = self.joined([part.pixels.reshape(shape) for part, shape in zip(parts, shapes, strict=True)])
        pixels = pixels.reshape(-1, *parts[0].wrong.shape)
        return PatchExpectedErrors(pixels, np.sum([part.wrong for part in parts], axis=0), np.zeros(len(pixels)))

    def _of_regions(
        self, worker: Callable[[Region], Any], mosaic: Ref, patch_index: NDArray[np.integer], report: Report
    ) -> list[Any]:
        """Run a worker that reads ``patch_index`` in full for all regions."""
        pool = self.pool_for(patch_index, len(open_mosaic(mosaic.path / "mosaic.zarr").components))
        return run_blocks(worker, self.regions, pool, report=report)

    def joined(self, parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Join arrays of all regions' own patches to that of the padded grid, (patch_y, patch_x, ...)."""
        whole = np.zeros((*self.regions[0].field.patch_shape, *parts[0].shape[2:]), parts[0].dtype)
        for region, part in zip(self.regions, parts, strict=True):
            whole[region.kept_patches.rows, region.kept_patches.columns] = part
        return whole

    def pool_for(self, patch_index: NDArray[np.integer], bands: int) -> WorkerPool:
        """Return the worker pool, limited by the memory of regions with these fine patches.

        Raises SettingsError: one region does not fit the memory; names the least memory.
        """
        if self.pool.elsewhere:
            return self.pool
        region = most_bytes(self.weights.load().config, self.regions, patch_index, bands)
        apart = not self.pool.shares_memory
        each = region + RESERVED_BYTES * apart
        least = RESERVED_BYTES + each
        if least > self.memory:
            y, x = (max(one.read.shape[axis] for one in self.regions) for axis in (0, 1))
            raise memory_refusal(
                least,
                self.memory,
                f"reading a region of {y} x {x} px and {bands} components with its fine patches takes "
                f"{mib(region)}, {'each of two processes' if apart else 'the process itself'} {mib(RESERVED_BYTES)}",
            )
        fits = (self.memory - RESERVED_BYTES) // each
        return self.pool if fits >= self.pool.count else WorkerPool(self.pool.scheduler, fits)

"""The model over a field on disk: its scores and its map, region by region, by whatever crew there is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.survey.region_work import Drawing, Scoring, Strange, WeightsFile
from flows.survey.run import SurveyRun, weights_path
from models.network.sizes import saliency_bytes
from models.policies.policies import IMAGE_POLICIES
from models.policies.vgg_file import VggFile
from models.reading.regions import HALO_CELLS, REGION_PX, Region, most_bytes, plan_regions, whole_field
from pipeline.errors import SettingsError
from pipeline.geometry.grid import SceneGrid
from storage.arrays.layout import SHARD_COLUMNS, SHARD_ROWS
from storage.arrays.mosaics import mosaic_wavelengths
from storage.arrays.patches import open_patches
from storage.arrays.tile_work import RESERVED_BYTES
from storage.parallel.block_work import run_blocks
from storage.parallel.crew import Crew

SHARD = (SHARD_ROWS, SHARD_COLUMNS)
IMAGE_BYTES = 128  # a coarse pixel, of what a policy of the whole image holds at once beside the columns


def region_params(grid: SceneGrid) -> dict[str, Any]:
    """What the result depends on where a field is cut: nothing where it is read whole."""
    return {} if len(plan_regions(grid, SHARD)) == 1 else {"regions": {"most_px": REGION_PX, "halo": HALO_CELLS}}


@dataclass(frozen=True)
class FieldWork:
    """The model over one field: with which weights, in which regions, by whom, and within which memory."""

    weights: WeightsFile
    regions: Sequence[Region]
    crew: Crew
    memory: int  # of this process and those that it starts, together [bytes]
    vgg: VggFile | None = None  # for the policies vgg-static and vgg-trained

    @staticmethod
    def of(run: SurveyRun) -> FieldWork:
        """Take from a survey what the regions of its field need."""
        file = WeightsFile(weights_path(run.settings).resolve(), run.weights_key)
        return FieldWork(file, plan_regions(run.grid, SHARD), run.settings.crew, run.settings.memory, run.vgg)

    def score(self, policy: str, mosaic: Path, report: Callable[[float], None]) -> NDArray[np.float64]:
        """Score every seat of the padded grid by the coarse mosaic alone, (seat_y, seat_x).

        A policy that sees the image as a whole gets the field as one region, whatever its size.

        Raises
        ------
        SettingsError : not even one region at a time, or not the whole image that such a policy needs, fits the memory.
        """
        if policy in IMAGE_POLICIES:
            return self._score_image(policy, mosaic.resolve(), report)
        vgg = self.vgg
        beside = max(saliency_bytes(one.coarse.shape, vgg.channels) for one in self.regions) if vgg else 0
        crew = self.crew_for(np.empty(0, np.int64), len(mosaic_wavelengths(mosaic)), beside=beside)
        path = mosaic.resolve()
        work, paths = Scoring(self.weights, path, policy, vgg), [path, *([vgg.path] if vgg else [])]
        parts = run_blocks(work, self.regions, crew, report=report, paths=paths)
        scores = np.zeros(self.regions[0].field.seat_shape)
        for region, part in zip(self.regions, parts, strict=True):
            scores[region.kept_seats.rows, region.kept_seats.columns] = part
        return scores

    def _score_image(self, policy: str, mosaic: Path, report: Callable[[float], None]) -> NDArray[np.float64]:
        """Score by the coarse image of the whole field: one block of work, and no reading by the model."""
        grid, crew = self.regions[0].field, self.crew
        y, x = grid.padded_shape
        image = (2 * 4 * self.weights.load().config.columns + IMAGE_BYTES) * (y * x // grid.factor**2)
        least = RESERVED_BYTES * (1 if crew.shares_memory else 2) + image
        if least > self.memory and not crew.elsewhere:
            raise SettingsError(
                f"projected memory {_mib(least)} exceeds --memory {_mib(self.memory)}: the policy {policy!r} sees the "
                f"coarse image of the field as a whole, which takes {_mib(image)}; give at least --memory "
                f"{_mib(least)}, or choose a policy that does not, such as entropy"
            )
        work = Scoring(self.weights, mosaic, policy)
        (scores,) = run_blocks(work, [whole_field(grid)], crew, report=report, paths=[mosaic])
        return np.asarray(scores, np.float64)

    def draw(self, mosaic: Path, patches: Path, out: Path, report: Callable[[float], None]) -> Strange:
        """Draw the class map into the store that was created at ``out``; count pixels that were left out.

        These are the coarse pixels, and the fine ones, with a value that the weights take for no reading.

        Raises
        ------
        SettingsError : not even one region at a time fits the memory.
        """
        store = open_patches(patches)
        crew = self.crew_for(store.seats, len(store.wavelength_nm))
        paths = mosaic.resolve(), patches.resolve(), out.resolve()
        parts = run_blocks(Drawing(self.weights, *paths), self.regions, crew, report=report, paths=paths)
        return sum(coarse for coarse, _ in parts), sum(fine for _, fine in parts)

    def check_memory(self, seats: NDArray[np.integer], bands: int) -> None:
        """Refuse a memory in which no region with its part of these seats of the field can be read.

        Raises
        ------
        SettingsError : not even one region at a time fits; names the least that does.
        """
        self.crew_for(seats, bands)

    def crew_for(self, seats: NDArray[np.integer], bands: int, *, beside: int = 0) -> Crew:
        """Give the crew, no larger than memory holds regions with their parts of these seats of the field.

        ``beside`` each region lie so many bytes more.

        Raises
        ------
        SettingsError : not even one region at a time fits the memory; names the least that does.
        """
        if self.crew.elsewhere:
            return self.crew
        region = most_bytes(self.weights.load().config, self.regions, seats, bands) + beside
        apart = not self.crew.shares_memory
        each = region + RESERVED_BYTES * apart
        least = RESERVED_BYTES + each
        if least > self.memory:
            y, x = (max(one.read.shape[axis] for one in self.regions) for axis in (0, 1))
            raise SettingsError(
                f"projected memory {_mib(least)} exceeds --memory {_mib(self.memory)}: reading a region of {y} x {x} "
                f"px and {bands} bands with the fine patches that lie there takes {_mib(region)}, "
                f"{'each of two processes' if apart else 'the process itself'} {_mib(RESERVED_BYTES)}; give at least "
                f"--memory {_mib(least)}"
            )
        fits = (self.memory - RESERVED_BYTES) // each
        return self.crew if fits >= self.crew.count else Crew(self.crew.scheduler, fits)


def _mib(size: int) -> str:
    return f"{-(-size // 2**20)} MiB"

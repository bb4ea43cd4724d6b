"""The model over a field on disk: its scores and its map, region by region, by whatever crew there is.

A worker gets paths and numbers, opens what it needs, and keeps one region in memory: arrays never travel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flows.tasks.reading_costs import SHARD
from flows.tasks.run import SurveyRun
from flows.tasks.survey_model import weights_path
from models.network.machine import PROCESSOR
from models.network.sizes import saliency_bytes
from models.policies.policies import GLANCING_POLICIES, IMAGE_POLICIES, score_seats
from models.policies.vgg_file import VggFile
from models.reading.familiar import Familiar
from models.reading.inference import CoarseLook, Glance, look_coarsely, read_glance
from models.reading.regions import HALO_CELLS, REGION_PX, Region, most_bytes, plan_regions, whole_field
from models.weights.files import Weights, describe_weights, load_familiar, load_reader, load_weights
from models.weights.sealed_files import SEAL
from pipeline.errors import SettingsError, WeightsError
from pipeline.geometry.grid import SceneGrid
from pipeline.readings import beyond_range, readings_alone
from storage.arrays.mosaics import PATCHES_A_SHARD, PatchStore, mosaic_strips, mosaic_wavelengths
from storage.arrays.tile_work import RESERVED_BYTES, let_tiles_go
from storage.parallel.crew import Crew, run_blocks

if TYPE_CHECKING:
    from models.network.memory_reader import MemoryReader


@dataclass(frozen=True)
class WeightsFile:
    """Weights by their path, and the seal of the file when the survey began; each part is read once a process.

    Reading raises WeightsError where the file has changed since.
    """

    path: Path
    seal: str
    device: str = PROCESSOR  # where the network computes

    def _check(self) -> None:
        if describe_weights(self.path).about[SEAL] != self.seal:
            raise WeightsError(f"the weights {self.path} have changed since the survey began; start it again")

    @lru_cache(maxsize=1)  # noqa: B019 - the record is a value
    def load_reader(self) -> MemoryReader | None:
        """Read the reader of prior maps; None where the weights have none."""
        self._check()
        return None if describe_weights(self.path).reader is None else load_reader(self.path)

    @lru_cache(maxsize=1)  # noqa: B019 - the record is a value
    def load_familiar(self) -> Familiar:
        """Read what is familiar to them."""
        self._check()
        return load_familiar(self.path)

    @lru_cache(maxsize=1)  # noqa: B019 - the record is a value
    def load(self) -> Weights:
        """Read the network."""
        self._check()
        return load_weights(self.path).on(self.device)


@dataclass(frozen=True)
class Scoring:
    """Scores seats by the glance at a region: what a worker needs for that."""

    weights: WeightsFile
    mosaic: Path
    policy: str
    vgg: VggFile | None = None

    def __call__(self, region: Region) -> NDArray[np.float64]:
        """Scores of the seats that are kept, (seat_y, seat_x)."""
        let_tiles_go()
        weights = self.weights.load()
        look = look_at(weights, self.mosaic, region)
        if self.policy in GLANCING_POLICIES:
            seen = read_glance(weights, look)
        else:  # nothing but the coarse image is asked for
            seen = Glance(look.grid, look.columns, np.empty((0, 0, 0), np.float32), origin=look.origin)
        network = None if self.vgg is None else self.vgg.saliency(weights)
        return region.crop_seats(score_seats(self.policy, seen, network=network))


def look_at(weights: Weights, mosaic: Path, region: Region) -> CoarseLook:
    """Read the part of a stored coarse mosaic that a region needs, some rows at a time."""
    strips = mosaic_strips(mosaic, region.coarse.rows, region.coarse.columns)
    return look_coarsely(weights, strips, mosaic_wavelengths(mosaic), region.grid, origin=region.origin)


def seat_columns(
    weights: Weights,
    store: PatchStore,
    wavelength_nm: NDArray[np.float64],
    seen: CoarseLook,
    region: Region,
    *,
    strange: NDArray[np.int64] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Numbers and normalised spectral columns (seat, p, p, column) of a region's patches, some read at a time.

    A mirror that looks beside the plan leaves pixels of a seat unseen: they take the columns of the coarse pixel over
    them, and so do those with a number that is no reading in every band. A seat of which nothing was seen is left out.
    Pixels with such a number are counted in ``strange``, (seat,) of the region's scene.
    """
    numbers = region.numbers_here(store.seats)
    here = np.flatnonzero(numbers >= 0)
    p, count, kept = region.field.patch, len(here), 0
    seats, columns = np.empty(count, np.int64), np.empty((count, p, p, weights.basis.columns), np.float32)
    for first in range(0, count, PATCHES_A_SHARD):
        entries = here[first : first + PATCHES_A_SHARD]
        values, most = store.pick(entries), weights.normalisation.most_value
        if (wild := beyond_range(values, most)) is not None and strange is not None:
            strange[numbers[entries]] = wild.any(axis=-1).sum(axis=(1, 2))
        values = readings_alone(values, most)
        reached = np.asarray(np.isfinite(values).any(axis=-1), np.bool_)
        some = np.asarray(reached.any(axis=(1, 2)), np.bool_)
        part = slice(kept, kept := kept + int(some.sum()))
        seats[part] = numbers[entries][some]
        columns[part] = weights.columns(values[some], wavelength_nm)
        pixel = np.arange(p)
        for patch, seat, there in zip(columns[part], seats[part], reached[some], strict=True):
            if not there.all():  # where no line reached a pixel of a seat
                y, x = seen.grid.seat_origin(seat)[..., None] + pixel
                coarse = seen.columns[np.ix_(y // seen.grid.factor, x // seen.grid.factor)]
                patch[~there] = coarse[~there]
    return seats[:kept], columns[:kept]


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
        file = WeightsFile(weights_path(run.settings).resolve(), run.described.about[SEAL], run.device)
        return FieldWork(file, plan_regions(run.grid, SHARD), run.settings.crew, run.settings.memory, run.vgg)

    def score(self, policy: str, mosaic: Path, report: Callable[[float], None]) -> NDArray[np.float64]:
        """Score every seat of the padded grid by the coarse mosaic alone, (seat_y, seat_x).

        A policy that sees the image as a whole gets the field as one region, whatever its size. Raises SettingsError:
        not even one region at a time, or not the whole image that such a policy needs, fits the memory.
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

    def crew_for(self, seats: NDArray[np.integer], bands: int, *, beside: int = 0) -> Crew:
        """Give the crew, no larger than memory holds regions with their parts of these seats of the field.

        ``beside`` each region lie so many bytes more. Raises SettingsError: not even one region at a time fits the
        memory; names the least that does.
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

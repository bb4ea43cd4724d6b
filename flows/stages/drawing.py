"""Draw a field's map region by region: the current visit, fused with the prior map of the field.

As in `flows.stages.field_work`, a worker gets references to stores and returns arrays, which the survey's process
writes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.frame import Prior
from spectralzoom.flows.stages.field_work import (
    GAIN,
    FieldWork,
    Scoring,
    WeightsFile,
    coarse_region,
    overview_file,
    seen_patches,
)
from spectralzoom.models.evaluation.unlike_scenes import STRIDE, SceneSpectra, TrainingSpectra
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.policies import class_errors, gain_of
from spectralzoom.models.reading.inference import (
    CoarsePass,
    CoarsePrediction,
    load_overview,
    read_coarse_prediction,
    segment,
)
from spectralzoom.models.reading.prior_map import (
    ClassProbabilities,
    CurrentVisit,
    PriorMap,
    TemporalAgreement,
    as_captured,
    changed_from,
    compare,
    first_probabilities,
    fuse,
    in_classes,
    pooled,
)
from spectralzoom.models.reading.regions import Region
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.geometry.grid import pad_by_reflection, patch_pixels
from spectralzoom.storage.arrays.class_maps import (
    MAP,
    PROBABILITIES,
    ProbabilityStore,
    packed_probabilities,
    write_class_tile,
    write_probabilities_tile,
)
from spectralzoom.storage.arrays.mosaics import Mosaic, chosen_patches, open_mosaic
from spectralzoom.storage.parallel.pool import run_blocks
from spectralzoom.storage.store import Ref

MOST_OVERVIEWS = 16  # regions whose overviews are kept: 0.5 GB; they say how frequent each class is in the field
ENOUGH_SEEN = 0.5  # least covered fraction of a patch at the edge of a partial scan


@dataclass(frozen=True)
class Drawing:
    """Draws a region of the class map: what a worker needs for that."""

    weights: WeightsFile
    mosaic: Ref
    attention: Ref  # whose ranks say which patches are read in detail
    capture: LineSpec  # of the mosaic's pixels, where it does not say so itself
    prior: Prior | None = None  # prior map of the field
    left_out: NDArray[np.bool_] | None = None  # (y, x) pixels of which zones have no map drawn
    part: bool = False  # whether the scan covers a part of the field; the rest is that of the prior map
    spectra: TrainingSpectra | None = None  # what those of the region are compared with
    choice: GainChoice | None = None  # of the patches that are read in full; None: all that ``attention`` ranks
    overviews: Path | None = None  # folder with those of some regions, which are not computed again

    @property
    def chosen(self) -> NDArray[np.int64]:
        """Return the numbers of the patches that the attention ranks, ascending."""
        return chosen_patches(self.attention.path / "attention.zarr")

    def __call__(self, region: Region) -> DrawnRegion:
        """Read what was seen of the region coarsely and finely, and return the part of the map that is kept."""
        weights = self.weights.load()
        mosaic = open_mosaic(self.mosaic.path / "mosaic.zarr")
        chosen = self.chosen
        seen = coarse_region(weights, self.mosaic, region, self.capture)
        known = None if self.overviews is None else load_overview(overview_file(self.overviews, region), weights)
        if self.choice is not None or known is not None:
            seen = read_coarse_prediction(weights, seen, known)
        if self.choice is not None:
            assert isinstance(seen, CoarsePrediction)
            gain = gain_of(class_errors(seen)[:, 0], self.choice.class_pixels)
            here = region.numbers_here(chosen)
            chosen = chosen[(here >= 0) & (gain[here] >= self.choice.least_gain)]
        if not weights.config.corrected:  # a patch in full is its overview
            chosen = chosen[:0]
        patch_index, columns = seen_patches(chosen, seen, region)
        drawn = segment(weights, seen, columns, patch_index, every_class=True)
        del columns  # a prior map takes their room
        shown = self._shown(region, mosaic)
        if seen.out_of_range is not None:
            shown &= ~seen.out_of_range
        assert drawn.log_probability is not None
        observation = self._observation(region, drawn.log_probability, shown, seen)
        classes, confidence = drawn.classes, drawn.confidence
        comparison = None
        old = None
        if self.prior is None:
            after = first_probabilities(observation)
            if not shown.all():
                classes, confidence = after.classes()
        else:
            local = prior_map_of(self.prior, region, weights)
            after = fuse(local, observation, self.weights.load_reader())
            classes, confidence = after.classes()
            comparison = compare(local, observation, after, region.kept_here)
            old = changed_from(local, after)
            after = as_captured(local, after)
        reading = None
        if self.choice is not None:
            read = np.isin(region.grid.every_patch(), patch_index).reshape(gain.shape)
            reading = FullReading(region.crop_patches(gain), region.crop_patches(read))
        unread = 0 if seen.out_of_range is None else int(np.count_nonzero(region.crop(seen.out_of_range)))
        return DrawnRegion(
            region.crop(classes),
            region.crop(confidence),
            packed_probabilities(region.crop(after.log_probability)),
            region.crop(after.age_days),
            region.crop(after.light),
            None if old is None else region.crop(old),
            Drawn(unread, self._spectra(region, shown, seen), comparison, reading),
        )

    def _spectra(self, region: Region, shown: NDArray[np.bool_], seen: CoarsePass) -> SceneSpectra | None:
        """Return the statistics of the spectra in the kept part that were captured."""
        if self.spectra is None:
            return None
        if self.left_out is not None:
            shown = shown & ~self.left_out[region.read.rows, region.read.columns]
        seen_here = region.crop(shown)
        if seen.filled is not None:
            seen_here = seen_here & ~region.crop(seen.filled)
        return self.spectra.of(region.crop(seen.columns)[::STRIDE, ::STRIDE], seen_here[::STRIDE, ::STRIDE])

    def _observation(
        self, region: Region, log_probability: NDArray[np.float32], shown: NDArray[np.bool_], seen: CoarsePass
    ) -> CurrentVisit:
        """Return the current visit; NaN where it captured nothing or zones leave pixels out: the prior map stays."""
        if self.left_out is not None:
            away = self.left_out[region.read.rows, region.read.columns]
            log_probability = np.where(away[..., None], np.float32(np.nan), log_probability)
        if not shown.all():
            log_probability = np.where(shown[..., None], log_probability, np.float32(np.nan))
        own_light = np.zeros(seen.grid.padded_shape, np.float32)
        for spec in seen.capture.specs:
            here = seen.capture.where(spec)
            own_light[... if here is None else here] = spec.light / spec.step**2
        light, step, _ = seen.capture.usual
        coarse = seen.columns[:0] if self.prior is None else pooled(seen.seen_columns)
        return CurrentVisit(log_probability, shown, coarse, light, int(step), own_light[: len(shown), : shown.shape[1]])

    def _shown(self, region: Region, mosaic: Mosaic) -> NDArray[np.bool_]:
        """Return the pixels (y, x) of a region that were captured.

        In a partial scan, these are pixels that lines cover, in patches with enough of them. Filled pixels beside them
        would replace better values of the prior map.
        """
        covered = mosaic.coverage(region.read.rows, region.read.columns) > 0
        if not self.part:
            return covered
        reached = patch_pixels(region.grid, covered)
        rows, columns = region.grid.patch_shape
        p = region.grid.patch
        enough = ENOUGH_SEEN * region.grid.valid_fraction().reshape(-1, 1, 1)  # of a patch at the border of the field
        reached &= reached.mean(axis=(1, 2), keepdims=True) >= enough
        pixels = reached.reshape(rows, columns, p, p).swapaxes(1, 2).reshape(rows * p, columns * p)
        return np.ascontiguousarray(pixels[: region.grid.height, : region.grid.width])


def prior_map_of(prior: Prior, region: Region, weights: Weights) -> PriorMap:
    """Read the prior map of a region, in the classes of the weights."""
    store = ProbabilityStore(prior.probabilities.path / PROBABILITIES)
    values, age, light = store.read(region.read.rows, region.read.columns)
    untaught = weights.config.untaught
    if untaught or prior.classes != tuple(range(values.shape[-1])) or np.isneginf(values).any():
        values = in_classes(values, prior.classes, untaught)
    height, width = region.read.shape
    columns = coarse_region(weights, prior.mosaic, region, LineSpec()).seen_columns[:height, :width]
    whole = np.asarray(pad_by_reflection(columns, region.grid.padded_shape), np.float32)
    return PriorMap(ClassProbabilities(values, age, light), pooled(whole), prior.days, prior.day_of_year)


@dataclass(frozen=True)
class GainChoice:
    """Choice of patches by their gain: by how frequent the classes are in the field, as its overviews say."""

    least_gain: float
    class_pixels: NDArray[np.float64]  # (class,) expected in those regions


@dataclass(frozen=True)
class FullReading:
    """Patches and the full network, (patch_y, patch_x) each."""

    gain: NDArray[np.float64]  # expected gain by the policy
    read: NDArray[np.bool_]  # patches that it read


@dataclass(frozen=True)
class Drawn:
    """Result of segmenting a region, or a field."""

    unread_px: int  # captured pixels with values out of range
    spectra: SceneSpectra | None  # of captured pixels; None where nothing is known of the training's
    comparison: TemporalAgreement | None  # with the prior map; None without one
    reading: FullReading | None = None  # None where patches were chosen before


@dataclass(frozen=True)
class DrawnRegion:
    """The part of the map that a region keeps: (y, x) images as they are stored."""

    classes: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    packed: NDArray[np.uint8]  # (y, x, class) `packed_probabilities`
    age_days: NDArray[np.float32]
    light: NDArray[np.float32]
    old_class: NDArray[np.uint8] | None  # None without a prior map
    drawn: Drawn


def draw_field(
    field: FieldWork,
    work: Drawing,
    path: Path,
    least_gain: float | None,
    report: Callable[[float], None],
    known: tuple[Path, NDArray[np.intp]] | None = None,
) -> Drawn:
    """Draw class map and class probabilities into the stores that were created for them in the folder ``path``.

    With ``least_gain``, the full network reads the patches with that gain, among those that the attention ranks.
    ``known`` are a folder with overviews, and the patches that changed since.
    Raises SettingsError: not even one region at a time fits the memory.
    """
    pool = field.pool_for(work.chosen, len(open_mosaic(work.mosaic.path / "mosaic.zarr").components))

    def take(region: Region, images: DrawnRegion) -> Drawn:
        origin = region.kept.top, region.kept.left
        write_class_tile(path / MAP, origin, images.classes, images.confidence)
        beside = images.age_days, images.light, images.old_class
        write_probabilities_tile(path / PROBABILITIES, origin, images.packed, *beside)
        return images.drawn

    begun = 0.0
    with TemporaryDirectory(prefix="overviews-", dir=path) as temporary:
        folder = Path(temporary)
        if known is not None:
            field.renew_overviews(work.mosaic, work.capture, folder, *known)
        if least_gain is not None:
            begun = 0.3
            some = replace(field, regions=field.regions[:: -(-len(field.regions) // MOST_OVERVIEWS)])
            some.write_overviews(work.mosaic, work.capture, folder, lambda done: report(0.8 * begun * done))
            scoring = Scoring(work.weights, work.mosaic, work.capture, folder, GAIN)
            found = run_blocks(scoring, some.regions, pool, report=lambda done: report(begun * (0.8 + 0.2 * done)))
            class_pixels = np.sum([one[..., 1, :].sum(axis=(0, 1)) for one in found], axis=0)
            work = replace(work, choice=GainChoice(least_gain, class_pixels))
        work = replace(work, overviews=folder)
        parts: list[Drawn] = run_blocks(
            work, field.regions, pool, take=take, report=lambda done: report(begun + (1 - begun) * done)
        )
    compared = [part.comparison for part in parts if part.comparison is not None]
    reading = None
    if read := [part.reading for part in parts if part.reading is not None]:
        reading = FullReading(field.joined([one.gain for one in read]), field.joined([one.read for one in read]))
    spectra = [part.spectra for part in parts if part.spectra is not None]
    return Drawn(
        sum(part.unread_px for part in parts),
        reduce(add, spectra) if spectra else None,
        reduce(add, compared) if compared else None,
        reading,
    )

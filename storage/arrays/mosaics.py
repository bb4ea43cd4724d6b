"""Store mosaics, scores (component, y, x) on the scene grid; and attention, the scores by which patches are chosen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.pipeline.geometry.grid import cuts
from spectralzoom.pipeline.signal.components import Components, broad_weights
from spectralzoom.storage.arrays import layout
from spectralzoom.storage.arrays.georeference import AngularGrid, create_placed_group

CAPTURES = "capture"  # array of a mosaic whose pixels were captured in several ways
RGB_NM = (640.0, 550.0, 460.0)  # shown as red, green and blue
FAR_NM = 60.0  # largest distance of a band from the colour that shows it
MID_GREY = 0.42  # of the median of a picture


class MosaicWriter:
    """Write a mosaic in tiles of whole shards, so that it need not fit into memory."""

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int],
        components: Components,
        wavelength_nm: NDArray[np.float64],
        *,
        step: float = 1.0,
        largest: float = layout.LARGEST_SHORT,
        fwhm_nm: NDArray[np.float64] | None = None,
        grid: AngularGrid | None = None,
        simulation: Mapping[str, Any] | None = None,
    ) -> None:
        """Create a mosaic of (y, x) ``shape``; ``largest`` is the greatest absolute score."""
        simulated = {} if simulation is None else {"simulation": dict(simulation)}
        self.path = path
        self.group, place = create_placed_group(path, "mosaic", grid, shape, simulated)
        layout.write_bands(self.group, wavelength_nm, fwhm_nm)
        layout.write_counts(self.group, component=len(components))
        layout.write_components(self.group, components)
        about = {"long_name": "score of a component", "units": "1", "scale_factor": step, **place}
        spec = layout.score_spec(("component", "y", "x"), (len(components), *shape), largest / step)
        self._scores = layout.create_array(self.group, "scores", spec, about | {"_FillValue": _unseen(spec.dtype)})
        about = {"long_name": "sweeps that saw a pixel", "units": "1", **place}
        self._step = step
        self._coverage = layout.create_array(self.group, "coverage", layout.image_spec(("y", "x"), shape, "|u1"), about)

    @property
    def tile_shape(self) -> tuple[int, int]:
        """(y, x) size of a shard: 64 rows of at most 640 columns."""
        _, rows, columns = self._scores.shards or self._scores.chunks
        return rows, columns

    def write_tile(
        self,
        first_row: int,
        first_column: int,
        scores: NDArray[np.floating],
        coverage: NDArray[np.integer[Any]] | NDArray[np.bool_],
    ) -> None:
        """Store (y, x, component) scores, NaN where nothing was seen, and (y, x) coverage of whole shards.

        Threads may write different tiles at once. Raises ShapeError: scores and coverage are not of one tile.
        """
        count = self._scores.shape[0]
        if scores.shape != (*coverage.shape, count):  # Zarr would broadcast a smaller tile
            raise ShapeError(f"a tile of the mosaic has the shape {scores.shape}, expected {(*coverage.shape, count)}")
        rows, columns = layout.tile_place((first_row, first_column), coverage.shape)
        seen = coverage > 0
        if count:
            steps = layout.steps_within(scores, self._step, self._scores.dtype)
            seen = seen & np.isfinite(scores).all(axis=2)
            steps = np.where(seen[..., None], steps, np.float32(_unseen(self._scores.dtype.str)))
            self._scores[:, rows, columns] = np.ascontiguousarray(steps.transpose(2, 0, 1)).astype(self._scores.dtype)
        self._coverage[rows, columns] = np.where(seen, coverage, 0).astype(np.uint8)

    def write_rows(self, first: int, scores: NDArray[np.floating], seen: NDArray[np.bool_]) -> None:
        """Store rows of scores (y, x, component) and of the mask ``seen`` (y, x); ``first`` is a multiple of 64."""
        self.write_tile(first, 0, scores, seen)

    def blank(self, where: NDArray[np.bool_] | None) -> None:
        """Set the (y, x) pixels ``where``, which show no scene, to unseen; None: all show it."""
        if where is not None:
            layout.blank_pixels(self.path, where, {"scores": _unseen(self._scores.dtype.str), "coverage": 0})

    def write_captures(self, specs: Sequence[Sequence[float]], number: NDArray[np.integer[Any]]) -> None:
        """Store the kind of capture of each pixel: ``number`` (y, x) is an index into ``specs``, which may repeat."""
        kinds = list(dict.fromkeys(map(tuple, specs)))
        of_spec = np.array([kinds.index(tuple(one)) for one in specs], np.min_scalar_type(max(len(kinds) - 1, 0)))
        about = {"long_name": "kind of capture", "units": "1", "kinds": [list(one) for one in kinds]}
        layout.write_image(self.group, CAPTURES, ("y", "x"), of_spec[number], about)


def _unseen(dtype: str) -> int:
    """Return the value of a pixel without a score, CF's ``_FillValue``."""
    return int(np.iinfo(np.dtype(dtype)).min)


@dataclass(frozen=True)
class Mosaic:
    """A stored mosaic, opened: scores are read on request, components give the spectra."""

    group: zarr.Group
    components: Components
    step: float
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x) [px]."""
        y, x = layout.array_of(self.group, "coverage").shape
        return y, x

    def scores(self, rows: slice = slice(None), columns: slice = slice(None)) -> NDArray[np.float32]:
        """Return the scores of some pixels, (y, x, component) float32, NaN where no line was captured.

        Raises IncompleteStoreError: a checksum says that the bytes have changed.
        """
        steps = layout.read_array(self.group, "scores", (slice(None), rows, columns)).transpose(1, 2, 0)
        found = steps.astype(np.float32) * np.float32(self.step)
        if steps.shape[2]:
            found[steps[..., 0] == np.iinfo(steps.dtype).min] = np.nan
        return found

    def coverage(self, rows: slice = slice(None), columns: slice = slice(None)) -> NDArray[np.uint8]:
        """Return the number of sweeps that saw each pixel, (y, x)."""
        return layout.read_array(self.group, "coverage", (rows, columns))

    def captures(
        self, rows: slice = slice(None), columns: slice = slice(None)
    ) -> tuple[list[tuple[float, ...]], NDArray[np.uint8]] | None:
        """Return the kinds of capture and each pixel's number among them, (y, x); None where all were captured alike.

        Raises IncompleteStoreError: a checksum says that the bytes have changed.
        """
        if CAPTURES not in self.group:
            return None
        kinds: Any = self.group[CAPTURES].attrs["kinds"]
        return [tuple(one) for one in kinds], layout.read_array(self.group, CAPTURES, (rows, columns))

    def values(
        self, rows: slice = slice(None), columns: slice = slice(None), bands: Sequence[int] | None = None
    ) -> NDArray[np.float32]:
        """Return the scene values (y, x, band) of some pixels and bands (None: all), float32.

        NaN stands where no line was captured.
        """
        found = self.spectra(self.scores(rows, columns), bands)
        if not len(self.components):
            found[self.coverage(rows, columns) == 0] = np.nan
        return found

    def spectra(self, scores: NDArray[np.float32], bands: Sequence[int] | None = None) -> NDArray[np.float32]:
        """Return the scene values (..., band) of some bands of scores (..., component)."""
        return (self.components if bands is None else self.components.of_bands(bands)).restore(scores)

    def thinned(self, step: int, bands: Sequence[int]) -> NDArray[np.float32]:
        """Return the scene values of every ``step``-th pixel in some bands, (y, x, band).

        They are read a shard's rows at a time.
        """
        blocks = (
            self.scores(rows)[-rows.start % step :: step, ::step] for rows in cuts(self.shape[0], layout.SHARD_ROWS)
        )
        return np.concatenate([self.spectra(block, bands) for block in blocks])

    def brightness(self, bands: int | None = None) -> NDArray[np.float32]:
        """Return the mean over the bands, (y, x), NaN where not captured; ``bands`` limits it to so many of them."""
        weights, offset = broad_weights(self.components, bands or self.components.bands)
        return np.concatenate([np.asarray(block @ weights + offset, np.float32) for block in self.row_blocks()])

    def row_blocks(self, rows: slice = slice(None), columns: slice = slice(None)) -> Iterator[NDArray[np.float32]]:
        """Yield the scores of a window, (y, x, component), from the top down in blocks that end at shards."""
        first, last, _ = rows.indices(self.shape[0])
        while first < last:
            below = min((first // layout.SHARD_ROWS + 1) * layout.SHARD_ROWS, last)
            yield self.scores(slice(first, below), columns)
            first = below


@layout.opened_once
def open_mosaic(path: Path) -> Mosaic:
    """Open a mosaic. Raises IncompleteStoreError where it is missing or damaged."""
    group = layout.open_group(path)
    return Mosaic(group, layout.read_components(group), layout.step_of(group), *layout.read_bands(group))


@dataclass(frozen=True)
class Attention:
    """Scores of all patches, and the order in which they were chosen."""

    score: NDArray[np.float64]  # (patch_y, patch_x), NaN where there is none
    rank: NDArray[np.int32]  # (patch_y, patch_x), 0 = chosen first, -1 = not chosen
    policy: str


def write_attention(path: Path, attention: Attention) -> None:
    """Store scores and ranks."""
    group = layout.create_group(path, "attention", {"policy": attention.policy})
    layout.write_counts(group, patch_y=attention.score.shape[0], patch_x=attention.score.shape[1])
    images: dict[str, tuple[Any, type[np.generic], str]] = {
        "score": (attention.score, np.float64, f"worth of a fine look, policy {attention.policy}"),
        "rank": (attention.rank, np.int32, "order in which the patch was chosen, from 0; -1 where it was not"),
    }
    for name, (values, kind, title) in images.items():
        about = {"long_name": title, "units": "1"}
        layout.write_image(group, name, ("patch_y", "patch_x"), np.asarray(values, kind), about)


def chosen_patches(path: Path) -> NDArray[np.int64]:
    """Return the numbers of the patches that an attention store chose, ascending.

    Raises IncompleteStoreError: missing or damaged.
    """
    return np.flatnonzero(layout.read_array(layout.open_group(path), "rank").ravel() >= 0)


def choose_bands(wavelength_nm: NDArray[np.floating]) -> tuple[tuple[int, int, int], str]:
    """Return the bands to show as red, green and blue, and a caption.

    These are those nearest to 640, 550 and 460 nm, if within 60 nm. Otherwise they are the longest, middle and shortest
    wavelength.
    """
    waves = np.asarray(wavelength_nm, np.float64)
    red, green, blue = (int(np.argmin(np.abs(waves - target))) for target in RGB_NM)
    off = max(abs(waves[band] - target) for band, target in zip((red, green, blue), RGB_NM, strict=True))
    if len(waves) == 1:
        return (0, 0, 0), f"grey, {waves[0]:.0f} nm"
    kind = "true colour"
    if len({red, green, blue}) < 3 or off > FAR_NM:
        kind = "false colour"
        order = np.argsort(waves, kind="stable")
        red, green, blue = (int(order[place]) for place in (-1, (len(order) - 1) // 2, 0))
    return (red, green, blue), f"{kind}, {waves[red]:.0f} / {waves[green]:.0f} / {waves[blue]:.0f} nm"


def stretch(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Return the 2nd to 98th percentile of each band as 0..1, (y, x, band) float32.

    NaN becomes light grey, a flat band black.
    """
    values = np.asarray(image, np.float32)
    shown = np.full(values.shape, 0.86, np.float32)
    for band in range(values.shape[-1]):
        plane = values[..., band]
        known = np.isfinite(plane)
        if known.any():
            low, high = np.percentile(plane[known], (2, 98))
            span = high - low if high > low else np.inf
            shown[..., band] = np.where(known, np.clip((plane - low) / span, 0, 1), 0.86)
    return shown


def develop(image: NDArray[np.generic], caption: str) -> NDArray[np.float32]:
    """Return three bands as a picture (y, x, 3) float32 0..1, with the ``caption`` of `choose_bands`.

    True colours have one scale; other bands are stretched each.
    """
    values = np.asarray(image, np.float32)
    known = values[np.isfinite(values)] if caption.startswith("true colour") else values[:0]
    if not known.size or not (white := float(np.percentile(known, 99))) > 0:
        return stretch(image)
    middle = float(np.clip(np.median(known) / white, 1e-3, 0.999))
    power = float(np.clip(np.log(MID_GREY) / np.log(middle), 0.45, 1.0))
    return np.where(np.isfinite(values), np.clip(values / white, 0, 1) ** power, np.float32(0.86))

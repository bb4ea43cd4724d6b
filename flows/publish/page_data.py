"""What a page carries with it instead of loading it: scripts, a library for maps, pictures, places and spectra.

Pictures of numbers go as PNG with a palette that a page can read again, photographs as JPEG, places as a lattice to
interpolate in, spectra as a byte for each band and coarse pixel, with the mean of each class. Where all values of
spectra would be too many, first neighbouring bands are taken together, then neighbouring pixels.
"""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image

from pipeline.ground.georeference import WGS84
from pipeline.ground.map_grid import MapFrame
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import pyproj
    from odc.geo.geobox import GeoBox
else:
    pyproj = deferred("pyproj")

LEAFLET = "vendor/leaflet-1.9.4"  # leafletjs.com, BSD-2-Clause: unchanged from npm's registry
SHA256 = {
    f"{LEAFLET}/leaflet.js": "db49d009c841f5ca34a888c96511ae936fd9f5533e90d8b2c4d57596f4e5641a",
    f"{LEAFLET}/leaflet.css": "a7837102824184820dfa198d1ebcd109ff6d0ff9a2672a074b9a1b4d147d04c6",
    f"{LEAFLET}/LICENSE": "53e8dc25862014e4324741ca18fbe3611e11d42ef69f59f86ea8c5389647d4cb",
}

Bytes = NDArray[np.uint8]
QUALITY = 84  # of photographs
Coordinates = NDArray[np.float64]
STEP_PX, MOST_STEPS = 32, 32  # between nodes; of a side
Floats = NDArray[np.float32]
MOST_VALUES = 2_600_000  # of a page: two megabytes of it, as measured on the farm
LEAST_BANDS = 30  # before pixels are taken together
NOTHING = 255  # where no line reached
LEVELS = 254
HALF = 0.5  # of a pixel of the spectra, from which it counts for a class


@cache
def part(name: str) -> str:
    """A file beside this module as it stands in a page: without what would point at files elsewhere."""
    text = files("flows.publish").joinpath(name).read_text(encoding="utf-8").replace("\r\n", "\n")
    elsewhere = "url(" if name.endswith(".css") else "//# sourceMappingURL="  # pictures that no page uses; a debugger's
    return "\n".join(line for line in text.split("\n") if elsewhere not in line)


def scripts(names: tuple[str, ...]) -> Markup:
    """Scripts in their order, as the tags that hold them."""
    return Markup("\n").join(Markup("<script>{}</script>").format(Markup(part(name))) for name in names)


def policy(names: tuple[str, ...]) -> str:
    """The content security policy of a page with these scripts: they alone run, and nothing is loaded from anywhere."""
    sources = [f"'sha256-{base64.b64encode(hashlib.sha256(part(name).encode()).digest()).decode()}'" for name in names]
    allowed = " ".join(sources) or "'none'"
    return (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}; "
        "base-uri 'none'; form-action 'none'"
    )


def indexed_png(numbers: Bytes, colours: Bytes) -> bytes:
    """PNG of (y, x) numbers, each drawn in its row of ``colours``, (number, 3 or 4) red green blue and opacity.

    A reader of the PNG gets the numbers themselves; those without a row are black.
    """
    picture = Image.fromarray(np.ascontiguousarray(numbers, np.uint8))
    table = np.zeros((256, 4), np.uint8)
    table[:, 3] = 255
    table[: len(colours), : colours.shape[1]] = colours
    picture.putpalette(table[:, :3].tobytes())
    opaque = bool((table[:, 3] == 255).all())
    return _saved(picture, **({} if opaque else {"transparency": table[:, 3].tobytes()}))


def grey_png(values: Bytes) -> bytes:
    """PNG of (y, x) bytes as they are."""
    return _saved(Image.fromarray(np.ascontiguousarray(values, np.uint8)))


def _saved(picture: Image.Image, **choices: bytes) -> bytes:
    file = io.BytesIO()
    picture.save(file, "PNG", **choices)
    return file.getvalue()


def jpeg(picture: Bytes) -> bytes:
    """JPEG of a (y, x, 3) photograph."""
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture, np.uint8)).save(file, "JPEG", quality=QUALITY)
    return file.getvalue()


def in_base64(content: bytes) -> str:
    """Bytes as a page holds them."""
    return base64.b64encode(content).decode("ascii")


@dataclass(frozen=True)
class PagePlaces:
    """Places of nodes that are spread evenly over a map, from its first pixel's outer corner to its last one's."""

    crs: str  # as people call it, such as EPSG:32632
    on_map: Coordinates  # (row, column, 2) x and y in that CRS, NaN where a pixel shows no ground
    lon_lat: Coordinates  # (row, column, 2) [deg] WGS 84


def places_of_pose(frame: MapFrame, shape: tuple[int, int]) -> PagePlaces:
    """The ground that a posed rig sees in a field of (y, x) px."""
    y, x = _nodes(shape)
    points = np.stack(np.meshgrid(y - shape[0] / 2, x - shape[1] / 2, indexing="ij"), axis=-1)
    ground = frame.view.scene_to_ground(points)
    return PagePlaces(_called(frame.crs), frame.ground_to_map(ground), frame.ground_to_geodetic(ground)[..., :2])


def places_of_grid(geobox: GeoBox) -> PagePlaces | None:
    """The pixels of a map that has a CRS; None where it has none."""
    if geobox.crs is None:
        return None
    shape: Any = tuple(geobox.shape)
    y, x = np.meshgrid(*_nodes(shape), indexing="ij")
    a, b, c, d, e, f = geobox.affine[:6]
    on_map = np.stack([a * x + b * y + c, d * x + e * y + f], axis=-1)
    crs = pyproj.CRS.from_wkt(geobox.crs.to_wkt())
    found = pyproj.Transformer.from_crs(crs, WGS84, always_xy=True).transform(on_map[..., 0], on_map[..., 1])
    lon_lat = np.stack(found, axis=-1)
    return PagePlaces(_called(crs), on_map, np.where(np.isfinite(lon_lat), lon_lat, np.nan))


def _nodes(shape: tuple[int, int]) -> tuple[Coordinates, Coordinates]:
    """Rows and columns of the nodes [px], 0 being the outer edge of the first pixel."""
    rows, columns = (np.linspace(0, size, int(np.clip(-(-size // STEP_PX), 1, MOST_STEPS)) + 1) for size in shape)
    return rows, columns


def _called(crs: Any) -> str:
    code = crs.to_authority()
    return ":".join(code) if code else str(crs.name)


@dataclass(frozen=True)
class PageSpectra:
    """Spectra of a field: byte b of band k is the value ``low[k] + b * step[k]``, `NOTHING` where there is none."""

    levels: NDArray[np.uint8]  # (y, x, band)
    low: Floats  # (band,)
    step: Floats  # (band,)
    wavelength_nm: NDArray[np.float64]  # (band,) ascending
    bands_each: int  # of the mosaic in one band
    pixel_px: int  # scene px a side of a pixel

    def values(self) -> Floats:
        """The values that it stands for, (y, x, band); NaN where there is none."""
        found: Floats = np.where(self.levels == NOTHING, np.nan, self.low + self.levels * self.step).astype(np.float32)
        return found


def page_spectra(
    rows: Iterable[Floats], shape: tuple[int, int, int], wavelength_nm: NDArray[np.floating], factor: int
) -> PageSpectra:
    """Take spectra of a mosaic, which comes as blocks of (row, x, band) from the top down.

    ``shape`` is the mosaic's (y, x, band), ``factor`` the scene px a side of its pixels. Means of bands are means over
    neighbours by wavelength, of those that have a value.
    """
    height, width, count = shape
    each = _bands_together(height * width, count)
    kept = -(-count // each)
    thin = _pixels_together(height, width, kept)
    order, starts = np.argsort(wavelength_nm, kind="stable"), np.arange(0, count, each)
    ascending = bool((order == np.arange(count)).all())
    blocks = [_band_means(block if ascending else block[..., order], starts) for block in rows]
    values = np.concatenate(blocks)
    if thin > 1:
        values = _pixel_means(values, thin)
    with np.errstate(invalid="ignore"):
        known = np.isfinite(values)
        low = np.where(known, values, np.inf).min(axis=(0, 1))
        high = np.where(known, values, -np.inf).max(axis=(0, 1))
    low, high = np.where(np.isfinite(low), low, 0), np.where(np.isfinite(high), high, 0)
    step = np.where(high > low, (high - low) / LEVELS, 1).astype(np.float32)
    levels = np.where(known, np.rint((np.where(known, values, low) - low) / step), NOTHING).astype(np.uint8)
    sizes = np.diff(np.append(starts, count))
    waves = np.add.reduceat(np.asarray(wavelength_nm, np.float64)[order], starts) / sizes
    return PageSpectra(levels, low.astype(np.float32), step, waves, each, factor * thin)


def class_means(spectra: PageSpectra, classes: NDArray[np.uint8], count: int) -> tuple[Floats, NDArray[np.intp]]:
    """Mean spectrum of each class over the pixels of which it covers half or more, and how many these are.

    ``classes`` is the (y, x) class map on scene px. Gives (class, band), NaN without such a pixel, and (class,).
    """
    side, (height, width, bands) = spectra.pixel_px, spectra.levels.shape
    down = np.minimum(np.arange(classes.shape[0]) // side, height - 1)
    across = np.minimum(np.arange(classes.shape[1]) // side, width - 1)
    place = (down[:, None] * width + across[None, :]) * (count + 1) + np.minimum(classes, count)
    share = np.bincount(place.ravel(), minlength=height * width * (count + 1)).reshape(-1, count + 1)
    covered = share[:, :count] >= HALF * np.maximum(share.sum(axis=1, keepdims=True), 1)
    values = spectra.values().reshape(-1, bands)
    means = np.full((count, bands), np.nan, np.float32)
    sizes = np.zeros(count, np.intp)
    for number in range(count):
        mine = values[covered[:, number]]
        mine = mine[np.isfinite(mine).any(axis=1)]
        sizes[number] = len(mine)
        known = np.isfinite(mine)
        total = np.where(known, mine, 0).sum(axis=0, dtype=np.float64)
        means[number] = np.divide(total, known.sum(axis=0), out=np.full(bands, np.nan), where=known.any(axis=0))
    return means, sizes


def _bands_together(pixels: int, bands: int) -> int:
    each = -(-pixels * bands // MOST_VALUES)
    return max(1, min(each, bands // LEAST_BANDS))


def _pixels_together(height: int, width: int, bands: int) -> int:
    thin = 1
    while -(-height // thin) * -(-width // thin) * bands > MOST_VALUES and thin < max(height, width):
        thin += 1
    return thin


def _band_means(block: Floats, starts: NDArray[np.intp]) -> Floats:
    """Means over runs of bands that begin at ``starts``, of the values that are there."""
    if len(starts) == block.shape[-1]:
        return block
    known = np.isfinite(block)
    total = np.add.reduceat(block if known.all() else np.where(known, block, 0), starts, axis=-1)
    there = np.add.reduceat(known, starts, axis=-1, dtype=np.int32)
    means: Floats = np.divide(total, there, out=np.full(total.shape, np.nan, np.float32), where=there > 0)
    return means


def _pixel_means(values: Floats, thin: int) -> Floats:
    """Means over squares of ``thin`` pixels a side, cut off at the right and below, of the values that are there."""
    known = np.isfinite(values)
    total = np.where(known, values, 0)
    there = known.astype(np.int32)
    for axis in (0, 1):
        starts = np.arange(0, values.shape[axis], thin)
        total, there = np.add.reduceat(total, starts, axis=axis), np.add.reduceat(there, starts, axis=axis)
    means: Floats = np.divide(total, there, out=np.full(total.shape, np.nan, np.float32), where=there > 0)
    return means

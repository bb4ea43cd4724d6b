"""The built-in farm: parcels, rows, tracks, ditches, hedges and weeds from one seed, as mixtures of known spectra.

Law ``farm@1``. One pixel is about 12 cm of a trial farm; sizes are in px. U(a, b) is uniform, LN(s) log-normal of
sigma s about 1. Every part draws from its own stream of the seed. What is drawn, in order:

* Land: a rectangle 80 px larger than the scene (and at least 640 x 640) is split along two directions (turned by
  U(-0.6, 0.6) rad, each cut up to 0.12 rad off) at 0.36-0.64 of its length, until a parcel has less than
  95 000 U(1.15, 1.9) px.
* Use: ``PARCEL_SHARES`` blurred by LN(0.25), the largest parcel to the use that lacks most, each use at least once
  where there are enough parcels.
* Fields: rows, headlands, tramlines and bare spots as in ``farm_fields``; crops mix a dense and a sparse stand by a
  vigour field 55 px wide, soil mixes dry and wet by a moisture field. Young fields have rows with open soil between.
  ``wheat_b`` is ``wheat_a`` but for 690-740 nm, and 0.80 of a pixel's wheat (sd 0.17 from pixel to pixel, 0.05 over
  55 px) has its own variety's red edge, the rest the other's.
* Weeds: discs of radius U(0.9, 2.4) in patches (where noise 30 px wide is above 1.3 sd) of maize, beet and, fewer,
  other parcels; single volunteer plants of radius U(1.0, 2.0), one in 6000 px. Both are the class weed.
* Lines between parcels: ``BORDER_SHARES`` by length, blurred likewise. Roads of 6-10 px of gravel, half of them with a
  grass strip in the middle; ditches of 2.6-4 px of water between banks; hedges of crowns of radius U(4, 7) px;
  margins of 4-9 px of grass. A pond of radius U(14, 24) px, and one more for every 650 000 px.
* Trees: crowns of radius U(5, 12) px beside the lines, one in 320 px of line. Trees and hedges throw shadows to the
  north; the sun stands 30 degrees from the zenith, in the south.
* Light: 0.95 with sd 0.03 (260 px wide), at most 1. What is missing from full light is the material shade, so that
  abundances stay non-negative and sum to 1.

A pixel's label is the class that covers most of it. Edges are mixed by the share of the pixel that they cover.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera
from pipeline.lazy import Once
from pipeline.simulator.farm_fields import CLASSES, SOWINGS, Canvas, Ground, Mixture, grass, hard_track, paint_parcel
from pipeline.simulator.farm_laws import FARM_LAW
from pipeline.simulator.farm_layout import (
    Band,
    Border,
    Field,
    Parcel,
    Points,
    allot,
    band_pixels,
    disc_pixels,
    divide_land,
    edge,
    parcel_pixels,
    smooth_noise,
    stream,
    visible_area,
)
from pipeline.simulator.raster import Light, Raster
from pipeline.simulator.scene import RasterScene
from pipeline.simulator.spectra import MATERIALS, PANEL_REFLECTANCE, band_centres, spectral_library

PARCEL_AREA_PX = 95_000.0
PARCEL_SHARES: dict[str, float] = {
    "maize": 0.16, "sugar_beet": 0.15, "wheat_a": 0.15, "wheat_b": 0.15, "stubble": 0.09, "grass": 0.08, "soil": 0.11,
    "young_maize": 0.045, "young_beet": 0.045,
}  # fmt: skip
BORDER_SHARES: dict[str, float] = {"road": 0.20, "ditch": 0.38, "hedge": 0.17, "margin": 0.25}
CLASS_COLOURS = np.array(
    [
        (158, 119, 82), (240, 200, 40), (196, 60, 130), (60, 140, 60), (130, 200, 90), (235, 220, 165), (165, 215, 190),
        (220, 30, 30), (120, 120, 120), (40, 110, 220), (15, 75, 45),
    ],
    np.uint8,
)  # fmt: skip


def farm_scene(
    seed: int, shape: tuple[int, int] = (1024, 1280), bands: int = 270, camera: LineCamera | None = None
) -> RasterScene:
    """Give a farm: the same seed, shape and bands give the same scene, bit for bit. It is drawn when first looked at.

    Parameters
    ----------
    seed
        Not negative.
    shape
        (y, x), any size from 1 x 1. The land is drawn for the size: a larger scene is another farm. [px]
    bands
        Equally spaced from 400 to 1000 nm, at least 2.
    camera
        Its full well sets the electrons; ``LineCamera()`` unless given.

    Returns
    -------
    Planes are abundances of ``spectra.MATERIALS``; scene values are reflectance; every pixel is labelled.

    Raises
    ------
    SceneError : a negative seed or an empty shape.
    WavelengthError : fewer than 2 bands.
    """
    if seed < 0 or min(shape) < 1:
        raise SceneError(f"the farm needs a seed >= 0 and a shape of at least 1 x 1 px, got seed {seed}, shape {shape}")
    seen_by = camera or LineCamera()
    wavelength, fwhm = band_centres(bands)
    return RasterScene(
        name="farm",
        key=f"{FARM_LAW}/seed={seed}/shape={shape[0]}x{shape[1]}/bands={bands}/full_well={seen_by.full_well_e:g}",
        raster=Raster((*shape, len(MATERIALS)), labelled=True, draw=lambda: _draw(seed, shape)),
        light=Once(lambda: _light(bands, seen_by)),
        panel=np.full(bands, PANEL_REFLECTANCE, np.float32),
        wavelength_nm=wavelength,
        fwhm_nm=fwhm,
        class_names=CLASSES,
        class_colours=CLASS_COLOURS.copy(),
    )


def _light(bands: int, camera: LineCamera) -> Light:
    """What the camera makes of each material and of the white panel."""
    library = spectral_library(bands)
    return Light(library.electrons(camera), library.panel_electrons(camera))


def _draw(seed: int, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Abundances (y, x, material) and labels (y, x)."""
    ground = Ground.draw(stream(seed, "ground"), shape)
    size = (max(shape[0] + 80, 640), max(shape[1] + 80, 640))
    parcels, borders = divide_land(stream(seed, "land"), size, PARCEL_AREA_PX)
    uses = allot(stream(seed, "use"), [visible_area(parcel, shape) for parcel in parcels], PARCEL_SHARES)
    canvas = Canvas(shape)
    for number, (parcel, use) in enumerate(zip(parcels, uses, strict=True)):
        paint_parcel(stream(seed, f"parcel {number}"), canvas, ground, parcel, use)
    _plant_weeds(stream(seed, "weeds"), canvas, _weed_rate(parcels, uses, shape))
    crowns = _paint_borders(stream(seed, "borders"), canvas, ground, borders)
    _dig_ponds(stream(seed, "ponds"), canvas, ground, parcels, uses)
    _plant_trees(canvas, ground, crowns)
    canvas.dim(ground.light)
    labels, materials = canvas.classes.argmax(axis=0).astype(np.uint8).reshape(shape), canvas.materials
    del canvas, ground  # the planes are as large as all of them
    planes = np.ascontiguousarray(materials.T)
    planes /= planes.sum(axis=1, keepdims=True)
    return planes.reshape(*shape, -1), labels


def _weed_rate(parcels: list[Parcel], uses: list[str], shape: tuple[int, int]) -> Field:
    """Weeds per px where they are thickest, by the use of the land, (pixel,)."""
    rate = np.zeros(shape[0] * shape[1], np.float32)
    for parcel, use in zip(parcels, uses, strict=True):
        index, cover, _ = parcel_pixels(parcel, shape)
        rate[index[cover > 0.5]] = SOWINGS[use].weeds if use in SOWINGS else 0.01
    return rate


def _plant_weeds(rng: np.random.Generator, canvas: Canvas, rate: Field) -> None:
    """Weeds in patches and single volunteers; a plant is a disc of one species."""
    shape = canvas.shape
    patch = smooth_noise(rng, shape, 30).ravel()
    thickest = 0.14
    count = rng.poisson(thickest * rate.size)
    place = rng.integers(0, rate.size, count)
    kept = place[rng.uniform(size=count) * thickest < rate[place] * np.clip((patch[place] - 1.3) / 0.5, 0, 1)]
    single = rng.integers(0, rate.size, rng.poisson(rate.size / 6000))
    species = rng.choice(["weed_leafy", "weed_red", "blossom"], len(kept), p=[0.55, 0.3, 0.15])
    groups = [(name, kept[species == name], 0.9, 2.4) for name in ("weed_leafy", "weed_red", "blossom")]
    for name, where, least, most in [*groups, ("volunteer", single, 1.0, 2.0)]:
        centres = scene_points(where, shape) + rng.uniform(-0.5, 0.5, (len(where), 2))
        index, cover, _ = union_of_discs(*disc_pixels(centres, rng.uniform(least, most, len(where)), shape)[:3])
        canvas.over(index, 0.92 * cover, {name: np.ones_like(cover)}, "weed")


def scene_points(index: NDArray[np.intp], shape: tuple[int, int]) -> Points:
    """Scene coordinates of flat pixel numbers, (n, 2)."""
    return np.stack(np.divmod(index, shape[1]), axis=-1) - (np.array(shape) - 1) / 2


def union_of_discs(index: NDArray[np.intp], cover: Field, height: Field) -> tuple[NDArray[np.intp], Field, Field]:
    """Join discs: each pixel once, with its largest coverage and the height that belongs to it."""
    order = np.lexsort((cover, index))
    last = np.flatnonzero(np.diff(index[order], append=-1))
    return index[order][last], cover[order][last], height[order][last]


def _paint_borders(rng: np.random.Generator, canvas: Canvas, ground: Ground, borders: list[Border]) -> Points:
    """Draw the lines between parcels, roads last; gives the centres of hedge crowns with their radii, (n, 3)."""
    kinds = allot(rng, [border.length for border in borders], BORDER_SHARES)
    crowns = [standing_trees(rng, borders)]
    for kind in ("margin", "hedge", "ditch", "road"):
        for border in (b for b, k in zip(borders, kinds, strict=True) if k == kind):
            band = wobble(rng, band_pixels(border, 12.0, canvas.shape), 0.8 if kind == "road" else 1.6)
            _paint_line(rng, canvas, ground, band, kind)
            if kind == "hedge":
                crowns.append(hedge_crowns(rng, border))
    return np.concatenate(crowns)


def wobble(rng: np.random.Generator, band: Band, size: float) -> Band:
    """Bend a line a little: two sines of random phase, 37 and 61 px per radian."""
    phases = rng.uniform(0, 2 * np.pi, 2)
    bend = np.sin(band.along / 37 + phases[0]) + np.sin(band.along / 61 + phases[1])
    return Band(band.index, band.across + np.float32(size / 2) * bend.astype(np.float32), band.along)


def _paint_line(rng: np.random.Generator, canvas: Canvas, ground: Ground, band: Band, kind: str) -> None:
    """Grass on both sides, and what the kind has in the middle."""
    here = ground.at(band.index)
    widths = {"margin": (2.0, 4.5), "hedge": (4.5, 6.5), "ditch": (1.3, 2.0), "road": (3.0, 5.0)}
    half = rng.uniform(*widths[kind])
    bank = {"margin": 0.0, "hedge": 0.0, "ditch": rng.uniform(2.5, 4.5), "road": rng.uniform(1.0, 2.5)}[kind]
    _cover(canvas, band, half + bank, grass(here, rng.uniform(0.25, 0.6)), "grass")
    if kind == "ditch":
        _cover(canvas, band, half, {"water": np.ones_like(band.across)}, "water")
    if kind == "road":
        _cover(canvas, band, half, hard_track(here, 0.75), "track")
        if rng.uniform() < 0.5:
            _cover(canvas, band, rng.uniform(0.8, 1.2), grass(here, 0.5), "grass")


def _cover(canvas: Canvas, band: Band, half: float, mixture: Mixture, label: str) -> None:
    """Lay a surface over the pixels within ``half`` of the line."""
    cover = edge(half - np.abs(band.across))
    hit = np.flatnonzero(cover)
    canvas.over(band.index[hit], cover[hit], {name: part[hit] for name, part in mixture.items()}, label)


def hedge_crowns(rng: np.random.Generator, border: Border) -> Points:
    """Crowns along a line: y, x and radius, (n, 3); every twentieth is missing."""
    along = np.arange(0.0, border.length, 5.0)
    along = along[rng.uniform(size=along.size) > 0.05]
    step = (border.end - border.start) / max(border.length, 1e-9)
    centres = border.start + along[:, None] * step + rng.normal(0, 1.0, (along.size, 2))
    return np.column_stack([centres, rng.uniform(4, 7, along.size)])


def standing_trees(rng: np.random.Generator, borders: list[Border]) -> Points:
    """Single trees beside the lines, one in 320 px: y, x and radius, (n, 3)."""
    trees = [np.zeros((0, 3))]
    for border in borders:
        count = rng.poisson(border.length / 320)
        step = (border.end - border.start) / max(border.length, 1e-9)
        aside = rng.choice([-1.0, 1.0], (count, 1)) * rng.uniform(7, 14, (count, 1)) * np.array([-step[1], step[0]])
        places = border.start + rng.uniform(0, border.length, (count, 1)) * step + aside
        trees.append(np.column_stack([places, rng.uniform(5, 12, count)]))
    return np.concatenate(trees)


def _dig_ponds(
    rng: np.random.Generator, canvas: Canvas, ground: Ground, parcels: list[Parcel], uses: list[str]
) -> None:
    """Ponds with grass round them, in meadows where there are any."""
    shape = canvas.shape
    shore = smooth_noise(rng, shape, 14).ravel()
    meadows = [parcel for parcel, use in zip(parcels, uses, strict=True) if use == "grass"] or parcels
    ponds = []
    for _ in range(1 + shape[0] * shape[1] // 650_000):
        corners = meadows[rng.integers(len(meadows))].corners
        centre = corners.mean(axis=0) + 0.5 * (corners[rng.integers(len(corners))] - corners.mean(axis=0))
        index = disc_pixels(centre[None], np.array([34.0]), shape)[0]
        distance = np.hypot(*(scene_points(index, shape) - centre).T)
        inside = rng.uniform(14, 24) + 1.8 * shore[index] - distance
        canvas.over(index, edge(inside + 4), grass(ground.at(index), 0.15), "grass")
        ponds.append((index, edge(inside)))
    for index, cover in ponds:  # after every bank: two ponds may meet
        canvas.over(index, cover, {"water": np.ones_like(cover)}, "water")


def _plant_trees(canvas: Canvas, ground: Ground, crowns: Points) -> None:
    """Crowns, lit from the south, and their shadows to the north."""
    shape = canvas.shape
    centres, radius = crowns[:, :2], crowns[:, 2]
    shadow, cover, _ = union_of_discs(*disc_pixels(centres - radius[:, None] * [0.8, 0.0], radius, shape)[:3])
    canvas.over(shadow, 0.5 * cover, {"shade": np.ones_like(cover)}, None)
    index, cover, height = union_of_discs(*disc_pixels(centres, radius, shape)[:3])
    here = ground.at(index)
    shade = np.clip(0.16 - 0.16 * height + 0.07 * here.tuft + 0.04 * here.grain, 0, 0.6)
    canvas.over(index, cover, {"tree": 1 - shade, "shade": shade}, "tree")

"""Scenes: what the simulated rig looks at, as a few component planes and the electrons that each gives per band.

One is made of any image: without a radiance law it is relative, linear light of as many electrons as a camera tells.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from tempfile import TemporaryFile
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import SceneError, ShapeError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import UNLABELLED, cuts
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.readings import MOST_VALUE, find_beyond

Drawn = tuple[NDArray[np.float32], NDArray[np.uint8] | None]
_BINOMIAL = (np.array([1, 8, 28, 56, 70, 56, 28, 8, 1]) / 256).astype(np.float32)
MOST_BYTES = 2**28  # of an array in memory; larger ones are in a file
_ROWS_AT_ONCE = 4  # of what is halved: they stay in the processor's cache
THINNED_MARGIN = 4  # pixels of a level beside the scene: as far as the binomial kernel reaches
DEFAULT_EXPOSURE_MS = 100.0  # the exposure at which a scene's electrons are stated
WELL_FRACTION = 0.6  # of the full well, filled by the bright end of a scene without a radiance law
BRIGHT_PERCENTILE = 99.9
LEAST_BRIGHT = 1e-30  # electrons per unit of less would end the range of float32
_DIMMED = "/light="  # before the fraction of the light, in the key of a scene in less than full light


class SceneRaster:
    """Planes (y, x, component) float32 and labels (y, x) uint8 of a scene, drawn when they are first asked for.

    Their shape is known before. Raises SceneError for an empty one.
    """

    def __init__(self, shape: tuple[int, ...], *, labelled: bool, draw: Callable[[], Drawn]) -> None:
        if len(shape) != 3 or 0 in shape:
            raise SceneError(f"a scene must be (y, x, component) and not empty, got {shape}")
        self.shape = (shape[0], shape[1], shape[2])
        self.labelled = labelled
        self._drawn = Once(lambda: self._checked(*draw()))
        self._thinned: dict[int, Once[NDArray[np.float32]]] = {}
        self._lock = Lock()

    @staticmethod
    def of(planes: NDArray[np.float32], labels: NDArray[np.uint8] | None = None) -> SceneRaster:
        """Hold arrays that are there already; SceneError where they do not fit each other."""
        raster = SceneRaster(planes.shape, labelled=labels is not None, draw=lambda: (planes, labels))
        raster.drawn()
        return raster

    def drawn(self) -> Drawn:
        """Return planes and labels (None without any); SceneError where what is drawn is not what was announced."""
        return self._drawn()

    def thinned(self, level: int) -> NDArray[np.float32]:
        """Return the planes blurred, and every ``level``-th pixel of them: 1, 2, 4, 8, ...

        Beyond 1 the scene's first pixel comes after `THINNED_MARGIN` others, and as many follow. There all is edge, so
        that repeating the outermost pixel equals repeating the scene's edge. From each level to the next every second
        pixel is left, after the binomial kernel of nine taps (variance 2, Burt, Adelson, 1983). It passes less than 2 %
        of waves from 0.3 cycles per px on, which fewer pixels would alias. Light is kept.
        """
        if level == 1:
            return self.drawn()[0]
        with self._lock:
            before = 0 if level == 2 else THINNED_MARGIN
            once = self._thinned.setdefault(level, Once(lambda: _halved(self.thinned(level // 2), before)))
        return once()

    def _checked(self, planes: NDArray[np.float32], labels: NDArray[np.uint8] | None) -> Drawn:
        size = None if labels is None else labels.shape
        if planes.shape != self.shape or size != (self.shape[:2] if self.labelled else None):
            raise SceneError(f"the scene is {self.shape} px, its planes {planes.shape}, its labels {size}; crop or pad")
        return planes, labels


def scratch(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return an array of zeros; a large one is in a file without a name, which the system reads and writes by pages.

    Raises OSError: the disk is full. The folder is that of TMPDIR, by default /var/tmp, since /tmp may be memory.
    """
    if 4 * np.prod(shape) <= MOST_BYTES:
        return np.zeros(shape, np.float32)
    with TemporaryFile(dir=os.environ.get("TMPDIR", "/var/tmp")) as file:
        if hasattr(os, "posix_fallocate"):  # not on macOS; a full disk would end the process later
            os.posix_fallocate(file.fileno(), 0, 4 * int(np.prod(shape)))
        return np.asarray(np.memmap(file, np.float32, "r+", shape=shape))


def _halved(planes: NDArray[np.float32], before: int) -> NDArray[np.float32]:
    """Return every second pixel of blurred planes along either axis, from the one that ``before`` others precede."""
    half = len(_BINOMIAL) // 2
    counts = [-(-(size - 1 + half - before) // 2) + THINNED_MARGIN + 1 for size in planes.shape[:2]]
    rows, columns = (before + 2 * (np.arange(count) - THINNED_MARGIN) - half for count in counts)
    out = scratch((*counts, planes.shape[2]))
    for some in cuts(counts[0], _ROWS_AT_ONCE):
        out[some] = _binomial(_binomial(planes, rows[some], 0), columns, 1)
    return out


def _binomial(planes: NDArray[np.float32], firsts: NDArray[np.intp], axis: int) -> NDArray[np.float32]:
    """Return sums of nine pixels along an axis, from each of ``firsts`` on; the planes' edge is repeated."""
    total: NDArray[np.float32] = planes.take(firsts, axis=axis, mode="clip") * _BINOMIAL[0]
    for offset, weight in enumerate(_BINOMIAL[1:], 1):
        some = planes.take(firsts + offset, axis=axis, mode="clip")
        some *= weight
        total += some
    return total


@dataclass(frozen=True)
class SceneRadiance:
    """Electrons at the default exposure: (component, band) per unit, and (band,) of the white reference."""

    electrons: NDArray[np.float32]
    white_reference_electrons: NDArray[np.float32]


@dataclass(frozen=True)
class RasterScene:
    """A scene of pixels; between their centres light is linear, and outside the edge pixel is repeated.

    No light is below 0, and none is lost or gained. It is the sharpest such interpolation whose slope has no jump
    behind a pixel or a slit. Slopes and curvatures bound what is left out. A wave of f cycles per px keeps sinc^2 f,
    0.81 at a quarter, of what the pixels have of it. Planes, labels and electrons may be made when they are first asked
    for; all else is known at once.
    """

    name: str
    key: str  # equal keys give equal light
    raster: SceneRaster
    light: Once[SceneRadiance]
    white_reference: NDArray[np.float32]  # (band,) scene value of the white reference
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None = None  # (band,) widths; None where not known
    class_names: tuple[str, ...] = ()
    class_colours: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    class_values: tuple[int, ...] = ()  # number of each class in maps, 0 to 254; empty: 0, 1, 2, ...
    zero_class: str = ""  # class of the number 0, or of black, in the label file; empty if it is none
    filled_px: int = 0  # pixels that came without a value in a band
    missing: NDArray[np.bool_] | None = None  # (y, x) pixels without a value in most bands; None: no such pixel
    geobox: GeoBox | None = None  # place of the pixels on the earth; None where the scene's file has none
    pixel_m: float | None = None  # size of a pixel on the ground of a scene without a place, where its law states it
    acquired: str | None = None  # when the light of its file was captured: a day or a moment in UTC, ISO 8601
    regridded: bool = False  # the labels came on another grid and were brought to the scene's
    content: tuple[str, ...] = ()  # hashes of the files that it was read from, whatever bands of them are taken
    light_fraction: float = 1.0  # over a clear sky's light; electrons have it in them, scene values do not

    def __post_init__(self) -> None:
        if self.light.is_made():
            self._checked_light()

    def _checked_light(self) -> SceneRadiance:
        light = self.light()
        bands, components = len(self.wavelength_nm), self.raster.shape[2]
        if light.electrons.shape not in {(components, bands), *([(bands,)] if bands == components else [])}:
            raise ShapeError(
                f"scene {self.name}: electrons {light.electrons.shape} do not map {components} components "
                f"to {bands} bands"
            )
        return light

    @property
    def shape(self) -> tuple[int, int]:
        """Return the size (y, x) [px]."""
        return self.raster.shape[:2]

    def in_light(self, fraction: float) -> RasterScene:
        """Return the same scene in a fraction of its light: scene and white reference give less electrons alike."""
        if fraction == 1:
            return self

        def light() -> SceneRadiance:
            less = np.float32(fraction)
            return SceneRadiance(self.electrons * less, self.white_reference_electrons * less)

        whole = self.light_fraction * fraction
        return replace(self, key=f"{self.clear_key}{_DIMMED}{whole:g}", light=Once(light), light_fraction=whole)

    @property
    def clear_key(self) -> str:
        """Return the key of the same scene under a clear sky."""
        return self.key.partition(_DIMMED)[0]

    @property
    def electrons(self) -> NDArray[np.float32]:
        """Return electrons at the default exposure per unit of component, (component, band); (band,) is a diagonal."""
        return self._checked_light().electrons

    @property
    def white_reference_electrons(self) -> NDArray[np.float32]:
        """Return the electrons that the white reference gives at the default exposure."""
        return self._checked_light().white_reference_electrons

    @property
    def planes(self) -> NDArray[np.float32]:
        """Return the amount of each component in each pixel, (y, x, component)."""
        return self.raster.drawn()[0]

    @property
    def labelled(self) -> bool:
        """Return whether there are labels; draws nothing."""
        return self.raster.labelled

    @property
    def labels(self) -> NDArray[np.uint8] | None:
        """Return the classes (y, x), 255 for unlabelled; None without any."""
        return self.raster.drawn()[1] if self.labelled else None

    def spectra(self) -> NDArray[np.float32]:
        """Return scene value per unit of component, shaped as ``electrons``."""
        return self.electrons * (self.white_reference / self.white_reference_electrons).astype(np.float32)

    def values(self) -> NDArray[np.float32]:
        """Return the scene values of all pixels, (y, x, band) float32, as a perfect survey returns them."""
        return to_bands(self.planes, self.spectra())


def to_bands(components: NDArray[np.float32], spectra: NDArray[np.float32]) -> NDArray[np.float32]:
    """Multiply (..., component) by (component, band), or by the diagonal (band,); gives (..., band) float32."""
    return components * spectra if spectra.ndim == 1 else components @ spectra


def raster_from_values(
    values: NDArray[np.generic],
    camera: LineCamera,
    *,
    name: str,
    wavelength_nm: NDArray[np.float64],
    fwhm_nm: NDArray[np.float64] | None = None,
    labels: NDArray[np.uint8] | None = None,
    class_names: tuple[str, ...] = (),
    class_colours: NDArray[np.uint8] | None = None,
    key: str | None = None,
    geobox: GeoBox | None = None,
) -> RasterScene:
    """Turn an image (y, x, band) without a radiance law into a scene of relative, linear light.

    The 99.9th percentile of the finite values fills 60 % of the full well at the default exposure. A scene without
    positive light takes 1 in its place. Values that are not finite get the band's median, and ``filled_px`` counts
    their pixels. A pixel without finite values in more than half of the bands is ``missing`` and loses its label.
    Negative values give no electrons. ``key``: identity of the content, by default the hash of the values.
    Raises SceneError: not three axes, empty, no finite value, one that is no reading (`pipeline.readings`), or labels
    that do not fit.
    """
    if values.ndim != 3 or 0 in values.shape:
        raise SceneError(f"scene {name} must be (y, x, band) and not empty, got {values.shape}")
    if labels is not None and labels.shape != values.shape[:2]:
        raise SceneError(f"scene {name} is {values.shape[:2]} px, its labels {labels.shape}; crop or pad one")
    if (found := find_beyond(values)) is not None:
        raise SceneError(
            f"scene {name} has {found.text()}, beyond the {MOST_VALUE:g} that readings reach; put NaN where there is"
            " no data, or give the values in a larger unit"
        )
    planes = np.ascontiguousarray(values, dtype=np.float32)
    bright = _bright_value(planes, name)
    planes, filled, missing = _fill_by_median(planes)
    if missing is not None and labels is not None:
        labels = np.where(missing, np.uint8(UNLABELLED), labels)
    bands = planes.shape[2]
    electrons = np.full(bands, WELL_FRACTION * camera.full_scale_e / bright, np.float32)
    return RasterScene(
        name=name,
        key=key or content_key(planes),
        raster=SceneRaster.of(planes, labels),
        light=Once.of(SceneRadiance(electrons, np.full(bands, camera.full_scale_e, np.float32))),
        white_reference=np.full(bands, bright / WELL_FRACTION, np.float32),
        wavelength_nm=np.asarray(wavelength_nm, np.float64),
        fwhm_nm=fwhm_nm,
        class_names=class_names,
        class_colours=np.zeros((0, 3), np.uint8) if class_colours is None else class_colours,
        filled_px=filled,
        missing=missing,
        geobox=geobox,
    )


def content_key(planes: NDArray[np.float32]) -> str:
    """Hash of an array's shape and bytes, 32 hexadecimal digits."""
    digest = hashlib.blake2b(repr((planes.shape, planes.dtype.str)).encode(), digest_size=16)
    digest.update(np.ascontiguousarray(planes).data)
    return digest.hexdigest()


def _bright_value(planes: NDArray[np.float32], name: str) -> float:
    """Return bright end of the finite values; 1 where there is no positive light.

    Read on every n-th pixel of scenes above 2^24 values: the rank of so many is known to 1e-5.
    """
    pixels = planes.reshape(-1, planes.shape[2])[:: max(1, planes.size >> 24)]
    finite = pixels[np.isfinite(pixels)]
    if not finite.size:
        raise SceneError(f"scene {name} holds no finite value; check its fill value and its bands")
    bright = float(np.percentile(finite, BRIGHT_PERCENTILE))
    if 0 < bright < LEAST_BRIGHT:
        raise SceneError(
            f"the brightest values of scene {name} are {bright:.3g}, too small for float32; give them in a smaller unit"
        )
    return bright if bright > 0 else 1.0


def _fill_by_median(planes: NDArray[np.float32]) -> tuple[NDArray[np.float32], int, NDArray[np.bool_] | None]:
    """Replace what is not finite by the band's median (0 in a band without any), and count such pixels.

    Returned third are the pixels (y, x) with no finite value in more than half of their bands; None without any.
    """
    unknown = ~np.isfinite(planes)
    if not unknown.any():
        return planes, 0, None
    filled = planes.copy()
    for band in np.flatnonzero(unknown.any(axis=(0, 1))):
        gaps = unknown[..., band]
        known = planes[..., band][~gaps]
        filled[..., band][gaps] = np.median(known) if known.size else 0.0
    missing = 2 * unknown.sum(axis=2) > planes.shape[2]
    return filled, int(unknown.any(axis=2).sum()), missing if missing.any() else None

"""Scenes from images without a radiance law: relative, linear light of as many electrons as a camera can tell."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import UNLABELLED
from pipeline.lazy import Once
from pipeline.readings import MOST_VALUE, find_beyond
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, SceneRaster

WELL_SHARE = 0.6  # of the full well, filled by the bright end of a scene without a radiance law
BRIGHT_PERCENTILE = 99.9
LEAST_BRIGHT = 1e-30  # electrons per unit of less would end the range of float32


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
) -> RasterScene:
    """Turn an image (y, x, band) without a radiance law into a scene of relative, linear light.

    The 99.9th percentile of the finite values fills 60 % of the full well at the default exposure; a scene without
    positive light takes 1 in its place. Values that are not finite get the band's median, their pixels are counted in
    ``filled_px``; where that is so in more than half of the bands, the pixel is ``missing`` and loses its label.
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
            f"scene {name} has {found.words()}, beyond the {MOST_VALUE:g} that readings reach; put NaN where there is"
            " no data, or give the values in a larger unit"
        )
    planes = np.ascontiguousarray(values, dtype=np.float32)
    bright = _bright_value(planes, name)
    missing = _missing_pixels(planes)
    if missing is not None and labels is not None:
        labels = np.where(missing, np.uint8(UNLABELLED), labels)
    planes, filled = _fill_by_median(planes)
    bands = planes.shape[2]
    return RasterScene(
        name=name,
        key=key or content_key(planes),
        raster=SceneRaster.of(planes, labels),
        light=Once.of(
            SceneLight(
                np.full(bands, WELL_SHARE * camera.full_well_e / bright, np.float32),
                np.full(bands, camera.full_well_e, np.float32),
            )
        ),
        panel=np.full(bands, bright / WELL_SHARE, np.float32),
        wavelength_nm=np.asarray(wavelength_nm, np.float64),
        fwhm_nm=fwhm_nm,
        class_names=class_names,
        class_colours=np.zeros((0, 3), np.uint8) if class_colours is None else class_colours,
        filled_px=filled,
        missing=missing,
    )


def _missing_pixels(planes: NDArray[np.float32]) -> NDArray[np.bool_] | None:
    """(y, x) pixels with no finite value in more than half of their bands; None without any."""
    known = np.isfinite(planes)
    if known.all():
        return None
    missing: NDArray[np.bool_] = 2 * known.sum(axis=2) < planes.shape[2]
    return missing if missing.any() else None


def content_key(planes: NDArray[np.float32]) -> str:
    """Hash of an array's shape and bytes, 32 hexadecimal digits."""
    digest = hashlib.blake2b(repr((planes.shape, planes.dtype.str)).encode(), digest_size=16)
    digest.update(np.ascontiguousarray(planes).data)
    return digest.hexdigest()


def _bright_value(planes: NDArray[np.float32], name: str) -> float:
    """Bright end of the finite values; 1 where there is no positive light.

    Read on every n-th pixel of scenes above 2^24 values: the rank of so many is known to 1e-5.
    """
    pixels = planes.reshape(-1, planes.shape[2])[:: max(1, planes.size >> 24)]
    finite = pixels[np.isfinite(pixels)]
    if not finite.size:
        raise SceneError(f"scene {name} holds no finite value; check its fill value and its bands")
    bright = float(np.percentile(finite, BRIGHT_PERCENTILE))
    if 0 < bright < LEAST_BRIGHT:
        raise SceneError(
            f"the brightest values of scene {name} are {bright:.3g}, too small to be told from nothing; give them in a"
            " smaller unit"
        )
    return bright if bright > 0 else 1.0


def _fill_by_median(planes: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """Replace what is not finite by the band's median (0 in a band without any), and count such pixels."""
    missing = ~np.isfinite(planes)
    if not missing.any():
        return planes, 0
    filled = planes.copy()
    for band in np.flatnonzero(missing.any(axis=(0, 1))):
        gaps = missing[..., band]
        known = planes[..., band][~gaps]
        filled[..., band][gaps] = np.median(known) if known.size else 0.0
    return filled, int(missing.any(axis=2).sum())

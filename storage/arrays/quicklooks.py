"""Store a small picture beside every cube, so that it can be shown without reading the cube.

::

    <cube>.zarr/quicklook     (y, x, 3) uint8: every 4th line and sample, three bands, 2-98 % of each; 0 where missing

The picture is made while lines are written. Its attributes have the bands, the step between pixels, and the values of
0 and 255. True colours have one scale for all bands, false colours one for each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import NDArray

from storage.arrays.layout import read_array, write_image

ARRAY = "quicklook"
DIMS = ("quicklook_y", "quicklook_x", "rgb")
STEP, LEAST_PX, MOST_PX = 4, 128, 1024  # of the longer side; small cubes are thinned less
RGB_NM = (640.0, 550.0, 460.0)
FAR_NM = 60.0
MID_GREY = 0.42  # of the median of a picture

Kind = Literal["true colour", "false colour", "grey", "by number"]


def picture_bands(wavelength_nm: NDArray[np.floating] | None, count: int) -> tuple[tuple[int, int, int], Kind]:
    """Return the bands to show as red, green and blue: those nearest to 640, 550 and 460 nm, if within 60 nm.

    Otherwise the longest, middle and shortest wavelength; without wavelengths the bands at 3/4, 2/4 and 1/4.
    """
    if wavelength_nm is None or not np.isfinite(wavelength_nm).all():
        red, green, blue = ((count - 1) * fraction // 4 for fraction in (3, 2, 1))
        return (red, green, blue), "by number"
    waves = np.asarray(wavelength_nm, np.float64)
    red, green, blue = (int(np.argmin(np.abs(waves - target))) for target in RGB_NM)
    off = max(abs(waves[band] - target) for band, target in zip((red, green, blue), RGB_NM, strict=True))
    if len({red, green, blue}) == 3 and off <= FAR_NM:
        return (red, green, blue), "true colour"
    order = np.argsort(waves, kind="stable")
    if len(waves) == 1:
        return (0, 0, 0), "grey"
    return (int(order[-1]), int(order[(len(order) - 1) // 2]), int(order[0])), "false colour"


def choose_bands(wavelength_nm: NDArray[np.floating]) -> tuple[tuple[int, int, int], str]:
    """Return the bands to show as red, green and blue, and a caption.

    These are those nearest 640, 550 and 460 nm, else false colour or grey.
    """
    waves = np.asarray(wavelength_nm, np.float64)
    bands, kind = picture_bands(waves, len(waves))
    named = f"{waves[bands[0]]:.0f}" if kind == "grey" else " / ".join(f"{waves[band]:.0f}" for band in bands)
    return bands, f"{kind}, {named} nm"


def picture_step(shape: tuple[int, ...]) -> int:
    """Return the number of lines and samples for one pixel of a (line, sample, ...) cube's picture.

    The longer side has at most 1024 px.
    """
    longest = max(shape[:2])
    return max(-(-longest // MOST_PX), min(STEP, longest // LEAST_PX), 1)


@dataclass(frozen=True)
class Quicklook:
    """A picture with its scale: ``low`` and ``high`` are the values of 0 and 255; empty where not known."""

    image: NDArray[np.uint8]  # (y, x, 3)
    low: tuple[float, ...] = ()  # (3,)
    high: tuple[float, ...] = ()  # (3,)
    step: int = 1  # lines and samples a pixel
    bands: tuple[int, ...] = ()  # (3,) of the cube

    def values(self) -> NDArray[np.float32]:
        """Return the cube's values, (y, x, 3), to 8 bits between ``low`` and ``high``."""
        low, high = (np.array(ends, np.float32) for ends in (self.low, self.high))
        values: NDArray[np.float32] = low + self.image.astype(np.float32) / np.float32(255) * (high - low)
        return values


def stretched(
    image: NDArray[np.floating], *, step: int = 1, bands: tuple[int, ...] = (), together: bool = False
) -> Quicklook:
    """Return the 2nd to 98th percentile of each band as 0..255, (y, x, band) in and out.

    Values that are not finite become 0. ``together`` gives all bands one scale, so that colours are true.
    """
    ends = np.array([_ends(image[..., band]) for band in range(image.shape[-1])])
    low, high = (ends[:, 0], ends[:, 1])
    if together:
        low, high = np.full_like(low, low.min()), np.full_like(high, high.max())
    out = np.zeros(image.shape, np.uint8)
    for band in range(image.shape[-1]):
        plane = image[..., band]
        known = np.isfinite(plane)
        span = high[band] - low[band] if high[band] > low[band] else ends.dtype.type(1)
        scaled = np.clip((np.where(known, plane, low[band]) - low[band]) / span, 0, 1) * 255
        out[..., band] = np.where(known, scaled, 0).astype(np.uint8)
    return Quicklook(out, tuple(low.tolist()), tuple(high.tolist()), step, bands)


def _ends(plane: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the 2nd and 98th percentile of a band's known values; zeros without any."""
    known = plane[np.isfinite(plane)]
    return np.percentile(known, (2, 98)) if known.size else np.zeros(2, plane.dtype)


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
            low, high = _ends(plane)
            span = high - low if high > low else np.inf
            shown[..., band] = np.where(known, np.clip((plane - low) / span, 0, 1), 0.86)
    return shown


def develop(image: NDArray[np.generic], field: NDArray[np.generic]) -> NDArray[np.float32]:
    """Return scene values as a picture (y, x, 3) float32 0..1 in true colours, with one scale for all bands."""
    known = np.asarray(field, np.float32)
    known = known[np.isfinite(known)]
    if not known.size or not (white := float(np.percentile(known, 99))) > 0:
        return stretch(image)
    middle = float(np.clip(np.median(known) / white, 1e-3, 0.999))
    power = float(np.clip(np.log(MID_GREY) / np.log(middle), 0.45, 1.0))
    values = np.asarray(image, np.float32)
    return np.where(np.isfinite(values), np.clip(values / white, 0, 1) ** power, np.float32(0.86))


class LineThumbnail:
    """Collect every n-th line and sample of three bands, in values of the white reference where it is known."""

    def __init__(
        self,
        shape: tuple[int, int, int],
        wavelength_nm: NDArray[np.floating] | None,
        *,
        dark: NDArray[np.floating] | None = None,
        white: NDArray[np.floating] | None = None,
        white_reference: NDArray[np.floating] | None = None,
    ) -> None:
        self._step = picture_step(shape)
        self._bands, kind = picture_bands(wavelength_nm, shape[2])
        chosen = list(self._bands)
        self._frames: tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None = None
        if dark is not None and white is not None:
            level, light = (np.asarray(frame[:: self._step][:, chosen], np.float32) for frame in (dark, white))
            value = (
                np.ones(3, np.float32) if white_reference is None else np.asarray(white_reference[chosen], np.float32)
            )
            self._frames = level, light, value
        self._together = self._frames is not None and kind == "true colour"
        self._rows: list[NDArray[np.float32]] = []

    def add(self, start: int, lines: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Add the (line, sample, band) ``lines`` from line ``start`` on; invalid ones become black."""
        rows = slice(-start % self._step, None, self._step)
        part = np.asarray(lines[rows, :: self._step][..., list(self._bands)], np.float32)
        if self._frames is not None:
            level, light, value = self._frames
            with np.errstate(divide="ignore", invalid="ignore"):
                part = (part - level) / (light - level) * value
        part[~valid[rows]] = np.nan
        self._rows.append(part)

    def finish(self) -> Quicklook:
        """Return the picture of all lines taken so far."""
        return stretched(np.concatenate(self._rows), step=self._step, bands=self._bands, together=self._together)


def write_quicklook(group: zarr.Group, found: Quicklook) -> None:
    """Store a picture beside its cube."""
    about: dict[str, Any] = {"long_name": "picture for viewers, red green blue"}
    if found.bands:
        about |= {"bands": list(found.bands), "step": found.step, "low": list(found.low), "high": list(found.high)}
    write_image(group, ARRAY, DIMS, found.image, about)


def quicklook_of(group: zarr.Group) -> Quicklook | None:
    """Return the picture of an opened cube or mosaic; None without one.

    Raises IncompleteStoreError: the picture is damaged.
    """
    if ARRAY not in group:
        return None
    image = read_array(group, ARRAY)
    about: dict[str, Any] = dict(group[ARRAY].attrs)
    low, high, bands = (tuple(about.get(name, ())) for name in ("low", "high", "bands"))
    return Quicklook(image, low, high, int(about.get("step", 1)), bands)

"""Model the line camera: pixel rays, slit, exposure, timing, and the footprint of a sample.

Positions along the line and along the scan are in px: one IFOV in the tangent plane of the undeflected direction.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.setting_fields import assumed, settings_table, stated

Number = TypeVar("Number", float, NDArray[np.float64])
ONE_DRAW_READ_NOISE_E = 10.0
LARGEST_SUM_DN = 65535


@settings_table
class LineCamera:
    """A pushbroom camera behind the mirror. Values marked as assumed are not measured on a unit.

    The defaults describe a 640 x 270 line camera behind a 70 mm lens: IFOV 105.714 urad.
    """

    samples: int = stated(640, "Pixels of a line", "px", 16, 65_536)
    pitch_um: float = stated(7.4, "From pixel to pixel of the sensor", "um", 0.5, 200)
    focal_length_mm: float = stated(70.0, "Focal length of the lens", "mm", 1, 1_000_000)
    slit_um: float = assumed(20.0, "Width of the spectrograph's slit", "um", 0.5, 2000)
    exposure_ms: float = stated(100.0, "Exposure of a line", "ms", 0.5, 10_000)
    readout_ms: float = stated(0.0, "Time after an exposure before the next one begins", "ms", 0, 100_000)
    max_rate_hz: float = stated(350.0, "Most lines in a second", "Hz", 0.1, 100_000)
    bits: int = stated(12, "Bits of the converter", "", 8, 16)
    electrons_per_dn: float = assumed(5.0, "Electrons for one DN", "", 1e-3, 1e4)
    read_noise_e: float = assumed(20.0, "Standard deviation of the read noise, in electrons", "", 0, 1e4)
    dark_dn: float = assumed(64.0, "Level of the converter without light", "", 0, 16_383)

    @property
    def ifov_rad(self) -> float:
        """Return the angle of one pixel [rad]."""
        return self.pitch_um * 1e-3 / self.focal_length_mm

    @property
    def slit_px(self) -> float:
        """Return the width of the slit's image along the scan [px]."""
        return self.slit_um / self.pitch_um

    @property
    def full_scale_dn(self) -> int:
        """Return the largest number of the converter."""
        return (1 << self.bits) - 1

    @property
    def full_scale_e(self) -> float:
        """Return the electrons at which a sample saturates, above the dark level."""
        return (self.full_scale_dn - self.dark_dn) * self.electrons_per_dn

    @property
    def frame_ms(self) -> float:
        """Return the frame period: exposure and readout, limited by the highest rate (erratum E13)."""
        return max(self.exposure_ms + self.readout_ms, 1000.0 / self.max_rate_hz)

    def mid_exposure_s(self, line: Number) -> Number:
        """Return the time of mid exposure of lines by their number, since the start of the first [s]."""
        return (line * self.frame_ms + self.exposure_ms / 2) * 1e-3

    def scan_seconds(self, lines: int) -> float:
        """Return the time for ``lines`` lines in one uninterrupted sweep [s] (the paper's t_img = N t_frame)."""
        return lines * self.frame_ms * 1e-3

    def pixel_slopes(self, binning: int = 1) -> NDArray[np.float64]:
        """Return the tangent k_y/k_z of each (binned) sample's ray, (sample,) float64."""
        middle = (np.arange(self.samples // binning, dtype=np.float64) + 0.5) * binning - 0.5
        return (middle - (self.samples - 1) / 2) * self.ifov_rad

    def sample_at(self, slopes: NDArray[np.float64], binning: int = 1) -> NDArray[np.float64]:
        """Return the continuous (binned) sample of each slope, integers at centres: the inverse of ``pixel_slopes``."""
        return (slopes / self.ifov_rad + self.samples / 2) / binning - 0.5


def footprint_kernel(width_px: float) -> NDArray[np.float64]:
    """Return the weights of a box of ``width_px`` over a scene that is linear between its pixels, centred on a pixel.

    Odd length, sum 1, none negative. The simulator computes the same product at any position; this is the closed form
    at pixel centres.
    """
    half = int(np.ceil(width_px / 2 + 1))
    edges = np.arange(-half, half + 1, dtype=np.float64)
    upper, lower = _linear_integral(width_px / 2 - edges), _linear_integral(-width_px / 2 - edges)
    return (upper - lower) / width_px


def _linear_integral(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the integral of the kernel of linear interpolation from minus infinity to t."""
    a = np.minimum(np.abs(t), 1.0)
    return 0.5 + np.sign(t) * a * (1 - a / 2)


def digitise(
    electrons: NDArray[np.floating], camera: LineCamera, rng: np.random.Generator | None
) -> NDArray[np.uint16]:
    """Convert expected electrons (..., band) of one exposure to DN: shot noise, read noise, dark level, saturation.

    Negative electrons count as 0. DN are clipped to the converter's range and rounded half to even. ``rng`` None means
    no noise.
    """
    signal = np.maximum(electrons, 0).astype(np.float32, copy=False)
    if rng is not None and camera.read_noise_e >= ONE_DRAW_READ_NOISE_E:
        signal = _shot_and_read(signal, camera, rng)
    elif rng is not None:  # exact Poisson counts plus normal read noise
        read = rng.standard_normal(signal.shape, dtype=np.float32) * np.float32(camera.read_noise_e)
        signal = read + rng.poisson(signal).astype(np.float32)
    dn = np.rint(signal / np.float32(camera.electrons_per_dn) + np.float32(camera.dark_dn))
    return np.asarray(np.clip(dn, 0, camera.full_scale_dn).astype(np.uint16))


def _shot_and_read(expected: NDArray[np.float32], camera: LineCamera, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return shot plus read noise from one normal draw z: mean + sqrt(V) z + (k3 / 6V)(z^2 - 1).

    The first three cumulants are exact (Cornish and Fisher, 1938, second order). The remaining excess kurtosis is
    lambda / V^2 <= 1 / (4 read^2): 6e-4 at 20 e-, not detectable in 1e6 draws. Hence the least read noise for this
    branch.
    """
    variance = expected + np.float32(camera.read_noise_e**2)
    z = rng.standard_normal(expected.shape, dtype=np.float32)
    skew = expected / (6 * variance)
    np.sqrt(variance, out=variance)
    variance += skew * z
    variance *= z
    variance -= skew
    return variance + expected


def footprint(light: NDArray[np.floating], camera: LineCamera) -> NDArray[np.float32]:
    """Blur a grid-aligned scene by the slit along y and the pixel along x; (y, x, k) in any linear unit."""
    return _convolve(_convolve(light, footprint_kernel(camera.slit_px), 0), footprint_kernel(1.0), 1)


def expose(seen: NDArray[np.floating], camera: LineCamera, *, rng: np.random.Generator | None) -> NDArray[np.float32]:
    """Return one exposure by line of a grid-aligned scene (y, x, band) [e-] after the footprint, as float32 electrons.

    They are without the dark level. ``rng`` None means no noise.
    """
    dn = digitise(seen, camera, rng).astype(np.float32)
    return (dn - np.float32(camera.dark_dn)) * np.float32(camera.electrons_per_dn)


def _convolve(image: NDArray[np.floating], kernel: NDArray[np.float64], axis: int) -> NDArray[np.float32]:
    """Convolve along one axis with the edge pixel repeated outside."""
    half = len(kernel) // 2
    pad = [(half, half) if other == axis else (0, 0) for other in range(image.ndim)]
    padded = np.pad(image.astype(np.float32, copy=False), pad, mode="edge")
    out = np.zeros(image.shape, np.float32)
    for offset, weight in enumerate(kernel):
        out += np.float32(weight) * np.take(padded, range(offset, offset + image.shape[axis]), axis=axis)
    return out

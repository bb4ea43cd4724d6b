"""Find the signal subspace of a field: the directions of spectra above the noise, tested over the whole field.

Second moments are accumulated as lines arrive. Means over 4 x 4 spectra have 1/16 of the noise variance. A weak signal
that neighbours share then exceeds the noise in their covariance (a minimum noise fraction transform: Green et al.
1988). Eigenvalues of noise alone end at the edge of the Marchenko-Pastur law, and fluctuate there by the Tracy-Widom
law (Johnstone 2001). This gives the test.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from spectralzoom.pipeline.readings import SIGMA_OF_MEDIAN
from spectralzoom.pipeline.signal.components import BLOCK, Components, Floats

SPECTRA_A_BAND = 200  # single spectra for the covariance, for each band; more add time and little accuracy
FEW_BANDS = 8  # fewer cannot predict each other: their noise comes from neighbouring pixels, and all are stored
KEPT_SPECTRA = 8192  # from which the law of residuals is learned
FINE = 1 / 16  # of the noise: the step of few bands, unless a better one is known
SMALL_FIELD = 500_000  # spectra: smaller fields keep all smooth directions, for some megabytes
SMOOTH = 24  # bumps over the wavelengths; as many as the columns that networks read
LACKING = 0.3  # of the length of a bump: with less outside the components a direction is in them already
NOISE_ROUNDS = 6
MOST_SHARED = 32  # directions of rare spectra that become components
LEAST_NOISE = 1e-6  # of a band's largest value: constant values have no noise to divide by
NEIGHBOURS = 4  # bands to either side that predict a band, if there are too few spectra for all
# 1 - probability of the Tracy-Widom law (real matrices), and its quantiles
TRACY_WIDOM = (
    (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 1e-3, 1e-4, 1e-6),
    (-0.1653, 0.4501, 0.9793, 1.6017, 2.0234, 2.4224, 3.2724, 4.3549, 6.27),
)

SUMS = ("lit", "total", "single", "block", "block_total", "largest")

Values = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass
class SignalStatistics:
    """Second moments of spectra, of their means over 4 x 4 and of neighbours' differences, and some of the spectra.

    Spectra are centred on a mean of the first ones, so that nothing cancels. Those that miss bands are left out: they
    would count as the mean there, and make a direction of it. If most spectra miss some, those with half of them count
    so.
    """

    bands: int
    expected: int  # spectra that will come, about
    count: int = 0
    means: int = 0
    origin: Values | None = None  # (band,)
    lit: Bools = field(init=False)  # (band,) with a value anywhere
    total: Floats = field(init=False)  # (band,) sum of the single spectra counted, from the origin
    single: Floats = field(init=False)  # (band, band) sum of their products
    block: Floats = field(init=False)  # (band, band) the same of means
    block_total: Floats = field(init=False)
    largest: Floats = field(init=False)  # (band,) farthest value from the origin
    rough: list[Values] = field(default_factory=list)  # (n, band) second differences of neighbours
    kept: list[Values] = field(default_factory=list)  # (n, band) spectra, from the origin

    def __post_init__(self) -> None:
        self.lit = np.zeros(self.bands, np.bool_)
        self.total, self.block_total, self.largest = np.zeros((3, self.bands))
        self.single, self.block = np.zeros((2, self.bands, self.bands))
        wanted = max(SPECTRA_A_BAND * self.bands, 4 * KEPT_SPECTRA)
        # powers of 2 divide a block's side: blocks all begin alike
        self._stride = min(2 ** round(np.log2(max(self.expected / wanted, 1)) / 2), BLOCK)
        self._thin = max(1, round(self.expected / self._stride**2 / KEPT_SPECTRA))

    def add(self, values: Values, valid: Bools) -> None:
        """Add some neighbouring lines: (line, sample, band) scene values, and their validity by `calibrate`."""
        from spectralzoom.pipeline.signal import compiled_loops

        if not values.size or not valid.any():
            return
        spectra = np.ascontiguousarray(values, np.float32)
        whole = valid
        origin = self.origin
        sums = np.zeros((*(size // BLOCK for size in valid.shape[:2]), self.bands), np.float32)
        largest = np.zeros(self.bands, np.float32)
        plain = self.bands > FEW_BANDS and valid.ndim == 2 and valid.all() and self.lit.all()
        if origin is None or not (plain and compiled_loops.sum_blocks(spectra, origin, largest, sums)):
            spectra, whole = self._centred(values, valid)
            origin = np.zeros_like(largest)
            sums[:] = 0
            largest[:] = 0
            compiled_loops.sum_blocks(spectra, origin, largest, sums)
        np.maximum(self.largest, largest, out=self.largest)
        lines, samples = sums.shape[:2]
        if sums.size:
            every = whole[: lines * BLOCK, : samples * BLOCK].reshape(lines, BLOCK, samples, BLOCK).all(axis=(1, 3))
            means = (sums[every] / BLOCK**2).astype(np.float64)
            self.block += means.T @ means  # float32 would round off the noise below a signal of 300 deviations
            self.block_total += means.sum(axis=0)
            self.means += len(means)
        thin = np.s_[:: self._stride, :: self._stride]
        some = spectra[thin][whole[thin]] - origin
        exact = some.astype(np.float64)
        self.single += exact.T @ exact
        self.total += exact.sum(axis=0)
        self.kept.append(some[-self.count % self._thin :: self._thin].copy())
        self.count += len(some)
        if self.bands <= FEW_BANDS and min(whole.shape) >= 3:
            # Second differences in both directions: for a smooth field they have 36 times the noise's variance.
            across = spectra[:, :-2] - 2 * spectra[:, 1:-1] + spectra[:, 2:]
            both = across[:-2] - 2 * across[1:-1] + across[2:]
            near = sliding_window_view(whole, (3, 3)).all(axis=(2, 3))
            self.rough.append(both[near][:: self._thin * self._stride**2].copy())

    def _centred(self, values: Values, valid: Bools) -> tuple[Values, Bools]:
        """Return spectra from the origin with 0 for missing values, and which of them count."""
        by_band = valid if valid.ndim == 3 else valid[..., None]
        if self.origin is None or not self.lit.all():
            known = by_band & np.isfinite(values)
            seen = known.sum(axis=(0, 1))
            first = np.where(known, values, 0).sum(axis=(0, 1), dtype=np.float64) / np.maximum(seen, 1)
            before = np.zeros(self.bands, np.float32) if self.origin is None else self.origin
            self.origin = np.where(self.lit, before, first).astype(np.float32)
            self.lit |= seen > 0
        spectra = values - self.origin
        there = np.isfinite(spectra) & by_band
        spectra = np.where(there, spectra, np.float32(0))
        seen = there.sum(axis=2)
        bands = max(int(self.lit.sum()), 1)
        whole, usable = seen == bands, 2 * seen >= bands
        return spectra, np.asarray(whole if 2 * whole.sum() >= usable.sum() else usable)

    def merged(self, other: SignalStatistics) -> SignalStatistics:
        """Return the statistics of both, as if all lines had come together; sums are moved to this one's origin."""
        if self.origin is None or other.origin is None:
            return other if self.origin is None else self
        found = replace(
            self,
            expected=self.expected + other.expected,
            count=self.count + other.count,
            means=self.means + other.means,
            origin=np.where(self.lit, self.origin, other.origin).astype(np.float32),
        )
        apart = np.where(self.lit & other.lit, other.origin.astype(np.float64) - self.origin, 0.0)
        found.lit = self.lit | other.lit
        for products, sums, count in (("single", "total", other.count), ("block", "block_total", other.means)):
            total = getattr(other, sums)
            cross = np.outer(apart, total)
            moved = getattr(other, products) + cross + cross.T + count * np.outer(apart, apart)
            setattr(found, products, getattr(self, products) + moved)
            setattr(found, sums, getattr(self, sums) + total + count * apart)
        found.largest = np.maximum(self.largest, other.largest + np.abs(apart))
        found.rough = [*self.rough, *other.rough]
        found.kept = [*self.kept, *((some + apart).astype(np.float32) for some in other.kept)]
        return found

    @property
    def spectra(self) -> Values:
        """Return (n, band) spectra spread over the field, scene values."""
        if self.origin is None or not self.kept:
            return np.zeros((0, self.bands), np.float32)
        return np.concatenate(self.kept) + self.origin

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return all of it by names, to be stored."""
        none = np.zeros((0, self.bands), np.float32)
        return {
            "counts": np.array([self.expected, self.count, self.means]),
            "origin": np.full(self.bands, np.nan) if self.origin is None else self.origin,
            "rough": np.concatenate(self.rough) if self.rough else none,
            "kept": np.concatenate(self.kept) if self.kept else none,
            **{name: getattr(self, name) for name in SUMS},
        }

    @classmethod
    def of_arrays(cls, stored: Mapping[str, NDArray[np.generic]]) -> SignalStatistics:
        """Return the statistics that `arrays` described."""
        expected, count, means = stored["counts"].tolist()
        found = cls(len(stored["origin"]), expected, count, means)
        found.origin = None if np.isnan(stored["origin"]).all() else stored["origin"].astype(np.float32)
        found.rough, found.kept = [stored["rough"].astype(np.float32)], [stored["kept"].astype(np.float32)]
        for name in SUMS:
            setattr(found, name, stored[name])
        return found


def find_components(found: SignalStatistics, *, false_alarm: float = 0.01, least: int = 4) -> Components:
    """Return the components of a field: directions whose variance exceeds that of noise over the whole field.

    ``false_alarm`` is the probability that noise alone gives a component, ``least`` the least number of components.
    Bands without any value are NaN in the mean and have no part in a component.
    """
    lit = np.flatnonzero(found.lit)
    mean = np.full(found.bands, np.nan)
    if found.count == 0 or found.origin is None:
        return Components.empty(found.bands)
    single, own = _covariance(found.single, found.total, found.count)
    mean[lit] = (found.origin + own)[lit]
    covariance = single[np.ix_(lit, lit)]
    sigma = _noise(found, covariance, lit, mean[lit])
    for _ in range(NOISE_ROUNDS if len(lit) > FEW_BANDS and found.count >= 4 * len(lit) else 0):
        scale = np.outer(sigma, sigma)
        axes = _axes(found, covariance / scale, lit, scale, false_alarm, least)
        rest = np.eye(len(lit)) - axes @ axes.T
        left = np.einsum("ij,jk,ik->i", rest, covariance / scale, rest)  # variance of the components' residuals
        sigma = sigma * np.sqrt(np.clip(left / np.maximum(np.diag(rest), 1e-3), 0.25, 4.0))
    scale = np.outer(sigma, sigma)
    axes = _axes(found, covariance / scale, lit, scale, false_alarm, least)
    loadings = np.zeros((axes.shape[1], found.bands))
    loadings[:, lit] = axes.T
    deviations = np.full(found.bands, np.nan)
    deviations[lit] = sigma
    return with_spread(Components(mean, loadings, deviations), found)


def with_spread(components: Components, found: SignalStatistics) -> Components:
    """Return components with the mean square of each score over a field."""
    lit = np.isfinite(components.mean)
    covariance = _covariance(found.single, found.total, found.count)[0][np.ix_(lit, lit)]
    rows = components.axes[:, lit] / components.noise[lit]
    return replace(components, spread=np.einsum("kb,bc,kc->k", rows, covariance, rows))


def components_of_field(
    found: SignalStatistics, wavelength_nm: Floats, *, false_alarm: float, least: int
) -> Components:
    """Find the components of a field; a small field gets all smooth directions too.

    Materials differ smoothly. A difference far below the noise of a spectrum separates two crops where it is averaged
    over many spectra. A test of the whole field misses it if one crop covers a small part: a thirtieth of a million
    spectra, or more of fewer. So small fields keep `SMOOTH` bumps, evenly spread over the wavelengths, which is the
    resolution of the networks. ``wavelength_nm`` is (band,).
    """
    components = find_components(found, false_alarm=false_alarm, least=least)
    lit = np.isfinite(components.mean)
    nm = np.asarray(wavelength_nm, np.float64)[lit]
    if found.expected >= SMALL_FIELD or len(nm) <= FEW_BANDS or np.ptp(nm) == 0:
        return components
    centres, spacing = np.linspace(nm.min(), nm.max(), SMOOTH, retstep=True)
    bumps = np.exp(-0.5 * ((nm - centres[:, None]) / (spacing / 2)) ** 2) * components.noise[lit]
    bumps /= np.linalg.norm(bumps, axis=1, keepdims=True)
    known = components.axes[:, lit]
    length, rows = np.linalg.svd(bumps - (bumps @ known.T) @ known, full_matrices=False)[1:]
    axes = np.zeros((np.count_nonzero(length > LACKING), components.bands))
    axes[:, lit] = rows[length > LACKING]
    return with_spread(replace(components, axes=np.concatenate([components.axes, axes])), found)


def components_of_raster(
    found: SignalStatistics, wavelength_nm: Floats, *, whole: bool, false_alarm: float = 0.01, least: int = 4
) -> Components:
    """Return the components in which a survey keeps a raster; few bands stay as they are, ``whole`` numbers exact."""
    if found.bands <= FEW_BANDS and found.count:
        return bands_alone(found, 1.0 if whole else None)
    return components_of_field(found, wavelength_nm, false_alarm=false_alarm, least=least)


def bands_alone(found: SignalStatistics, unit: Floats | float | None = None) -> Components:
    """Return components that are the bands themselves, in steps of ``unit`` (band,), for few bands.

    A band's own steps, such as one DN of the camera, lose nothing; without them steps are far below the noise.
    """
    usual = find_components(found)
    lit = np.isfinite(usual.mean)
    steps = usual.noise * FINE if unit is None else np.where(lit, unit, np.nan)
    covariance = np.zeros((found.bands, found.bands))
    if found.count:
        covariance, _ = _covariance(found.single, found.total, found.count)
    axes = np.diag(lit.astype(np.float64))[lit]
    return Components(np.where(lit, np.rint(usual.mean / steps) * steps, np.nan), axes, steps, covariance)


def _covariance(products: Floats, total: Floats, count: int) -> tuple[Floats, Floats]:
    mean = total / count
    covariance: Floats = products / count - np.outer(mean, mean)
    return (covariance + covariance.T) / 2, mean


def _noise(found: SignalStatistics, covariance: Floats, lit: NDArray[np.intp], mean: Floats) -> Floats:
    """Return a first estimate of the noise's standard deviation, (band,): unpredicted by other bands or neighbours."""
    variance = np.diag(covariance)
    floor = LEAST_NOISE * np.maximum(np.sqrt(variance), np.abs(mean))
    floor = np.where(floor > 0, floor, floor.min(where=floor > 0, initial=1.0))
    if len(lit) <= FEW_BANDS:
        rough = np.concatenate(found.rough)[:, lit] if found.rough else np.zeros((0, len(lit)))
        sigma = SIGMA_OF_MEDIAN * np.median(np.abs(rough), axis=0) / 6 if len(rough) else np.sqrt(variance)
    elif found.count >= 4 * len(lit):
        scale = np.sqrt(np.where(variance > 0, variance, 1.0))  # bands may be in different units
        with np.errstate(divide="ignore"):
            correlation = covariance / scale[:, None] / scale
            sigma = scale / np.sqrt(np.abs(np.diag(np.linalg.pinv(correlation, hermitian=True))))
    else:
        sigma = np.zeros(len(lit))
        for band in range(len(lit)):
            near = np.arange(max(band - NEIGHBOURS, 0), min(band + NEIGHBOURS + 1, len(lit)))
            near = near[near != band]
            weights = np.linalg.lstsq(covariance[np.ix_(near, near)], covariance[near, band], rcond=1e-10)[0]
            sigma[band] = np.sqrt(max(covariance[band, band] - covariance[band, near] @ weights, 0.0))
    sigma = np.minimum(np.where(np.isfinite(sigma), sigma, 0), np.sqrt(np.maximum(variance, 0)))
    return np.maximum(sigma, floor)


def _axes(
    found: SignalStatistics, white: Floats, lit: NDArray[np.intp], scale: Floats, false_alarm: float, least: int
) -> Floats:
    """Return orthonormal directions (band, component) of whitened spectra: of their means, then of single spectra."""
    bands = len(white)
    if bands <= FEW_BANDS:
        return np.linalg.eigh(white)[1][:, ::-1]
    axes = np.zeros((bands, 0))
    if found.means >= 2 * bands:
        means, _ = _covariance(found.block, found.block_total, found.means)
        axes = significant_axes(BLOCK**2 * means[np.ix_(lit, lit)] / scale, found.means, false_alarm / 2)
    rest = np.eye(bands) - axes @ axes.T
    more = significant_axes(rest @ white @ rest, found.count, false_alarm / 2, known=axes.shape[1])
    axes = np.concatenate([axes, more], axis=1)
    wanted = min(least, bands)
    if axes.shape[1] < wanted:
        rest = np.eye(bands) - axes @ axes.T
        means = BLOCK**2 * _covariance(found.block, found.block_total, max(found.means, 1))[0][np.ix_(lit, lit)] / scale
        largest = np.linalg.eigh(rest @ (white + means) @ rest)[1][:, ::-1]
        axes = np.concatenate([axes, largest[:, : wanted - axes.shape[1]]], axis=1)
    return np.linalg.qr(axes @ np.linalg.eigh(axes.T @ white @ axes)[1][:, ::-1])[0]  # by falling variance


def significant_axes(covariance: Floats, spectra: int, false_alarm: float, *, known: int = 0) -> Floats:
    """Return eigenvectors (band, n) of a covariance with eigenvalues above those of noise, by falling eigenvalue.

    The noise's variance and the effective number of spectra come from the lower half of the eigenvalues, since
    neighbours share a part of their noise. ``known`` directions have been taken out of the covariance.
    """
    bands = len(covariance)
    if known >= bands:
        return np.zeros((bands, 0))
    values, vectors = np.linalg.eigh(covariance)
    edge = noise_edge(np.maximum(values[known:], 0), min(1.0, bands / max(spectra, 1)), false_alarm)
    return vectors[:, ::-1][:, : min(int(np.count_nonzero(values > edge)), bands - known, max(spectra - 1, 0))]


def with_shared(components: Components, residuals: Values, false_alarm: float) -> Components:
    """Return components with the directions that residuals of rare spectra share.

    The method is that of Kuybeda, Malah & Barzohar 2007 (MOCA). ``residuals`` are (rare, band) in deviations of the
    noise.
    """
    lit = np.flatnonzero(np.isfinite(components.mean))
    exact = residuals[:, lit].astype(np.float64)
    axes = components.axes[:, lit].T
    exact -= (exact @ axes) @ axes.T
    found = significant_axes(exact.T @ exact / max(len(exact), 1), len(exact), false_alarm, known=len(components))
    every = np.linalg.qr(np.concatenate([axes, found[:, :MOST_SHARED]], axis=1))[0]
    every[:, : axes.shape[1]] = axes
    rows = np.zeros((every.shape[1], components.bands))
    rows[:, lit] = every.T
    spread = components.spread
    if spread is not None:  # rare spectra may lie anywhere
        spread = np.pad(spread, (0, len(rows) - len(spread)), constant_values=np.max(spread, initial=1.0))
    return Components(components.mean, rows, components.noise, spread=spread)


def noise_edge(values: Floats, ratio: float, false_alarm: float) -> float:
    """Return the eigenvalue that noise exceeds with probability ``false_alarm``; ``values`` ascend.

    ``ratio`` is bands over spectra; it is raised if the lower half of the eigenvalues spreads farther than expected.
    """
    count = len(values)
    middle, low = float(np.median(values)), float(values[count // 10])
    spread = np.sqrt(ratio)
    if middle > 0 and spread < 1:
        tries, expected = _law_spreads()
        spread = max(spread, float(np.interp(max(middle - low, 0.0) / middle, expected, tries)))
    variance = middle / max(1 - spread**2 / 3, 0.5)
    edge = variance * (1 + spread) ** 2
    width = variance * spread * (1 + spread) ** (4 / 3) * (count ** (-2 / 3))
    quantile = float(np.interp(-np.log(false_alarm), -np.log(TRACY_WIDOM[0]), TRACY_WIDOM[1]))
    return float(edge + quantile * width)


@cache
def _law_spreads() -> tuple[Floats, Floats]:
    """Return spreads of the Marchenko-Pastur law, and how far its lowest tenth is below its median, over the median."""
    tries = np.geomspace(1e-3, 1.0, 200)
    angle = (np.arange(2000) + 0.5) / 2000 * np.pi
    found: list[float] = []
    for spread in tries:
        low, high = (1 - spread) ** 2, (1 + spread) ** 2
        at = (low + high) / 2 - (high - low) / 2 * np.cos(angle)
        mass = np.cumsum(np.sin(angle) ** 2 / at)
        middle, tenth = np.interp([0.5, 0.1], mass / mass[-1], at)
        found.append((middle - tenth) / middle)
    return tries, np.array(found)

"""Find shifts between images, and correct sweeps, by least squares over their overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy
import skimage
from numpy.typing import NDArray

from spectralzoom.pipeline.rectify.kernels import kernel_taps

Status = Literal["found", "undecidable", "flat", "empty"]
Floats = NDArray[np.float64]

LEAST_FRACTION = 0.25  # of the largest common area; below it a chance correlation can exceed that of the true shift
LEAST_SIDE_PX = 12  # of the pixels compared
LOBE_PX = 3.0  # shifts nearer than this belong to one peak
RIVALS = 4
RIVAL_MARGIN, RIVAL_NOISE = 0.1, 8.0  # a rival must leave 1 + margin + noise / sqrt(pixels) times more unexplained
INTERPOLATION_MISFIT = 2e-3  # of the variance: what Catmull-Rom leaves of sharp texture at half a pixel
LEAST_LIKENESS = 0.1  # of the slopes of both images
MOST_ERROR_PX = 0.3
WHITE_ERRORS = 6.0  # of the correlation of white noise: above it neighbours are alike
FLAT_SPREAD = 1e-6  # of the mean; and of the whole variance
UPSAMPLE = 20
ROUNDS = 8
SETTLED_PX = 1e-3
REALIGN_PX = 0.75  # a fit further off is made again from the next integer,
REALIGNMENTS = 4  # at most so many times
MOST_STEP_PX = 1.0
SMOOTHING = np.array([1, 4, 6, 4, 1]) / 16
SMOOTHED_NOISE = float(SMOOTHING @ SMOOTHING) ** 2  # fraction of white noise's variance that smoothing leaves
BORDER_PX = 5  # pixels that smoothing (2), the step (1) and interpolation (2) take from every side
SINGULAR = 1e-12
TINY = 1e-30
ERROR_FLOOR_PX = 0.05  # least error of a window: lines jitter
OUTLIER_ERRORS = 2.0  # the influence of a window is limited beyond
WRONG_ERRORS = 10.0  # a window is left out beyond
DRIFT_PRIOR_PX = 10.0  # over half a sweep; separates drift from offset if there is one window alone
OFFSET_PRIOR_PX = 1e4  # affects only the mean of sweeps that are not tied to the reference


@dataclass(frozen=True)
class PairShift:
    """Shift between two images of an overlap; the figures are NaN where nothing was compared.

    ``found`` is the only status with a shift. ``undecidable``: another shift explains the overlap as well within the
    noise (periodic texture), or one direction has no structure (an edge, plain rows). So is a best shift beyond the
    prior. ``flat``: no structure wider than a pixel. ``empty``: too few pixels in common.
    """

    status: Status
    shift: Floats  # (2,) rows and columns to add to places in ``moving``; NaN unless found [px]
    error_px: Floats  # (2,) standard error that the noise leaves
    pixels: int = 0


@dataclass(frozen=True)
class _Fit:
    """Least squares around one candidate."""

    shift: Floats
    error: Floats
    misfit: float  # fraction of the variance left unexplained
    likeness: float  # correlation of the two images' slopes in the direction that has the least in common
    pixels: int


def pair_shift(reference: NDArray[np.floating], moving: NDArray[np.floating], *, prior_px: float) -> PairShift:
    """Find the shift that brings ``moving`` onto ``reference``: ``reference(p) = moving(p - shift)``.

    The search stays within the geometric prior, since crop rows alias. Candidates are the peaks of the normalised
    correlation over all integer shifts, of the pixels that both see [1]. Each is refined by least squares of grey
    values. The windowed phase correlation [2] is only the start, as its window biases the shift of broad texture
    towards the integer. The best candidate is accepted if every other leaves clearly more variance unexplained.

    Both are (row, column) broad-band images on the same grid, NaN where nothing was seen; gain and offset may differ.
    ``prior_px`` is the largest possible shift in either direction.

    References
    ----------
    .. [1] D. Padfield, "Masked object registration in the Fourier domain", IEEE Trans. Image Process., 2012.
       doi:10.1109/TIP.2011.2181402
    .. [2] M. Guizar-Sicairos, S. T. Thurman, J. R. Fienup, "Efficient subpixel image registration algorithms",
       Opt. Lett., 2008. doi:10.1364/OL.33.000156
    """
    first, second = _standardised(reference), _standardised(moving)
    if first is None or second is None:
        return nothing_found("flat" if np.isfinite(reference).any() and np.isfinite(moving).any() else "empty")
    correlation, common = _correlate(first, second, int(np.ceil(prior_px)) + 1)
    if common.max() < 1:
        return nothing_found("empty")
    fits = [fit for integer in _candidates(correlation) if (fit := _refine(first, second, integer)) is not None]
    found = _judge(sorted(fits, key=lambda fit: fit.misfit), prior_px) if fits else nothing_found("undecidable")
    if found.status == "undecidable" and not (_is_textured(first) and _is_textured(second)):
        return replace(found, status="flat")
    return found


def _judge(fits: list[_Fit], prior_px: float) -> PairShift:
    """Accept the best fit if no other comes near it, both directions are certain and it lies within the prior."""
    best = fits[0]
    rival = min((fit.misfit for fit in fits if np.abs(fit.shift - best.shift).max() > LOBE_PX), default=1.0)
    ratio = (rival + INTERPOLATION_MISFIT) / (best.misfit + INTERPOLATION_MISFIT)
    sure = (
        ratio > 1 + RIVAL_MARGIN + RIVAL_NOISE / np.sqrt(best.pixels)
        and best.likeness > LEAST_LIKENESS
        and best.error.max() < MOST_ERROR_PX
        and np.abs(best.shift).max() <= prior_px + 0.5
    )
    return PairShift(
        status="found" if sure else "undecidable",
        shift=best.shift if sure else np.full(2, np.nan),
        error_px=best.error,
        pixels=best.pixels,
    )


def nothing_found(status: Status) -> PairShift:
    """Return a comparison without a result."""
    return PairShift(status, np.full(2, np.nan), np.full(2, np.nan))


def _standardised(image: NDArray[np.floating]) -> Floats | None:
    """Return the image with mean 0 and deviation 1, NaN kept; None if it is empty or constant."""
    seen = np.isfinite(image)
    if not seen.any():
        return None
    values = np.where(seen, image, np.nan).astype(np.float64)
    mean, spread = float(np.nanmean(values)), float(np.nanstd(values))
    return None if spread <= FLAT_SPREAD * abs(mean) or spread == 0 else (values - mean) / spread


def _is_textured(image: Floats) -> bool:
    """Return whether near pixels correlate; white noise is no texture, since a footprint is wider than a pixel."""
    for lag in (1, 2):
        for one, other in ((image[lag:], image[:-lag]), (image[:, lag:], image[:, :-lag])):
            both = np.isfinite(one) & np.isfinite(other)
            alike = abs(float(np.mean(one[both] * other[both]))) if both.any() else 0.0
            if alike > max(LEAST_LIKENESS / 2, WHITE_ERRORS / np.sqrt(max(int(both.sum()), 1))):
                return True
    return False


def _correlate(first: Floats, second: Floats, reach: int) -> tuple[Floats, Floats]:
    """Return correlation and common pixels for every integer shift up to ``reach``, (2 reach + 1, same) each [1].

    Shifts with too little in common, or without variance there, get a correlation of -1.
    """
    size = [scipy.fft.next_fast_len(n + min(reach, n), real=True) for n in first.shape]
    spectra = []
    for image in (first, second):
        seen = np.isfinite(image)
        values = np.where(seen, image, 0.0)
        spectra.append([scipy.fft.rfft2(plane, size) for plane in (seen.astype(np.float64), values, values * values)])
    lags = np.arange(-reach, reach + 1)
    inside = np.abs(lags)[:, None] < first.shape[0], np.abs(lags)[None, :] < first.shape[1]

    def at_shifts(one: int, other: int) -> Floats:
        product = scipy.fft.irfft2(spectra[0][one] * np.conj(spectra[1][other]), size)
        return np.asarray(product[np.ix_(lags % size[0], lags % size[1])] * (inside[0] & inside[1]))

    common = np.rint(at_shifts(0, 0))
    count = np.maximum(common, 1)
    sums = at_shifts(1, 0), at_shifts(0, 1)
    variance = at_shifts(2, 0) - sums[0] ** 2 / count, at_shifts(0, 2) - sums[1] ** 2 / count
    usable = (common >= LEAST_FRACTION * common.max()) & (common > 0)
    usable &= np.minimum(*variance) > FLAT_SPREAD * count
    covariance = at_shifts(1, 1) - sums[0] * sums[1] / count
    correlation = np.full(common.shape, -1.0)
    correlation[usable] = covariance[usable] / np.sqrt(variance[0][usable] * variance[1][usable])
    return correlation, common


def _candidates(correlation: Floats) -> NDArray[np.intp]:
    """Return the integer shifts (peak, 2) of the highest peaks, best first, none within another's lobe."""
    # The window is as wide as a lobe: noise on a broad peak makes no second one.
    peaks = np.argwhere(
        (correlation == scipy.ndimage.maximum_filter(correlation, 2 * int(LOBE_PX) + 1)) & (correlation > -1)
    )
    best = np.argsort(-correlation[tuple(peaks.T)], kind="stable")[: RIVALS + 1]
    return np.asarray(peaks[best] - correlation.shape[0] // 2)


def _refine(first: Floats, second: Floats, integer: NDArray[np.intp]) -> _Fit | None:
    """Return the fit around an integer shift; None if too little is common or it does not converge nearby."""
    for _ in range(REALIGNMENTS):
        moves = list(zip(first.shape, integer.tolist(), strict=True))
        one = first[tuple(slice(max(move, 0), max(size + min(move, 0), 0)) for size, move in moves)]
        other = second[tuple(slice(max(-move, 0), max(size + min(-move, 0), 0)) for size, move in moves)]
        both = np.isfinite(one) & np.isfinite(other)
        kept = scipy.ndimage.minimum_filter(both, 2 * BORDER_PX + 1, mode="constant", cval=False)
        if kept.sum() < LEAST_SIDE_PX**2 / 4:
            return None
        one, other = (np.where(both, image - image[both].mean(), 0.0) for image in (one, other))
        # Start by phase correlation under a Hann window [2], not normalised: noise has equal amplitudes.
        window = np.outer(*(np.hanning(size + 2)[1:-1] for size in one.shape))
        start, *_ = skimage.registration.phase_cross_correlation(  # type: ignore[no-untyped-call]
            one * window, other * window, normalization=None, upsample_factor=UPSAMPLE
        )
        fit = _least_squares(_smoothed(one), _smoothed(other), kept, np.clip(start, -REALIGN_PX, REALIGN_PX))
        if fit is None:
            return None
        if np.abs(fit.shift).max() <= REALIGN_PX:
            return replace(fit, shift=integer + fit.shift)
        integer = integer + np.rint(fit.shift).astype(np.intp)
    return None


def _least_squares(one: Floats, other: Floats, kept: NDArray[np.bool_], shift: Floats) -> _Fit | None:
    """Fit shift, gain and offset of grey values by Gauss-Newton, from a start within a pixel; None if gain < 0."""
    target = one[kept]
    if np.var(target) <= FLAT_SPREAD:
        return None
    for _ in range(ROUNDS):
        moved = _moved(other, shift)
        slopes = _slopes(moved, kept)
        system = np.stack([-slopes[0], -slopes[1], moved[kept], np.ones(len(target))], axis=1)
        answer, *_ = np.linalg.lstsq(system.T @ system, system.T @ target, rcond=SINGULAR)
        if answer[2] <= 0:  # a negative image is no match
            return None
        change = answer[:2] / answer[2]
        left = target - system @ answer
        if np.abs(change).max() < SETTLED_PX:
            break
        shift = shift + np.clip(change, -1, 1)
        if np.abs(shift).max() > MOST_STEP_PX:
            return _fit_of(np.clip(shift, -MOST_STEP_PX, MOST_STEP_PX), target, left, _slopes(one, kept), slopes)
    return _fit_of(shift, target, left, _slopes(one, kept), slopes)


def _fit_of(shift: Floats, target: Floats, left: Floats, slopes: Floats, others: Floats) -> _Fit:
    """Return error and quality of a fit. Only slopes that both images share count, since noise has slopes as well."""
    misfit = min(float(np.var(left) / np.var(target)), 1.0)
    value, direction = np.linalg.eigh(np.asarray(slopes @ others.T + others @ slopes.T) / 2)
    weakest = direction[:, 0]
    strength = float(np.linalg.norm(weakest @ slopes) * np.linalg.norm(weakest @ others))
    noise = float(np.var(left)) / SMOOTHED_NOISE
    error: Floats = np.sqrt(noise * np.sum(direction**2 / np.maximum(value, TINY), axis=1))
    return _Fit(shift, error, misfit, float(value.min()) / strength if strength > 0 else 0.0, len(target))


def _slopes(image: Floats, kept: NDArray[np.bool_]) -> Floats:
    """Return slopes by rows and by columns, (2, kept pixel)."""
    return np.stack([np.gradient(image, axis=axis)[kept] for axis in (0, 1)])


def _smoothed(image: Floats) -> Floats:
    """Damp noise and details that are too fine to interpolate."""
    for axis in (0, 1):
        image = scipy.ndimage.convolve1d(image, SMOOTHING, axis=axis, mode="nearest")
    return image


def _moved(image: Floats, shift: Floats) -> Floats:
    """Return the image moved by less than a lobe, ``image(p - shift)`` by Catmull-Rom; the borders repeat."""
    for axis in (0, 1):
        index, weight = kernel_taps(np.arange(image.shape[axis]) - shift[axis], "catmull-rom")
        np.clip(index, 0, image.shape[axis] - 1, out=index)
        taps = [float(w) * np.take(image, row, axis=axis) for w, row in zip(weight[0], index.T, strict=True)]
        image = np.asarray(np.sum(taps, axis=0))
    return image


@dataclass(frozen=True)
class SweepShift:
    """Shift of a sweep's line centres from the reported ones, in scene px along the line and the scan."""

    name: str
    offset: Floats  # (2,) at the middle of the sweep [px]
    drift: Floats  # (2,) [px per line]

    def of_lines(self, lines: int) -> Floats:
        """Return the shift of every line of a sweep of ``lines`` lines, (line, 2) along and scan [px]."""
        return self.offset + self.drift * (np.arange(lines) - (lines - 1) / 2)[:, None]

    def plus(self, other: SweepShift) -> SweepShift:
        """Add a later correction of the same sweep."""
        return SweepShift(self.name, self.offset + other.offset, self.drift + other.drift)


@dataclass(frozen=True)
class WindowShift:
    """Shift of the moving sweep of a pair from the reference sweep, in one window of their overlap.

    A shift of the line centre by d moves the place of the window's sample by ``turn @ d``. That is nearly d, but the
    line turns with its centre: at its end by 1.7 px for 50.
    """

    reference: int  # number of the sweep
    moving: int
    line: tuple[float, float]  # at the window's middle, of either sweep
    turn: Floats  # (2, 2, 2) of either sweep
    shift: Floats  # (2,) along and scan [px]
    error_px: Floats  # (2,)


@dataclass(frozen=True)
class SweepShifts:
    """Corrections of all sweeps, the residuals of all windows, and the sweeps without a tie to the reference."""

    shifts: tuple[SweepShift, ...]
    residual: Floats  # (window, 2) measured less modelled [px]
    reference: int  # number of the sweep that was held
    untied: tuple[int, ...]  # numbers of those not joined to it by accepted windows


def no_shifts(names: Sequence[str]) -> tuple[SweepShift, ...]:
    """Return zero corrections."""
    return tuple(SweepShift(name, np.zeros(2), np.zeros(2)) for name in names)


def solve_sweeps(
    windows: Sequence[WindowShift], names: Sequence[str], lines: Sequence[int], *, reference: int | None = None
) -> SweepShifts:
    """Find the offset and drift of every sweep, given by name and lines, from the shifts of accepted windows.

    It is a least squares fit with soft L1 loss: each window is weighted by its error, and its influence is limited to
    twice that. Windows with residuals above ten times their error are then left out, and the fit is repeated. Overlaps
    show differences only, so the ``reference`` sweep is fixed: by default the middle one of the largest group that
    windows join. Sweeps without a tie to the reference have a mean shift of 0, and are listed as untied.
    """
    held = reference
    if held is None:
        largest = max((sorted(tied_to(windows, one, len(names))) for one in range(len(names))), key=len, default=[0])
        held = largest[len(largest) // 2]
    joined = tied_to(windows, held, len(names))
    untied = tuple(number for number in range(len(names)) if number not in joined)
    if not windows:
        return SweepShifts(no_shifts(names), np.empty((0, 2)), held, untied)
    halves = [max((count - 1) / 2, 1.0) for count in lines]
    system = np.zeros((2 * len(windows), 4 * len(lines)))  # columns of a sweep: offset, and drift in px at its end
    for row, window in enumerate(windows):
        for side, sweep in enumerate((window.reference, window.moving)):
            place = (window.line[side] - (lines[sweep] - 1) / 2) / halves[sweep]
            signed = (2 * side - 1) * window.turn[side]
            system[2 * row : 2 * row + 2, 4 * sweep : 4 * sweep + 4] += np.hstack([signed, place * signed])
    system[:, 4 * held : 4 * held + 4] = 0
    measured = np.concatenate([window.shift for window in windows])
    error = np.concatenate([np.hypot(window.error_px, ERROR_FLOOR_PX) for window in windows])
    answer = _robust(system, measured, error)
    wrong = np.abs((measured - system @ answer) / error).reshape(-1, 2).max(axis=1) > WRONG_ERRORS
    if wrong.any():
        kept = np.repeat(~wrong, 2)
        answer = _robust(system[kept], measured[kept], error[kept])
    ends = zip(names, answer.reshape(-1, 2, 2), halves, strict=True)
    shifts = tuple(SweepShift(name, offset, drift / half) for name, (offset, drift), half in ends)
    return SweepShifts(shifts, (measured - system @ answer).reshape(-1, 2), held, untied)


def tied_to(windows: Sequence[WindowShift], sweep: int, sweeps: int) -> frozenset[int]:
    """Return the sweeps that windows join to one, itself included."""
    if not sweeps:
        return frozenset()
    pairs = np.array([(window.reference, window.moving) for window in windows], np.intp).reshape(-1, 2)
    joins = scipy.sparse.coo_array((np.ones(len(pairs)), pairs.T), (sweeps, sweeps))
    _, group = scipy.sparse.csgraph.connected_components(joins, directed=False)
    return frozenset(np.flatnonzero(group == group[sweep]).tolist())


def _robust(system: Floats, measured: Floats, error: Floats) -> Floats:
    """Return the least squares solution with soft L1 loss; weak priors decide what the windows leave open."""
    width = system.shape[1]
    prior = np.diag(np.tile([1 / OFFSET_PRIOR_PX] * 2 + [1 / DRIFT_PRIOR_PX] * 2, width // 4))
    whole = np.vstack([system / error[:, None], prior])
    wanted = np.concatenate([measured / error, np.zeros(width)])
    start, *_ = np.linalg.lstsq(whole, wanted, rcond=None)
    solved = scipy.optimize.least_squares(
        lambda x: whole @ x - wanted, start, jac=lambda x: whole, loss="soft_l1", f_scale=OUTLIER_ERRORS, method="trf"
    )
    return np.asarray(solved.x)

"""Calibrate raw DN to scene values by dark and white frames, and judge the elements of the detector."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import PoseError, RigError, SceneError, ShapeError
from spectralzoom.pipeline.geometry.mirror import RIM_SLACK, mirror_throughput
from spectralzoom.pipeline.readings import SIGMA_OF_MEDIAN
from spectralzoom.pipeline.source import References

FILL_REACH = 8  # samples; elements farther away have seen something else

# thresholds of `find_bad_elements`
HOT_SIGMAS = 8.0  # dark above the band's median
LIT_SIGMAS, LIT_FRACTION = 10.0, 0.1  # least response to judge, in spreads of the dark frame and of the band's median
LEAST_RESPONSE = 0.1  # of the neighbours'
ODD_SIGMAS, ODD_FRACTION = 8.0, 0.2  # off the window, in spreads of the band, and beyond the nearest neighbours
WINDOW, NEAR = 15, 7  # neighbouring samples compared; nearest neighbours, the element among them
MOST_BAD = 0.05  # of all elements, or one column; more mean that the frames are wrong, not the detector
LEAST_LIGHT = 2.0  # sum of white above dark, over that of white below dark
LEAST_NOISE_DN = 1.0  # dark frames are whole numbers: a smaller spread means nothing
BANDS_FOR_COLUMN = 8  # fewer bands cannot separate an odd element from an odd column

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Fill:
    """Elements to be filled, ascending, and the good ones they are filled from, (n,) as indices of a flat frame."""

    element: NDArray[np.intp]
    before: NDArray[np.intp]
    after: NDArray[np.intp]
    fraction: Floats32  # of ``after``


@dataclass(frozen=True)
class Elements:
    """The elements of a detector, judged by the references of the whole line.

    A part of the line would be judged differently: whether a band has light at all, and what a bad element is filled
    from.
    """

    references: References
    gain: Floats32  # (sample, band), NaN where an element has no calibration
    out: Bools  # (sample, band) not valid on any line
    lit: Bools  # (band,) at least one sample of the whole line has a calibration
    fill: Fill

    def part(self, samples: slice) -> Elements:
        """Return some samples of a detector without elements to fill."""
        whole = self.references
        references = replace(
            whole,
            dark=whole.dark[samples],
            white=whole.white[samples],
            bad=None if whole.bad is None else whole.bad[samples],
        )
        return replace(self, references=references, gain=self.gain[samples], out=self.out[samples])


def judge_elements(references: References) -> Elements:
    """Return the gain of each element, whether it is out, and the elements it is filled from.

    Elements without a calibration are out, and bad ones without a good one of their band within 8 samples. Whole
    samples are out if more than half of their bands are bad or without a calibration. A band that no sample is
    calibrated in does not count, and nothing in it is out.
    """
    span = references.white - references.dark
    gain = np.full(span.shape, np.nan, np.float32)
    known = np.isfinite(span) & (span > 0)
    with np.errstate(over="ignore"):
        np.divide(np.broadcast_to(references.white_reference, span.shape), span, out=gain, where=known)
    bad = np.zeros(gain.shape, np.bool_) if references.bad is None else references.bad
    trusted = np.isfinite(gain) & ~bad
    lit = np.asarray(trusted.any(axis=0))
    lost = ~trusted & lit
    out: Bools = np.logical_or(lost, 2 * lost.sum(axis=1, keepdims=True) > lit.sum())
    fill = _fill_of(bad & lit & ~out.all(axis=1, keepdims=True), trusted & ~out)
    out.flat[fill.element] = False
    gain[~trusted] = np.nan  # overflow, and bad elements; those with a fill are overwritten
    return Elements(references, gain, out, lit, fill)


def number_values(references: References, exposure_ms: Floats) -> Floats:
    """Return the scene value of one DN, (band,): the median over the samples; NaN of bands without light.

    Of lines of several exposures, (line,) [ms], the longest counts.
    """
    gain = judge_elements(references).gain.astype(np.float64)
    if references.exposure_ms is not None:
        gain *= references.exposure_ms / np.nanmax(exposure_ms)
    known = np.full(references.dark.shape[1], np.nan)
    lit = np.isfinite(gain).any(axis=0)
    known[lit] = np.abs(np.nanmedian(gain[:, lit], axis=0))
    return known


def _fill_of(wanted: Bools, good: Bools) -> Fill:
    """Find the good neighbours of each wanted element in its band; elements without one nearby are left out."""
    samples, width = good.shape
    bands = np.flatnonzero(wanted.any(axis=0) & good.any(axis=0))
    number = np.arange(samples)[:, None]
    below = np.maximum.accumulate(np.where(good[:, bands], number, -samples - FILL_REACH), axis=0)
    above = np.minimum.accumulate(np.where(good[:, bands], number, 2 * samples + FILL_REACH)[::-1], axis=0)[::-1]
    sample, column = np.nonzero(wanted[:, bands])
    before, after = below[sample, column], above[sample, column]
    one, other = sample - before <= FILL_REACH, after - sample <= FILL_REACH
    near = one | other
    sample, band = sample[near], bands[column[near]]
    before, after = np.where(one, before, after)[near], np.where(other, after, before)[near]
    fraction = (sample - before) / np.maximum(after - before, 1)
    return Fill(sample * width + band, before * width + band, after * width + band, fraction.astype(np.float32))


def calibrate(
    raw: NDArray[np.integer[Any]],
    references: References | Elements,
    *,
    saturated_dn: float,
    position: ArrayLike | None = None,
    exposure_ms: ArrayLike | None = None,
) -> tuple[Floats32, Bools]:
    """Return scene values ``(raw - dark) / (white - dark) * white_reference / throughput``, and their validity.

    ``raw`` is (line, sample, band) uint16 DN. ``position`` (line, 2) mirror X and Y is needed for references with
    ``by_mirror``; a line without one on the mirror is then NaN. ``exposure_ms`` (line,) is needed for references with
    their own: values are multiplied by the exposure of the references over that of the line. A bad element takes the
    value between the nearest good samples of its line and band, at most 8 away, linear in sample. It is not filled if
    more than half of its sample's bands are bad.

    Not valid are elements that :func:`judge_elements` puts out, saturated elements, and filled ones with saturated
    neighbours. A band without light in any sample puts nothing out, and is NaN; nothing is valid if all bands are.

    The DN of a sum of n samples (the coarse pass) show saturation less clearly. Let F be full scale: at n F all samples
    were saturated, above n (F - 1) at least one was, below F none was. Between these the sum may be too low by an
    unknown amount: a small bright object beside dark soil loses its peak without a sign. ``saturated_dn`` is the least
    DN that counts: n F, or n (F - 1) + 1.

    The references are those of the whole line, or elements that are judged already. Values are (line, sample, band)
    float32 in the unit of the white reference, negative below dark, NaN without a calibration. The mask is (line,
    sample), or (line, sample, band) if some but not all bands of a sample are out.

    Raises ShapeError: the references or the positions do not fit the lines.
    Raises PoseError: positions are needed and missing.
    """
    elements = _judged(raw, references)
    gain = line_gain(elements.references, position, exposure_ms)
    valid = _valid(raw, elements, saturated_dn)
    if gain is not None:
        valid[~np.isfinite(gain)] = False
    return _scene_values(raw, elements, gain), valid


def line_gain(references: References, position: ArrayLike | None, exposure_ms: ArrayLike | None) -> Floats32 | None:
    """Return the factor of each line for its exposure and the mirror's throughput, (line,); None if there is none.

    It is NaN without an exposure above 0 ms or a position on the mirror. Raises PoseError: mirror positions are needed
    and missing. Raises ShapeError: exposures are needed and missing.
    """
    gain: Floats | None = None
    if references.by_mirror:
        if position is None:
            raise PoseError("the white frame was taken at rest (by_mirror), which needs the lines' mirror positions")
        at = np.asarray(position, np.float64)
        known = np.hypot(*at.T) <= 1 + RIM_SLACK["float64"]
        gain = np.full(len(at), np.nan)
        gain[known] = 1 / mirror_throughput(at[known])
    if references.exposure_ms is not None:
        if exposure_ms is None:
            raise ShapeError("the white frame has its own exposure, which needs those of the lines")
        exposed = np.asarray(exposure_ms, np.float64)
        known = np.isfinite(exposed) & (exposed > 0)
        ratio = np.divide(references.exposure_ms, exposed, where=known, out=np.full(exposed.shape, np.nan))
        gain = ratio if gain is None else gain * ratio
    return None if gain is None else gain.astype(np.float32)


def _scene_values(raw: NDArray[np.integer[Any]], elements: Elements, line_gain: Floats32 | None) -> Floats32:
    from spectralzoom.pipeline.signal import compiled_loops

    fill = elements.fill
    dark, gain = (np.ascontiguousarray(frame, np.float32) for frame in (elements.references.dark, elements.gain))
    gains = np.ones(len(raw), np.float32) if line_gain is None else line_gain
    if raw.dtype == np.uint16:
        values = np.empty(raw.shape, np.float32)
        compiled_loops.calibrate_lines(np.ascontiguousarray(raw), dark, gain, gains, values)
    else:  # sums of binned samples, and numbers with parts
        values = (raw.astype(np.float32) - dark) * gain * gains[:, None, None]
    if len(fill.element):
        flat = values.reshape(len(values), -1)
        before = flat[:, fill.before]
        flat[:, fill.element] = before + (flat[:, fill.after] - before) * fill.fraction
    return values


def _valid(raw: NDArray[np.integer[Any]], elements: Elements, saturated_dn: float) -> Bools:
    """Return (line, sample), or (line, sample, band) where only some bands of a sample are out."""
    fill = elements.fill
    bad = elements.out[None]
    if raw.size and raw.max() >= saturated_dn:
        hot = (raw >= saturated_dn) & elements.lit
        if len(fill.element):
            flat = hot.reshape(len(hot), -1)
            flat[:, fill.element] = flat[:, fill.before] | flat[:, fill.after]
        bad = hot | elements.out
    whole = np.all(bad | ~elements.lit, axis=-1)  # every band with light is out
    valid = ~(bad | whole[..., None]) if (bad.any(axis=-1) & ~whole).any() else ~whole
    return np.array(np.broadcast_to(valid, raw.shape[: valid.ndim]))


def _judged(raw: NDArray[np.integer[Any]], references: References | Elements) -> Elements:
    """Return the judged elements, if the references fit the lines."""
    plain = references.references if isinstance(references, Elements) else references
    if raw.ndim != 3:
        raise ShapeError(f"expected raw lines (line, sample, band), got {raw.shape}")
    for name in ("dark", "white", "bad"):
        frame = getattr(plain, name)
        if frame is not None and frame.shape != raw.shape[1:]:
            raise ShapeError(
                f"the lines have {raw.shape[1]} samples and {raw.shape[2]} bands, the {name} frame {frame.shape}; "
                "take references with the binning and the bands of the sweep"
            )
    if plain.white_reference.shape != raw.shape[2:]:
        raise ShapeError(f"the lines have {raw.shape[2]} bands, the white reference {plain.white_reference.shape}")
    return references if isinstance(references, Elements) else judge_elements(references)


def find_bad_elements(dark: NDArray[np.floating], white: NDArray[np.floating]) -> Bools:
    """Find unreliable elements (sample, band) of the detector from mean dark and white frames [DN].

    An element is bad if a frame is not finite there, or if its dark level is above those of its band (hot). So is one
    that hardly responds although its neighbours do (dead). An odd element differs from its neighbours in the band by
    more than its column does in most bands. Dust on the slit darkens a column in all bands and is no fault, since the
    white frame corrects it. Nor is a slope, as at the slit's ends. Responses are not judged where the neighbours see no
    light.

    Spreads are medians of absolute deviations. With fewer than 7 samples no element is odd. A frame of one sample has
    bad elements only where it is not finite.

    Raises ShapeError: the frames are not (sample, band), or not of one size. Raises RigError: more than 5 % of the
    elements, and more than one column, would be bad.
    """
    if dark.ndim != 2 or dark.shape != white.shape:
        raise ShapeError(
            f"expected dark and white frames (sample, band) of one size, got {dark.shape} and {white.shape}"
        )
    low, high = np.asarray(dark, np.float64), np.asarray(white, np.float64)
    bad = ~(np.isfinite(low) & np.isfinite(high))
    low = np.where(bad, np.nan, low)
    above = low - _median(low, axis=0)
    noise = np.maximum(SIGMA_OF_MEDIAN * _median(np.abs(above), axis=0), LEAST_NOISE_DN)
    bad |= above > HOT_SIGMAS * noise
    bad |= _off_neighbours(np.where(bad, np.nan, high - low), noise)
    if np.count_nonzero(bad) > max(MOST_BAD * bad.size, bad.shape[1]):
        raise RigError(
            f"{100 * bad.mean():.1f} % of the elements look bad, at most {100 * MOST_BAD:g} % can be; is the white "
            "frame lit evenly along the slit and the dark one taken with the same exposure? Take both again"
        )
    return bad


def check_frames(
    where: str, dark: NDArray[np.floating], white: NDArray[np.floating], full_scale_dn: float | None = None
) -> list[str]:
    """Return a note where elements of a white frame are at the full scale of a converter; ``where`` begins messages.

    This is that of the camera, or the largest number of 8 to 16 bits. Raises SceneError: the white frame has no light
    beside the dark one, as where they are exchanged.
    """
    known = np.isfinite(white) & np.isfinite(dark)
    light = np.subtract(white, dark, where=known, out=np.zeros(white.shape))
    if not np.maximum(light, 0).sum() > LEAST_LIGHT * np.maximum(-light, 0).sum():
        brighter = 100 * np.mean(light > 0)
        raise SceneError(
            f"{where}the white frame is not brighter than the dark one ({brighter:.0f} % of its elements are); "
            "exchange them if they are swapped, or give others"
        )
    most = float(white[known].max())
    scales = [*(2.0**bits - 1 for bits in range(8, 17)), *([] if full_scale_dn is None else [full_scale_dn])]
    if not any(abs(most - scale) < 0.5 for scale in scales):
        return []
    full = 100 * float(np.mean(white[known] >= most - 0.5))
    what = f"{where}the white frame is at full scale ({most:g} DN) in {full:.3g} % of the elements"
    return [f"{what}: if it is saturated, values there are too high, and a darker one is needed"]


def _off_neighbours(response: Floats, noise: Floats) -> Bools:
    """Return elements whose response is missing or odd beside their neighbours'."""
    size = min(WINDOW, len(response))
    around = (max(size - 1 + size % 2, 1), 1)  # an odd number of samples
    filled = np.where(np.isfinite(response), response, np.nan_to_num(_median(response, axis=0)))  # median of the band
    local: Floats = scipy.ndimage.median_filter(filled, around, mode="reflect")
    least = np.maximum(LIT_SIGMAS * noise, LIT_FRACTION * _median(response, axis=0))
    judged = np.isfinite(response) & (local > least)
    relative = np.full(response.shape, np.nan)
    np.divide(response, local, out=relative, where=judged)
    dead = judged & (relative < LEAST_RESPONSE)
    off = np.where(dead, np.nan, relative - 1)
    if response.shape[1] >= BANDS_FOR_COLUMN:
        off -= _median(off, axis=1)
    spread = SIGMA_OF_MEDIAN * _median(np.abs(off), axis=0)
    if len(response) < NEAR:
        return dead
    # Beyond the nearest neighbours as well; two odd elements side by side do not hide each other.
    low, high = (scipy.ndimage.rank_filter(filled, rank, (NEAR, 1), mode="reflect") for rank in (2, -3))
    beyond = (response < low * (1 - ODD_FRACTION)) | (response > high * (1 + ODD_FRACTION))
    odd: Bools = (np.abs(off) > ODD_SIGMAS * spread) & beyond
    return dead | odd


def _median(values: Floats, axis: int) -> Floats:
    """Return the median of what is not NaN, the axis kept; NaN without a value, and without a warning."""
    ordered = np.sort(values, axis=axis)  # NaN last
    count = np.count_nonzero(~np.isnan(values), axis=axis, keepdims=True)
    if not values.shape[axis]:
        return np.full(count.shape, np.nan)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis)
    middle: Floats = (low + np.take_along_axis(ordered, np.minimum(count // 2, values.shape[axis] - 1), axis)) / 2
    return np.where(count > 0, middle, np.nan)

"""Calibration: what the references say of each element of a detector, raw DN to scene values, and what may be used."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import PoseError, ShapeError
from pipeline.geometry.mirror import mirror_throughput
from pipeline.source import References

BLOCK_ELEMENTS = 1 << 18  # 1 MB of float32: cast, subtraction and product meet the block in the cache
FILL_REACH = 8  # samples; what is good farther away has seen something else

Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Fill:
    """Elements to be filled, ascending, and the good ones they are filled from, (n,) as indices of a flat frame."""

    element: NDArray[np.intp]
    before: NDArray[np.intp]
    after: NDArray[np.intp]
    fraction: Floats32  # of ``after``

    def among(self, first: int, stop: int) -> Fill:
        """Return the part from element ``first`` to before ``stop``."""
        here = slice(*np.searchsorted(self.element, (first, stop)))
        return Fill(self.element[here], self.before[here], self.after[here], self.fraction[here])


@dataclass(frozen=True)
class Elements:
    """The elements of a detector as all of its references judge them, or those of some samples, judged no differently.

    Whether a band has light at all, whether most of a sample's bands are bad and what a bad element is filled from is
    decided once for the whole line: some samples by themselves would say otherwise than others.
    """

    references: References
    gain: Floats32  # (sample, band), NaN where an element has no calibration
    out: Bools  # (sample, band) not valid on any line
    lit: Bools  # (band,) at least one sample of the whole line has a calibration
    fill: Fill

    def alone(self, samples: slice) -> slice:
        """Grow a run of samples by those that its bad elements are filled from, at most 8 at either end."""
        bands = len(self.lit)
        here = self.fill.among(samples.start * bands, samples.stop * bands)
        if not len(here.element):
            return samples
        first, last = int(here.before.min()) // bands, int(here.after.max()) // bands
        return slice(min(samples.start, first), max(samples.stop, last + 1))

    def part(self, samples: slice) -> Elements:
        """Some samples; of their bad elements those that are filled from beyond them are out."""
        bands = len(self.lit)
        first, stop = samples.start * bands, samples.stop * bands
        fill, out = self.fill.among(first, stop), self.out[samples]
        within = (fill.before >= first) & (fill.after < stop)
        if not within.all():
            out = out.copy()
            out.flat[fill.element[~within] - first] = True
        element, before, after = (at[within] - first for at in (fill.element, fill.before, fill.after))
        kept = Fill(element, before, after, fill.fraction[within])
        whole = self.references
        references = replace(
            whole,
            dark=whole.dark[samples],
            white=whole.white[samples],
            bad=None if whole.bad is None else whole.bad[samples],
            flat=None if whole.flat is None else whole.flat[samples],
        )
        return Elements(references, self.gain[samples], out, self.lit, kept)


def judge_elements(references: References) -> Elements:
    """Say of each element what it is worth: its gain, whether it is out, what it is filled from.

    Out are elements without a calibration, bad ones without a good one of their band within 8 samples, and whole
    samples in which more than half of the bands are bad or without a calibration. A band that no sample is calibrated
    in does not count, and nothing in it is out.
    """
    span = references.white - references.dark
    if references.flat is not None:
        span = np.where(references.flat > 0, span * references.flat, np.nan)
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
    gain[~trusted] = np.nan  # what overflowed, and what is bad: those that are filled are written over
    return Elements(references, gain, out, lit, fill)


def number_values(references: References) -> NDArray[np.float64]:
    """Scene value of one number of the camera, (band,): the median over the samples; NaN of bands without light."""
    gain, known = judge_elements(references).gain.astype(np.float64), np.full(references.dark.shape[1], np.nan)
    lit = np.isfinite(gain).any(axis=0)
    known[lit] = np.abs(np.nanmedian(gain[:, lit], axis=0))
    return known


def _fill_of(wanted: Bools, good: Bools) -> Fill:
    """Find the good neighbours of each wanted element in its band; an element without any near enough is left out."""
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


def reflectance(
    raw: NDArray[np.integer[Any]], references: References, *, position: ArrayLike | None = None
) -> Floats32:
    """Turn raw lines into scene values, ``(raw - dark) / (white - dark) * white_reference / flat / throughput``.

    A bad element takes the value between the nearest good samples of its line and band, at most 8 away, linear in
    sample, so that it spoils only itself; in a sample with more than half of its bands bad none is filled.

    ``raw`` is (line, sample, band) uint16 DN; ``position`` (line, 2) mirror X and Y, needed where the references say
    ``by_mirror``: a line whose position is not finite becomes NaN there. (line, sample, band) float32 in the unit of
    the white reference's values, negative below dark; NaN where the white frame is not above the dark one, a reference
    is not finite, or a bad element is not filled.

    Raises ShapeError: the references or the positions do not fit the lines.
    Raises PoseError: positions are needed and missing, or one lies beyond the mirror's rim.
    """
    elements = _judged(raw, references)
    return _scene_values(raw, elements, _line_gain(raw, references, position))


def calibrate(
    raw: NDArray[np.integer[Any]],
    references: References | Elements,
    *,
    saturated_dn: float,
    position: ArrayLike | None = None,
) -> tuple[Floats32, Bools]:
    """Turn raw lines into scene values, as :func:`reflectance` does, and say which of them may be used.

    Out are what :func:`judge_elements` puts out, saturated elements, and filled
    ones whose neighbours are saturated. A band that no sample is calibrated in (no light at all) puts nothing out: it
    stays NaN everywhere, on its own. Where every band is like that nothing is valid.

    Of a sum of n samples (the coarse pass) DN tell less than of one. Let F be full scale: at n F all of them were
    saturated, above n (F - 1) one of them at least was, below F none was, and between nothing can be known. By how
    much a sum is short is not known either, so it is no fault that shows as noise: a small bright thing beside dark
    soil loses its peak unseen. ``saturated_dn`` is the least DN that counts: n F, or n (F - 1) + 1.

    The references are those of the whole line; or elements judged already, where ``raw`` holds some of the samples or
    for the sake of time. Values (line, sample, band) float32, and bool of which are valid: (line, sample), or (line,
    sample, band) where some but not all bands of a sample are out.
    """
    elements = _judged(raw, references)
    line_gain = _line_gain(raw, elements.references, position)
    values = _scene_values(raw, elements, line_gain)
    valid = _valid(raw, elements, saturated_dn)
    if line_gain is not None:
        valid[~np.isfinite(line_gain)] = False
    return values, valid


def of_bands(references: References, bands: Sequence[int]) -> References:
    """The references of some bands, in the order given."""
    chosen = list(bands)
    return replace(
        references,
        dark=references.dark[:, chosen],
        white=references.white[:, chosen],
        white_reference=references.white_reference[chosen],
        bad=None if references.bad is None else references.bad[:, chosen],
        flat=None if references.flat is None else references.flat[:, chosen],
    )


def _line_gain(raw: NDArray[np.integer[Any]], references: References, position: ArrayLike | None) -> Floats32 | None:
    """One over the mirror's throughput of each line, (line,), where the references ask for it."""
    if not references.by_mirror:
        return None
    if position is None:
        raise PoseError("the white frame was taken at rest (by_mirror), which needs the lines' mirror positions")
    at = np.asarray(position, np.float64)
    if at.shape != (len(raw), 2):
        raise ShapeError(f"expected a mirror position (X, Y) for each of {len(raw)} lines, got shape {at.shape}")
    known = np.isfinite(at).all(axis=1)
    gain = np.full(len(at), np.nan, np.float32)
    gain[known] = 1 / mirror_throughput(at[known])
    return gain


def _blocks(raw: NDArray[np.integer[Any]]) -> Iterator[slice]:
    lines = max(1, BLOCK_ELEMENTS // max(raw[0].size, 1)) if len(raw) else 1
    return (slice(first, first + lines) for first in range(0, len(raw), lines))


def _scene_values(raw: NDArray[np.integer[Any]], elements: Elements, line_gain: Floats32 | None) -> Floats32:
    values = np.empty(raw.shape, np.float32)
    dark, fill = elements.references.dark, elements.fill
    for block in _blocks(raw):
        part = values[block]
        part[...] = raw[block]
        part -= dark
        part *= elements.gain
        if line_gain is not None:
            part *= line_gain[block, None, None]
        if len(fill.element):
            flat = part.reshape(len(part), -1)
            before = flat[:, fill.before]
            flat[:, fill.element] = before + (flat[:, fill.after] - before) * fill.fraction
    return values


def _valid(raw: NDArray[np.integer[Any]], elements: Elements, saturated_dn: float) -> Bools:
    """(line, sample), or (line, sample, band) where only some bands of a sample are out."""
    out, lit = elements.out, elements.lit
    found = [_saturated(raw, block, elements, saturated_dn) for block in _blocks(raw)]
    line, sample = (np.concatenate([np.zeros(0, np.intp), *(part[k] for part in found)]) for k in (0, 1))
    hot = np.concatenate([out[:0], *(part[2] for part in found)]) | out[sample]
    whole, whole_hot = (np.all(mask | ~lit, axis=-1) for mask in (out, hot))  # every band with light is out
    if np.any(out.any(axis=-1) & ~whole) or np.any(hot.any(axis=-1) & ~whole_hot):  # some but not all bands of a sample
        valid = np.empty(raw.shape, np.bool_)
        valid[...] = ~(out | whole[:, None])
        valid[line, sample] = ~(hot | whole_hot[:, None])
    else:
        valid = np.empty(raw.shape[:2], np.bool_)
        valid[...] = ~whole
        valid[line, sample] = ~whole_hot
    return valid


def _saturated(
    raw: NDArray[np.integer[Any]], block: slice, elements: Elements, saturated_dn: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], Bools]:
    """Lines and samples with elements at or above the limit, or filled from them, and which, (n, band)."""
    part = raw[block]
    if not part.size or part.max() < saturated_dn:
        nothing = np.zeros(0, np.intp)
        return nothing, nothing, elements.out[:0]
    hot = part >= saturated_dn
    hot &= elements.lit
    fill = elements.fill
    if len(fill.element):
        flat = hot.reshape(len(hot), -1)
        flat[:, fill.element] = flat[:, fill.before] | flat[:, fill.after]
    line, sample = np.nonzero(hot.any(axis=2))
    return line + block.start, sample, hot[line, sample]


def _judged(raw: NDArray[np.integer[Any]], references: References | Elements) -> Elements:
    """Elements judged already or now, once they are known to fit the lines."""
    plain = references.references if isinstance(references, Elements) else references
    if raw.ndim != 3:
        raise ShapeError(f"expected raw lines (line, sample, band), got {raw.shape}")
    for name in ("dark", "white", "bad", "flat"):
        frame = getattr(plain, name)
        if frame is not None and frame.shape != raw.shape[1:]:
            raise ShapeError(
                f"the lines have {raw.shape[1]} samples and {raw.shape[2]} bands, the {name} frame {frame.shape}; "
                "take references with the binning and the bands of the sweep"
            )
    if plain.white_reference.shape != raw.shape[2:]:
        raise ShapeError(f"the lines have {raw.shape[2]} bands, the white reference {plain.white_reference.shape}")
    return references if isinstance(references, Elements) else judge_elements(references)

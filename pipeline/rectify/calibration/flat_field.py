"""Elements: what the references alone say of each element of a detector, the same on every line."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.source import References

FILL_REACH = 8  # samples; what is good farther away has seen something else

Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Fill:
    """Elements to be filled, ascending, and the good ones they are filled from, (n,) as indices of a flat frame."""

    element: NDArray[np.intp]
    before: NDArray[np.intp]
    after: NDArray[np.intp]
    share: Floats32  # of ``after``

    def among(self, first: int, stop: int) -> Fill:
        """Those whose elements lie from ``first`` to before ``stop``."""
        here = slice(*np.searchsorted(self.element, (first, stop)))
        return Fill(self.element[here], self.before[here], self.after[here], self.share[here])


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
        kept = Fill(element, before, after, fill.share[within])
        return Elements(_of_samples(self.references, samples), self.gain[samples], out, self.lit, kept)


def judge_elements(references: References) -> Elements:
    """Say of each element what it is worth: its gain, whether it is out, what it is filled from.

    Out are elements without a calibration, bad ones without a good one of their band within 8 samples, and whole
    samples in which more than half of the bands are bad or without a calibration. A band that no sample is calibrated
    in does not count, and nothing in it is out.
    """
    gain = _gain(references)
    bad = np.zeros(gain.shape, np.bool_) if references.bad is None else references.bad
    trusted = np.isfinite(gain) & ~bad
    lit = np.asarray(trusted.any(axis=0))
    lost = ~trusted & lit
    out: Bools = np.logical_or(lost, 2 * lost.sum(axis=1, keepdims=True) > lit.sum())
    fill = _fill_of(bad & lit & ~out.all(axis=1, keepdims=True), trusted & ~out)
    out.flat[fill.element] = False
    gain[~trusted] = np.nan  # what overflowed, and what is bad: those that are filled are written over
    return Elements(references, gain, out, lit, fill)


def _gain(references: References) -> Floats32:
    span = references.white - references.dark
    if references.flat is not None:
        span = np.where(references.flat > 0, span * references.flat, np.nan)
    gain = np.full(span.shape, np.nan, np.float32)
    known = np.isfinite(span) & (span > 0)
    with np.errstate(over="ignore"):
        np.divide(np.broadcast_to(references.panel, span.shape), span, out=gain, where=known)
    return gain


def _fill_of(wanted: Bools, good: Bools) -> Fill:
    """Where each wanted element finds its good neighbours of the same band; without any near enough it is left out."""
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
    share = (sample - before) / np.maximum(after - before, 1)
    return Fill(sample * width + band, before * width + band, after * width + band, share.astype(np.float32))


def _of_samples(references: References, samples: slice) -> References:
    return replace(
        references,
        dark=references.dark[samples],
        white=references.white[samples],
        bad=None if references.bad is None else references.bad[samples],
        flat=None if references.flat is None else references.flat[samples],
    )

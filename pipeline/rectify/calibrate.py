"""Calibration: raw DN to scene values by the references, and which elements of which lines may be used."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import PoseError, ShapeError
from pipeline.mirror import mirror_throughput
from pipeline.source import References

Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]

BLOCK_ELEMENTS = 1 << 18  # 1 MB of float32: cast, subtraction and product meet the block in the cache


def reflectance(raw: NDArray[np.uint16], references: References, *, position: ArrayLike | None = None) -> Floats32:
    """Turn raw lines into scene values, ``(raw - dark) / (white - dark) * panel / flat / throughput``.

    A bad element takes the value between the nearest good samples of its line and band, linear in sample, so that it
    spoils only itself; a sample with more than half of its bands bad is left as it is.

    Parameters
    ----------
    raw
        (line, sample, band) uint16 DN.
    references
        Frames with the binning of ``raw``.
    position
        (line, 2) mirror X and Y; needed where the references say ``by_mirror``. A line whose position is not finite
        becomes NaN there.

    Returns
    -------
    (line, sample, band) float32, unit of the panel's values, negative below dark; NaN where the white frame is not
    above the dark one, a reference is not finite, or a bad element has no good one beside it.

    Raises
    ------
    ShapeError : the references or the positions do not fit the lines.
    PoseError : positions are needed and missing, or one lies beyond the mirror's rim.
    """
    _check_references(raw, references)
    return _scene_values(raw, references, _standing(references), _line_gain(raw, references, position))


def calibrate(
    raw: NDArray[np.uint16], references: References, *, saturated_dn: float, position: ArrayLike | None = None
) -> tuple[Floats32, Bools]:
    """Turn raw lines into scene values and say which of them may be used.

    Out are saturated elements and those without a calibration, whole samples with more than half of their bands bad,
    and filled elements whose neighbours are saturated. A band that no sample is calibrated in (no light at all) puts
    nothing out: it stays NaN everywhere, on its own. Where every band is like that nothing is valid.

    Of a sum of n samples (the coarse pass) DN tell less than of one. Let F be full scale: at n F all of them were
    saturated, above n (F - 1) one of them at least was, below F none was, and between nothing can be known. By how
    much a sum is short is not known either, so it is no fault that shows as noise: a small bright thing beside dark
    soil loses its peak unseen.

    Parameters
    ----------
    raw, references, position
        As of :func:`reflectance`.
    saturated_dn
        Least DN that counts as saturated, for the binning of ``raw``: n times full scale finds sums saturated
        throughout, n times one less and 1 those known to be saturated in part.

    Returns
    -------
    Values (line, sample, band) float32 as of :func:`reflectance`, and bool of which are valid: (line, sample), or
    (line, sample, band) where some but not all bands of a sample are out.

    Raises
    ------
    ShapeError, PoseError : as of :func:`reflectance`.
    """
    _check_references(raw, references)
    standing = _standing(references)
    line_gain = _line_gain(raw, references, position)
    values = _scene_values(raw, references, standing, line_gain)
    valid = _valid(raw, standing, saturated_dn)
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
        panel=references.panel[chosen],
        bad=None if references.bad is None else references.bad[:, chosen],
        flat=None if references.flat is None else references.flat[:, chosen],
    )


@dataclass(frozen=True)
class _Standing:
    """What the references alone decide, the same on every line. All (sample, band) but ``lit`` and the fill's parts."""

    gain: Floats32  # NaN where an element has no calibration
    out: Bools  # not valid on any line
    lit: Bools  # (band,) at least one sample has a calibration
    fill: _Fill


@dataclass(frozen=True)
class _Fill:
    """Elements to be filled, and the good ones they are filled from, (n,) as indices of a flattened frame."""

    element: NDArray[np.intp]
    before: NDArray[np.intp]
    after: NDArray[np.intp]
    share: Floats32  # of ``after``


def _standing(references: References) -> _Standing:
    gain = _gain(references)
    bad = np.zeros(gain.shape, np.bool_) if references.bad is None else references.bad
    trusted = np.isfinite(gain) & ~bad
    lit = np.asarray(trusted.any(axis=0))
    lost = ~trusted & lit
    out: Bools = np.logical_or(lost, 2 * lost.sum(axis=1, keepdims=True) > lit.sum())
    if not lit.any():
        out[...] = True
    fill = _fill_of(bad & lit & ~out.all(axis=1, keepdims=True), trusted & ~out)
    out.flat[fill.element] = False
    gain[~trusted] = np.nan  # those that are filled are written over
    return _Standing(gain, out, lit, fill)


def _gain(references: References) -> Floats32:
    span = references.white - references.dark
    if references.flat is not None:
        span = np.where(references.flat > 0, span * references.flat, np.nan)
    gain = np.full(span.shape, np.nan, np.float32)
    known = np.isfinite(span) & (span > 0)
    with np.errstate(over="ignore"):
        np.divide(np.broadcast_to(references.panel, span.shape), span, out=gain, where=known)
    gain[~np.isfinite(gain)] = np.nan
    return gain


def _fill_of(wanted: Bools, good: Bools) -> _Fill:
    """Where each wanted element finds its good neighbours of the same band; without any it is left out."""
    bands = np.flatnonzero(wanted.any(axis=0) & good.any(axis=0))
    samples = len(good)
    number = np.arange(samples)[:, None]
    below = np.maximum.accumulate(np.where(good[:, bands], number, -1), axis=0)
    above = np.minimum.accumulate(np.where(good[:, bands], number, samples)[::-1], axis=0)[::-1]
    sample, column = np.nonzero(wanted[:, bands])
    before, after = below[sample, column], above[sample, column]
    before, after = np.where(before < 0, after, before), np.where(after == samples, before, after)
    share = (sample - before) / np.maximum(after - before, 1)
    band = bands[column]
    width = good.shape[1]
    return _Fill(sample * width + band, before * width + band, after * width + band, share.astype(np.float32))


def _line_gain(raw: NDArray[np.uint16], references: References, position: ArrayLike | None) -> Floats32 | None:
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


def _blocks(raw: NDArray[np.uint16]) -> Iterator[slice]:
    lines = max(1, BLOCK_ELEMENTS // max(raw[0].size, 1)) if len(raw) else 1
    return (slice(first, first + lines) for first in range(0, len(raw), lines))


def _scene_values(
    raw: NDArray[np.uint16], references: References, standing: _Standing, line_gain: Floats32 | None
) -> Floats32:
    values = np.empty(raw.shape, np.float32)
    fill = standing.fill
    for block in _blocks(raw):
        part = values[block]
        part[...] = raw[block]
        part -= references.dark
        part *= standing.gain
        if line_gain is not None:
            part *= line_gain[block, None, None]
        if len(fill.element):
            flat = part.reshape(len(part), -1)
            before = flat[:, fill.before]
            flat[:, fill.element] = before + (flat[:, fill.after] - before) * fill.share
    return values


def _valid(raw: NDArray[np.uint16], standing: _Standing, saturated_dn: float) -> Bools:
    """(line, sample), or (line, sample, band) where only some bands of a sample are out."""
    out, lit = standing.out, standing.lit
    found = [_saturated(raw, block, standing, saturated_dn) for block in _blocks(raw)]
    line, sample = (np.concatenate([np.zeros(0, np.intp), *(part[k] for part in found)]) for k in (0, 1))
    hot = np.concatenate([out[:0], *(part[2] for part in found)]) | out[sample]
    whole, whole_hot = _sample_out(out, lit), _sample_out(hot, lit)
    if _is_parted(out, whole) or _is_parted(hot, whole_hot):
        valid = np.empty(raw.shape, np.bool_)
        valid[...] = ~(out | whole[:, None])
        valid[line, sample] = ~(hot | whole_hot[:, None])
    else:
        valid = np.empty(raw.shape[:2], np.bool_)
        valid[...] = ~whole
        valid[line, sample] = ~whole_hot
    return valid


def _saturated(
    raw: NDArray[np.uint16], block: slice, standing: _Standing, saturated_dn: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], Bools]:
    """Lines and samples with elements at or above the limit, or filled from them, and which, (n, band)."""
    part = raw[block]
    if not part.size or part.max() < saturated_dn:
        nothing = np.zeros(0, np.intp)
        return nothing, nothing, standing.out[:0]
    hot = part >= saturated_dn
    hot &= standing.lit
    fill = standing.fill
    if len(fill.element):
        flat = hot.reshape(len(hot), -1)
        flat[:, fill.element] = flat[:, fill.before] | flat[:, fill.after]
    line, sample = np.nonzero(hot.any(axis=2))
    return line + block.start, sample, hot[line, sample]


def _sample_out(out: Bools, lit: Bools) -> Bools:
    """Samples of which every band with light is out, (..., sample)."""
    whole: Bools = np.all(out | ~lit, axis=-1)
    return whole


def _is_parted(out: Bools, whole: Bools) -> bool:
    """Whether some but not all bands of a sample are out."""
    return bool(np.any(out.any(axis=-1) & ~whole))


def _check_references(raw: NDArray[np.uint16], references: References) -> None:
    if raw.ndim != 3:
        raise ShapeError(f"expected raw lines (line, sample, band), got {raw.shape}")
    for name in ("dark", "white", "bad", "flat"):
        frame = getattr(references, name)
        if frame is not None and frame.shape != raw.shape[1:]:
            raise ShapeError(
                f"the lines have {raw.shape[1]} samples and {raw.shape[2]} bands, the {name} frame {frame.shape}; "
                "take references with the binning and the bands of the sweep"
            )
    if references.panel.shape != raw.shape[2:]:
        raise ShapeError(f"the lines have {raw.shape[2]} bands, the panel {references.panel.shape}")

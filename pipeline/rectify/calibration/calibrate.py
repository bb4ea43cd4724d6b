"""Calibration: raw DN to scene values by the references, and which elements of which lines may be used."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import PoseError, ShapeError
from pipeline.geometry.mirror import mirror_throughput
from pipeline.rectify.calibration.flat_field import Bools, Elements, Floats32, judge_elements
from pipeline.source import References

BLOCK_ELEMENTS = 1 << 18  # 1 MB of float32: cast, subtraction and product meet the block in the cache


def reflectance(raw: NDArray[np.uint16], references: References, *, position: ArrayLike | None = None) -> Floats32:
    """Turn raw lines into scene values, ``(raw - dark) / (white - dark) * panel / flat / throughput``.

    A bad element takes the value between the nearest good samples of its line and band, at most 8 away, linear in
    sample, so that it spoils only itself; in a sample with more than half of its bands bad none is filled.

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
    above the dark one, a reference is not finite, or a bad element is not filled.

    Raises
    ------
    ShapeError : the references or the positions do not fit the lines.
    PoseError : positions are needed and missing, or one lies beyond the mirror's rim.
    """
    elements = _judged(raw, references)
    return _scene_values(raw, elements, _line_gain(raw, references, position))


def calibrate(
    raw: NDArray[np.uint16],
    references: References | Elements,
    *,
    saturated_dn: float,
    position: ArrayLike | None = None,
) -> tuple[Floats32, Bools]:
    """Turn raw lines into scene values and say which of them may be used.

    Out are what :func:`pipeline.rectify.calibration.flat_field.judge_elements` puts out, saturated elements, and filled
    ones whose neighbours are saturated. A band that no sample is calibrated in (no light at all) puts nothing out: it
    stays NaN everywhere, on its own. Where every band is like that nothing is valid.

    Of a sum of n samples (the coarse pass) DN tell less than of one. Let F be full scale: at n F all of them were
    saturated, above n (F - 1) one of them at least was, below F none was, and between nothing can be known. By how
    much a sum is short is not known either, so it is no fault that shows as noise: a small bright thing beside dark
    soil loses its peak unseen.

    Parameters
    ----------
    raw, position
        As of :func:`reflectance`.
    references
        Of the whole line; or elements judged already, where ``raw`` holds some of the samples or for the sake of time.
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
        panel=references.panel[chosen],
        bad=None if references.bad is None else references.bad[:, chosen],
        flat=None if references.flat is None else references.flat[:, chosen],
    )


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


def _scene_values(raw: NDArray[np.uint16], elements: Elements, line_gain: Floats32 | None) -> Floats32:
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
            flat[:, fill.element] = before + (flat[:, fill.after] - before) * fill.share
    return values


def _valid(raw: NDArray[np.uint16], elements: Elements, saturated_dn: float) -> Bools:
    """(line, sample), or (line, sample, band) where only some bands of a sample are out."""
    out, lit = elements.out, elements.lit
    found = [_saturated(raw, block, elements, saturated_dn) for block in _blocks(raw)]
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
    raw: NDArray[np.uint16], block: slice, elements: Elements, saturated_dn: float
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


def _sample_out(out: Bools, lit: Bools) -> Bools:
    """Samples of which every band with light is out, (..., sample)."""
    whole: Bools = np.all(out | ~lit, axis=-1)
    return whole


def _is_parted(out: Bools, whole: Bools) -> bool:
    """Whether some but not all bands of a sample are out."""
    return bool(np.any(out.any(axis=-1) & ~whole))


def _judged(raw: NDArray[np.uint16], references: References | Elements) -> Elements:
    if isinstance(references, Elements):
        _check_references(raw, references.references)
        return references
    _check_references(raw, references)
    return judge_elements(references)


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

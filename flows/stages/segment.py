"""Segment the mosaic into a class map and class probabilities, with the prior map of the field."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spectralzoom.flows.frame import Prior
from spectralzoom.flows.stage import Output, stage
from spectralzoom.flows.stages.drawing import Drawing, FullReading, draw_field
from spectralzoom.flows.stages.overview import OVERVIEWS
from spectralzoom.flows.stages.score import READING, PatchGains, load_plan
from spectralzoom.models.evaluation.unlike_scenes import TrainingSpectra
from spectralzoom.models.reading.prior_map import TemporalAgreement
from spectralzoom.models.weights.files import ReaderPart
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.arrays.class_maps import (
    MAP,
    NOT_BELIEVED,
    OLD_CLASS,
    PROBABILITIES,
    ClassNames,
    create_class_map,
    create_probabilities,
)
from spectralzoom.storage.arrays.layout import NO_CLASS, blank_pixels
from spectralzoom.storage.arrays.mosaics import Attention, write_attention
from spectralzoom.storage.store import Ref, write_table

SPECTRA = "spectra.json"  # beside a map: pixels out of range, and distances from the training spectra
PRIOR_FIGURES = "prior_map.json"  # beside a map: the figures of its prior map
MADE_BY = (
    "models/network",
    "models/reading",
    "models/weights",
    "storage/arrays/class_maps.py",
    "models/evaluation/unlike_scenes.py",
)


@stage("class map", version=30, made_by=MADE_BY)
def segment(
    out: Output,
    mosaic: Ref,
    attention: Ref,
    overview: Ref | None,
    *earlier: Ref,
    gains: PatchGains,
    prior: Prior | None,
    reader: ReaderPart | None,
    part: bool,
    least_gain: float | None,
    spectra: TrainingSpectra | None,
) -> None:
    """Segment the mosaic region by region, at full resolution where patches were chosen; nodata pixels have no class.

    ``earlier`` are the stores of ``prior``. With ``least_gain``, patches are chosen here, by their expected gain.
    ``overview`` is that of the first pass, or of the same mosaic: it is read again around new lines.
    Writes class map and class probabilities, and the figures of the prior map.
    """
    work = gains.work
    names = create_maps(out.path, gains, goes_on=prior is not None)
    drawing = Drawing(work.weights, mosaic, attention, gains.capture, prior, gains.zones.left_out, part, spectra)
    known = None if overview is None else (overview.path / OVERVIEWS, load_plan(attention).changed)
    drawn = draw_field(work, drawing, out.path, least_gain, out.report, known)
    if prior is not None and drawn.comparison is not None:
        write_table(out.path / PRIOR_FIGURES, _prior_map_figures(prior, reader, names, drawn.comparison))
    if drawn.reading is not None:
        write_attention(out.path / READING, attention_of(drawn.reading, gains.policy))
    far = None if spectra is None or drawn.spectra is None else spectra.distances(drawn.spectra)
    write_table(out.path / SPECTRA, {"out_of_range_px": drawn.unread_px, "distances": far})
    finish_maps(out.path, gains, compared=drawn.comparison is not None)


def create_maps(path: Path, gains: PatchGains, *, goes_on: bool) -> tuple[str, ...]:
    """Create empty stores of class map and class probabilities; return the names of the classes."""
    frame = gains.frame
    shape = (frame.grid.height, frame.grid.width)
    weights = gains.work.weights.load()
    legend = ClassNames(weights.class_names, weights.class_colours, weights.class_values)
    create_class_map(path / MAP, shape, legend, grid=frame.angular_grid())
    create_probabilities(path / PROBABILITIES, shape, legend, grid=frame.angular_grid(), goes_on=goes_on)
    return legend.names


def finish_maps(path: Path, gains: PatchGains, *, compared: bool) -> None:
    """Blank nodata and pixels outside of zones."""
    if gains.frame.missing is not None:
        blank_pixels(path / MAP, gains.frame.missing, NO_CLASS)
        blank_pixels(
            path / PROBABILITIES, gains.frame.missing, NOT_BELIEVED | ({OLD_CLASS: UNLABELLED} if compared else {})
        )
    if gains.zones.left_out is not None:
        blank_pixels(path / MAP, gains.zones.left_out, NO_CLASS)


def attention_of(reading: FullReading, policy: str) -> Attention:
    """Return expected gain and rank of the patches that the full network read during segmentation."""
    count = int(np.count_nonzero(reading.read))
    best = np.argsort(np.where(reading.read, -reading.gain, np.inf).ravel(), kind="stable")
    rank = np.full(reading.gain.size, -1, np.int32)
    rank[best[:count]] = np.arange(count)
    return Attention(reading.gain, rank.reshape(reading.gain.shape), policy)


def _prior_map_figures(
    prior: Prior, reader: ReaderPart | None, names: Sequence[str], comparison: TemporalAgreement
) -> dict[str, Any]:
    """Return the figures of a prior map: agreement with this visit, and pixels that changed from class to class.

    Changed pixels exceed the expected difference of two maps of the same ground; all differing pixels are counted too.
    """
    beyond = comparison.beyond
    pairs = [
        (int(beyond[old, new]), int(comparison.changed[old, new]), names[old], names[new])
        for old, new in np.argwhere(beyond)
    ]
    compared = int(comparison.changed.sum())
    return {
        "days": prior.days,
        "reader": "none" if reader is None else reader.key,
        "agreement": None if np.isnan(comparison.agreement) else comparison.agreement,
        "compared_px": compared,
        "differing_px": compared - int(np.trace(comparison.changed)),
        "expected_differing_px": round(float(comparison.expected.sum() - np.trace(comparison.expected))),
        "changed_px": sum(one for one, _, _, _ in pairs),
        "changes": [list(pair) for pair in sorted(pairs, reverse=True)],
    }

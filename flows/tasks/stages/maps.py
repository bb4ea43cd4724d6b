"""Define the stages that segment the mosaic, with the prior map of the field, and project the map to the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.tasks.drawing import MAP, PROBABILITIES, Drawing, FullReading, draw_field
from spectralzoom.flows.tasks.field_work import region_params
from spectralzoom.flows.tasks.prior_maps import PRIOR_FIGURES, Prior
from spectralzoom.flows.tasks.stage import Product, Report, Wanted, stage
from spectralzoom.flows.tasks.stages.attention import READING, PatchGains
from spectralzoom.models.reading.prior_map import TemporalAgreement
from spectralzoom.models.weights.files import ReaderPart
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.field_places import PosedField, areas_by_number
from spectralzoom.pipeline.ground.map_grid import GroundGrid, image_at, map_blocks, nearest_at
from spectralzoom.storage.arrays.class_maps import (
    NOT_BELIEVED,
    OLD_CLASS,
    ClassNames,
    ProbabilityStore,
    create_class_map,
    create_probabilities,
    load_class_map,
)
from spectralzoom.storage.arrays.ground_maps import BLOCK, GroundMapWriter
from spectralzoom.storage.arrays.layout import NO_CLASS, blank_pixels
from spectralzoom.storage.arrays.mosaics import Attention, choose_bands, develop, open_mosaic, write_attention
from spectralzoom.storage.store import Ref, write_table

CLASS_MAP = Product("segment", version=27, files=(MAP, PROBABILITIES), by_weights=True)
SPECTRA = "spectra.json"  # beside a map: pixels out of range, and patches unlike the training data


@stage("segment", "class map", CLASS_MAP)
def segment(
    mosaic: Ref,
    attention: Ref,
    *,
    gains: PatchGains,
    prior: Prior | None,
    reader: ReaderPart | None,
    part: bool,
    least_gain: float | None,
    model_key: dict[str, Any],
    report: Report,
) -> Wanted:
    """Segment the mosaic region by region, at full resolution where patches were chosen; nodata pixels have no class.

    With ``least_gain``, patches are chosen here, by their expected gain.
    """
    grid = gains.frame.grid
    work = gains.work

    def build(path: Path) -> None:
        """Write class map and class probabilities, and the figures of the prior map."""
        names = create_maps(path, gains, goes_on=prior is not None)
        drawing = Drawing(work.weights, mosaic, attention, gains.capture, prior, gains.zones.left_out, part)
        drawn = draw_field(work, drawing, path, least_gain, report)
        if prior is not None and drawn.comparison is not None:
            write_table(path / PRIOR_FIGURES, _prior_map_figures(prior, reader, names, drawn.comparison))
        if drawn.reading is not None:
            write_attention(path / READING, attention_of(drawn.reading, gains.policy))
        counts = {
            "out_of_range_px": drawn.unread_px,
            "unlike_patches": drawn.unlike,
            "captured_patches": drawn.captured,
        }
        write_table(path / SPECTRA, counts)
        finish_maps(path, gains, compared=drawn.comparison is not None)

    params = {**model_key, "grid": asdict(grid), **region_params(grid), **gains.frame.key, **gains.zones.key}
    params |= {"capture": list(gains.capture), "part": part}
    params["least_gain"] = least_gain
    if prior is not None:
        params |= {"days": prior.days, "day_of_year": prior.day_of_year, "classes": list(prior.classes)}
        params["reader"] = None if reader is None else reader.key
    return Wanted(build, params, [mosaic, attention, *([] if prior is None else prior.stores)])


def create_maps(path: Path, gains: PatchGains, *, goes_on: bool) -> tuple[str, ...]:
    """Create empty stores of class map and class probabilities; return the names of the classes."""
    frame = gains.frame
    shape = (frame.grid.height, frame.grid.width)
    weights = gains.work.weights.load()
    legend = ClassNames(weights.class_names, weights.class_colours)
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
        "run": prior.run,
        "days": prior.days,
        "reader": "none" if reader is None else reader.key,
        "agreement": None if np.isnan(comparison.agreement) else comparison.agreement,
        "compared_px": compared,
        "differing_px": compared - int(np.trace(comparison.changed)),
        "expected_differing_px": round(float(comparison.expected.sum() - np.trace(comparison.expected))),
        "changed_px": sum(one for one, _, _, _ in pairs),
        "changes": [list(pair) for pair in sorted(pairs, reverse=True)],
    }


STORE = "ground_map.zarr"
GROUND = Product("ground", version=7, files=(STORE,))


@stage("ground", "map in a projected CRS", GROUND)
def ground(class_map: Ref, mosaic: Ref, *, ground_grid: GroundGrid, report: Report) -> Wanted:
    """Project class map, changes and picture to the ground, by the pose of the rig."""

    def build(path: Path) -> None:
        """Write the map in blocks, then the area of each class."""
        found = load_class_map(class_map.path / MAP)
        old_class = ProbabilityStore(class_map.path / PROBABILITIES).old_class()
        colours = colours_of(mosaic)
        unsure = np.isnan(found.confidence)

        def shown(pixels: NDArray[np.float64]) -> dict[str, NDArray[np.generic]]:
            """Return the images of a block by name, at places (row, column, 2); nodata is 255, NaN and 0.

            Confidence and picture are interpolated, other images have the nearest pixel.
            """
            confidence = image_at(found.confidence[..., None], pixels)[..., 0]
            confidence[nearest_at(unsure, pixels, False)] = np.nan  # beside nodata
            images: dict[str, NDArray[np.generic]] = {
                "classes": nearest_at(found.classes, pixels, UNLABELLED),
                "confidence": confidence,
                "picture": np.nan_to_num(np.rint(image_at(colours, pixels))).astype(np.uint8),
            }
            if old_class is not None:
                images[OLD_CLASS] = nearest_at(old_class, pixels, UNLABELLED)
            return images

        writer = GroundMapWriter(
            path / STORE,
            ground_grid.geobox,
            ClassNames(found.names, found.colours),
            about={"rig_pose": asdict(ground_grid.frame.view.pose), "scene_pixels": ground_grid.counts()},
            goes_on=old_class is not None,
        )
        for rows, columns in map_blocks(ground_grid.shape, BLOCK):
            writer.write_block(rows, columns, shown(ground_grid.scene_pixels(rows, columns)))
            report(rows.stop / ground_grid.shape[0])
        areas = areas_by_number(PosedField(ground_grid), found.classes, len(found.names))
        assert areas is not None
        writer.finish(areas)

    params = {
        "pose": asdict(ground_grid.frame.view.pose),
        "ifov_rad": ground_grid.frame.view.ifov_rad,
        "scene_shape": ground_grid.scene_shape,
    }
    return Wanted(build, params, [class_map, mosaic])


def colours_of(mosaic: Ref) -> NDArray[np.float32]:
    """Return three bands of a mosaic as a picture (y, x, 3) in 1..255; NaN where nothing was captured."""
    seen = open_mosaic(mosaic.path / "mosaic.zarr")
    bands, caption = choose_bands(seen.wavelength_nm)
    values = np.concatenate([seen.spectra(strip, bands) for strip in seen.row_blocks()])
    return np.where(np.isfinite(values), 1 + 254 * develop(values, caption), np.nan).astype(np.float32)

"""The layers of a report's map, from what a run left: coarse look, sweeps, memory, places on the earth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.publish.change_pictures import RememberedField
from flows.publish.field_map import FieldMap, SweepShown
from flows.publish.page_data import PagePlaces, PageSpectra, page_spectra, places_of_grid, places_of_pose
from flows.publish.quicklook import QuicklookData, colours_of
from flows.publish.receipt_words import days_words
from flows.tasks.open_survey import Products
from flows.tasks.run import SurveyRun
from flows.tasks.stages.on_ground import survey_grid
from flows.terminal.figures import counted, format_seconds
from pipeline.geometry.scan import Sweep, exposing
from pipeline.planning.fine_pass import FinePlan
from storage.arrays.ground_maps import open_image
from storage.arrays.layout import open_group, read_array
from storage.arrays.quicklooks import choose_bands


@dataclass(frozen=True)
class CoarseRead:
    """A mosaic as pictures and pages want it."""

    colours: NDArray[np.float32]  # (y, x, 3) of the bands that are shown
    spectra: PageSpectra


def read_coarse(run: SurveyRun, products: Products) -> CoarseRead:
    """Read the coarse mosaic once, never all bands of all rows at once."""
    image = open_image(products.mosaic.path / "mosaic.zarr", "values")
    wavelength_nm = run.scene.wavelength_nm
    bands = list(choose_bands(wavelength_nm)[0])
    colours: list[NDArray[np.float32]] = []

    def blocks() -> Iterator[NDArray[np.float32]]:
        for _, values in image.rows():
            colours.append(values[..., bands])
            yield values

    y, x, count = image.shape
    spectra = page_spectra(blocks(), (y, x, count), wavelength_nm, run.grid.factor)
    return CoarseRead(np.concatenate(colours), spectra)


def field_map(
    run: SurveyRun,
    products: Products,
    plan: FinePlan,
    glance: QuicklookData,
    spectra: PageSpectra,
    before: RememberedField | None,
) -> FieldMap:
    """All layers that there are of a run; ``glance`` is what its quicklook shows."""
    seats = np.zeros(run.grid.seat_shape, bool)
    seats.ravel()[plan.seats] = True
    return FieldMap(
        names=glance.class_names,
        colours=glance.class_colours,
        classes=glance.class_map.astype(np.uint8),
        picture=np.rint(255 * colours_of(glance, glance.rectified)).astype(np.uint8),
        picture_words=choose_bands(glance.wavelength_nm)[1].capitalize(),
        patch_px=glance.patch_px,
        confidence=glance.confidence,
        truth=glance.truth,
        before=None if before is None else before.classes,
        before_words="" if before is None else days_words(before.days),
        changed=None if before is None else before.changed,
        age_days=None if before is None else before.age_days,
        seats=None if run.plan.plain else seats,
        sweeps=sweeps_shown(run, products, plan),
        spectra=spectra,
        places=_places(run),
    )


def sweeps_shown(run: SurveyRun, products: Products, plan: FinePlan) -> list[SweepShown]:
    """The sweeps of a run in the order in which they were taken: where each looked, and when."""
    passes = (("capture_coarse", run.plan.coarse), ("capture_fine", plan.sweeps))
    taken = [(sweep, products[stage].path / f"{sweep.name}.zarr") for stage, sweeps in passes for sweep in sweeps]
    return [
        SweepShown(block_of(sweep, run), sweep.kind, _sweep_words(run, sweep, path, f"{number} of {len(taken)}"))
        for number, (sweep, path) in enumerate(taken, 1)
    ]


def _sweep_words(run: SurveyRun, sweep: Sweep, path: Path, place: str) -> str:
    """Which sweep it was, its lines, and how long they took by their own times."""
    kind = "scan" if run.plan.plain else f"{sweep.kind} sweep"
    exposure = exposing(run.camera, sweep).exposure_ms
    group = open_group(path)
    times = read_array(group, "time")
    seconds = float(times.max() - times.min()) + exposure / 1000
    started = group.attrs.get("started")
    begun = "" if started is None else f", from {started} on"
    lines = f"{counted(sweep.lines, 'line')} of {exposure:g} ms"
    return f"{kind} {place}: {lines} in {format_seconds(seconds)}{begun}"


def _places(run: SurveyRun) -> PagePlaces | None:
    """Where the run's pixels lie on the earth, as its scene says or a pose; None where neither does."""
    if run.scene.geobox is not None:
        return places_of_grid(run.scene.geobox)
    grid = survey_grid(run)
    return None if grid is None else places_of_pose(grid.frame, (run.grid.height, run.grid.width))


def block_of(sweep: Sweep, run: SurveyRun) -> tuple[int, int, int, int]:
    """Rows and columns (y0, y1, x0, x1) that a sweep's line centres and samples span, cut to the scene."""
    size = (run.grid.width, run.grid.height) if sweep.along == "x" else (run.grid.height, run.grid.width)
    across = np.array([-0.5, 0.5]) * run.camera.samples + sweep.strip_px + size[0] / 2
    scan = np.array([0, sweep.lines * sweep.step]) + sweep.start_px + size[1] / 2 - 0.5
    x0, x1 = np.clip(np.rint(across), 0, size[0]).astype(int).tolist()
    y0, y1 = np.clip(np.rint(scan), 0, size[1]).astype(int).tolist()
    return (y0, y1, x0, x1) if sweep.along == "x" else (x0, x1, y0, y1)

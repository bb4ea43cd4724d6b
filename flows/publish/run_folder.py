"""Make receipt, quicklook and report of a survey, and publish them as one run folder, once.

The receipt counts the bytes of the survey's stores, and not those of its own folder.
"""

from __future__ import annotations

import platform
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.products import Control, Products
from spectralzoom.flows.publish.field_map import field_map
from spectralzoom.flows.publish.findings import PLOTS_FILE, find_out, map_warnings, plots_csv
from spectralzoom.flows.publish.quicklook import QuicklookData, draw_quicklook, thinned
from spectralzoom.flows.publish.receipt import Receipt, build_receipt
from spectralzoom.flows.publish.report import render_report
from spectralzoom.flows.settings.load import anchor_paths
from spectralzoom.flows.settings.values import KEEP_SIGNAL, RASTER
from spectralzoom.flows.stage import Row, Stores
from spectralzoom.flows.stages.capture import SAVED_S
from spectralzoom.flows.stages.effects import load_manifest
from spectralzoom.flows.stages.evaluate import load_accuracy
from spectralzoom.flows.stages.score import READING, SCORES, load_plan, read_in_full
from spectralzoom.models.evaluation.taught_labels import seen_in_training
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.planning.coverage import BYTES_PER_SAMPLE, SavingEntry, capture_savings, raw_bytes
from spectralzoom.pipeline.planning.fine_pass import FinePlan
from spectralzoom.pipeline.planning.uniform_scans import format_scan
from spectralzoom.pipeline.words import moment_of
from spectralzoom.storage.arrays.class_maps import ProbabilityStore, load_class_map
from spectralzoom.storage.arrays.layout import open_group, read_array
from spectralzoom.storage.arrays.mosaics import choose_bands, open_mosaic
from spectralzoom.storage.receipts import Facts
from spectralzoom.storage.runs import RECEIPT
from spectralzoom.storage.whole_files import to_json, write_new

REPORT = "report.html"
COSTS_OF_STAGE = ("wall_s", "cpu_s", "peak_rss_bytes", "bytes_in", "bytes_out")
LIBRARIES = ("spectralzoom", "numpy", "numba", "torch", "zarr", "xarray", "prefect")


@dataclass(frozen=True)
class Published:
    """A published run: its receipt and its folder."""

    receipt: Receipt
    folder: Path


def publish_run(
    stores: Stores, plan: SurveyPlan, products: Products, control: Control | None, started: datetime
) -> Published:
    """Publish the products of a survey as a run folder with receipt.json, quicklook.png and report.html."""
    shown = quicklook_data(plan, products)
    quicklook = draw_quicklook(shown)
    receipt: Receipt = {}

    def write(folder: Path, uri: str) -> Facts:
        """Write the files of the run into a folder, and return facts for its manifest."""
        nonlocal receipt
        receipt = make_receipt(stores, plan, products, control, uri, started)
        page = render_report(receipt, quicklook, field_map(shown, plan.field.prior))
        write_new(folder / "quicklook.png", quicklook)
        if "plots" in receipt:
            write_new(folder / PLOTS_FILE, plots_csv(receipt["plots"], receipt.get("warnings", ())))
        write_new(folder / RECEIPT, to_json(receipt))
        write_new(folder / REPORT, page)
        return {"survey": receipt["survey"], "settings": receipt["settings"]}

    day = moment_of(plan.field.acquired)
    inputs = [*stores.refs, *(() if control is None else control.stores.refs)]
    folder = stores.archive.publish_run(plan.field.name, write, inputs, None if day is None else day.date())
    return Published(receipt, folder)


def make_receipt(
    stores: Stores, plan: SurveyPlan, products: Products, control: Control | None, uri: str, started: datetime
) -> Receipt:
    """Return the receipt of a run whose folder has the address ``uri``."""
    read = len(open_mosaic(products.mosaic.path / "mosaic.zarr").components)
    plan = replace(plan, reading=plan.reading.with_components(read))
    field = plan.field
    fine = load_plan(products.attention)
    effects = {} if products.effects is None else load_manifest(products.effects)
    places = products.addresses()
    if (products.class_map.path / READING).exists():  # patches were chosen in the segmentation
        places["attention"] = f"{products.class_map.uri}/{READING}"
    files = (RECEIPT, "quicklook.png", REPORT, *([PLOTS_FILE] if field.zones.plots is not None else []))
    return build_receipt(
        survey=field.name,
        source=RASTER if field.source is None else field.source.name,
        scene=field.scene.key,
        seed=plan.settings.seed,
        started=in_seconds(started),
        finished=in_seconds(datetime.now(UTC)),
        acquired=field.acquired,
        versions=versions(),
        settings={**anchor_paths(plan.settings.to_dict(), Path.cwd()), "notes": list(plan.notes)},
        stages=[_stage_row(row) for row in stores.rows.values()],
        savings=_savings(plan, fine, read_in_full(products.attention, products.class_map)),
        data_bytes=count_bytes(stores, plan, products, fine),
        accuracy=None if products.accuracy is None else load_accuracy(products.accuracy),
        training_scene=seen_in_training(field.scene, field.described),
        effects=effects.get("effects"),
        effects_total={**effects["total"], SAVED_S: stores.total(SAVED_S)} if effects else None,
        products={**places, **{name: f"{uri}/{name}" for name in files}},
        control=None if control is None else control_figures(control),
        **find_out(plan, products),
    )


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that results depend on."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):  # run from a source tree that is not installed
            found[name] = version(name)
    return found


def in_seconds(moment: datetime) -> str:
    """Return a time in ISO 8601, UTC, to the second."""
    return f"{moment:%Y-%m-%dT%H:%M:%SZ}"


def control_figures(control: Control) -> dict[str, Any]:
    """Return scan, score and costs of the control."""
    plan, products = control.plan, control.products
    read = read_in_full(products.attention, products.class_map)
    components = len(open_mosaic(products.mosaic.path / "mosaic.zarr").components)
    figures = {} if products.accuracy is None else load_accuracy(products.accuracy)
    return {
        "scan": format_scan(plan.step, plan.passes.coarse[0].exposure_ms or plan.field.camera.exposure_ms),
        "capture_s": plan.passes.coarse_s,
        "kept": count_bytes(control.stores, plan, products, load_plan(products.attention))["kept"],
        "multiply_adds": plan.reading.with_components(components).work_done(read).total,
        **{name: figures.get(name) for name in ("miou", "overall_accuracy", "per_class_iou")},
    }


def _stage_row(row: Row) -> dict[str, Any]:
    costs = {name: getattr(row, name) for name in COSTS_OF_STAGE}
    why = {"why": row.why} if row.state == "left out" else {}
    return {"name": row.name, "key": row.ref.key or None, "state": row.state, **why, **costs}


def _savings(plan: SurveyPlan, fine: FinePlan, read: NDArray[np.intp]) -> dict[str, Any]:
    """Return the costs against the full scan, and against reading every patch; for a raster the latter alone."""
    did, patches = plan.reading.work_done(read, fine.changed), plan.field.kept_patches
    work = SavingEntry(did.total, plan.reading.costs.of_map(patches).total).as_dict()
    of_model: dict[str, Any] = {"multiply_adds": {**work, **asdict(did)}}
    if plan.field.described.config.corrected:  # there is a network that can read patches in full
        of_model = {"patches": SavingEntry(len(read), len(patches)).as_dict(), **of_model}
    if plan.field.raster is not None:
        return of_model
    entries = capture_savings([*plan.passes.coarse, *fine.sweeps], plan.passes.full, plan.field.camera, plan.field.grid)
    capture = SavingEntry(plan.passes.coarse_s + fine.seconds, plan.passes.full_s).as_dict()
    if (uniform := plan.scans.reference) is not None:  # the cheapest scan with nearly the best score
        capture |= {"uniform": uniform.seconds, "uniform_scan": uniform.summary}
    return {**{name: entry.as_dict() for name, entry in entries.items()}, "capture_s": capture, **of_model}


def quicklook_data(plan: SurveyPlan, products: Products) -> QuicklookData:
    """Return the data of the quicklook, with three bands."""
    field, fine = plan.field, load_plan(products.attention)
    bands, caption = choose_bands(field.scene.wavelength_nm)
    found = load_class_map(products.class_map.path / "class_map.zarr")
    thin = thinned(found.classes)
    scale = field.place.scale(field.camera.ifov_rad)

    def chosen(patches: NDArray[np.intp]) -> NDArray[np.bool_]:
        return by_pixels(field.grid, np.isin(field.grid.every_patch(), patches))[thin]

    reads = field.described.config.corrected
    return QuicklookData(
        survey=field.name,
        seed=plan.settings.seed,
        about="   ·   ".join([*map("Warning: {}".format, map_warnings(plan, products.class_map)), fine.reason]),
        rectified=open_mosaic(products.mosaic.path / "mosaic.zarr").thinned(thin[0].step, [*bands]),
        caption=caption,
        class_map=found.classes,
        class_names=found.legend.titles,
        class_colours=found.colours,
        confidence=np.ascontiguousarray(found.confidence[thin]),
        again=chosen(fine.patch_index) if fine.sweeps else None,
        read=chosen(read_in_full(products.attention, products.class_map)) if reads else None,
        gain=_expected_gain(plan, products, second_pass=bool(fine.sweeps), thin=thin),
        truth=field.labels.read(),
        was=ProbabilityStore(products.class_map.path / "class_probabilities.zarr").old_class(),
        pixel_m=scale.pixel_m if scale.footprint is None else None,
    )


def _expected_gain(
    plan: SurveyPlan, products: Products, *, second_pass: bool, thin: tuple[slice, slice]
) -> NDArray[np.float32] | None:
    """Return the expected gain that chose the second pass, else the patches read in full; None if all are alike."""
    store = products.class_map.path / READING
    if second_pass or not store.exists():
        store = products.attention.path / SCORES
    gain = read_array(open_group(store), "score").astype(np.float32)
    known = gain[np.isfinite(gain)]
    return by_pixels(plan.field.grid, gain.ravel())[thin] if known.size and np.ptp(known) else None


def by_pixels(grid: SceneGrid, values: NDArray[Any]) -> NDArray[Any]:
    """Return the values of patches (patch,) at the pixels (y, x) of the scene."""
    rows, columns = (np.arange(size) // grid.patch for size in (grid.height, grid.width))
    return values.reshape(grid.patch_shape)[np.ix_(rows, columns)]


def count_bytes(stores: Stores, plan: SurveyPlan, products: Products, fine: FinePlan) -> Facts:
    """Return the bytes that a survey captured, wrote and keeps, and those of the reference.

    Raw lines that the setting ``keep`` drops do not count as kept, nor do the stores of the visit of its prior map.
    """
    field, archive = plan.field, stores.archive
    bands = len(field.scene.wavelength_nm)
    captured, reference = 0, int(np.prod(field.scene.shape)) * bands * BYTES_PER_SAMPLE
    if field.raster is None:
        captured = raw_bytes([*plan.passes.coarse, *fine.sweeps], field.camera, bands)
        reference = raw_bytes(plan.passes.full, field.camera, bands)
    others = set() if field.prior is None else set(archive.manifest_hashes(field.prior.stores))
    if plan.settings.keep == KEEP_SIGNAL:
        others |= {one.raw.uri for one in products.passes}
    return {
        "captured": captured,
        "written": stores.bytes_written,
        "kept": sum(map(archive.size_of, archive.manifest_hashes(stores.refs).keys() - others)),
        "reference": reference,
    }

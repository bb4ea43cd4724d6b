"""Make receipt, quicklook and report of a survey, and publish them as one run folder, once.

The receipt counts the bytes of the survey's stores, and not those of its own folder.
"""

from __future__ import annotations

import platform
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.publish.field_map import field_map
from spectralzoom.flows.publish.findings import (
    PLOTS_FILE,
    field_figures,
    find_areas,
    find_ground,
    find_map,
    find_zones,
    plots_csv,
)
from spectralzoom.flows.publish.panels import thinned
from spectralzoom.flows.publish.quicklook import QuicklookData, draw_quicklook
from spectralzoom.flows.publish.receipt import Facts, Receipt, build_receipt, check_receipt
from spectralzoom.flows.publish.report import render_report
from spectralzoom.flows.settings.load import anchor_paths
from spectralzoom.flows.settings.values import EXTENT_WHOLE, KEEP_SIGNAL
from spectralzoom.flows.tasks.capture_plan import as_figures
from spectralzoom.flows.tasks.open_survey import STAGES, OpenSurvey, Products
from spectralzoom.flows.tasks.prior_maps import PRIOR_FIGURES
from spectralzoom.flows.tasks.run import SurveyRun, now
from spectralzoom.flows.tasks.scene import seen_in_training
from spectralzoom.flows.tasks.stages.accuracy import load_accuracy
from spectralzoom.flows.tasks.stages.attention import READING, load_plan, read_in_full
from spectralzoom.flows.tasks.stages.effects import load_manifest
from spectralzoom.flows.tasks.stages.maps import STORE
from spectralzoom.flows.tasks.stages.placement import SIGNAL_RECORD, load_registration
from spectralzoom.pipeline.geometry.grid import SceneGrid, patch_pixels
from spectralzoom.pipeline.planning.coverage import BYTES_PER_SAMPLE, SavingEntry, capture_savings, raw_bytes
from spectralzoom.pipeline.planning.fine_pass import FinePlan
from spectralzoom.storage.arrays.class_maps import ProbabilityStore, load_class_map
from spectralzoom.storage.arrays.ground_maps import load_ground_map
from spectralzoom.storage.arrays.mosaics import choose_bands, open_mosaic
from spectralzoom.storage.runs import RECEIPT, read_run
from spectralzoom.storage.store import Ref, damage, read_table
from spectralzoom.storage.whole_files import to_json

REPORT = "report.html"
LIBRARIES = ("spectralzoom", "numpy", "numba", "torch", "zarr", "xarray", "prefect")


@dataclass(frozen=True)
class Published:
    """A published run: its receipt and its folder."""

    receipt: Receipt
    folder: Path


def load_receipt(folder: Path) -> Receipt:
    """Return the receipt of a published run (IncompleteStoreError: it has changed; ShapeError: it is not valid)."""
    found = read_run(folder)
    if found.problem is not None:
        raise damage(folder, found.problem)
    return check_receipt(found.receipt)


def publish_run(survey: OpenSurvey, plan: FinePlan) -> Published:
    """Publish the products of a survey as a run folder with receipt.json, quicklook.png and report.html."""
    run, products = survey.run, survey.products
    rests_on = run.archive.manifest_hashes(products.values())
    shown = quicklook_data(run, products, plan)
    quicklook = draw_quicklook(shown)

    receipt: Receipt = {}

    def write(folder: Path, uri: str) -> Facts:
        """Write the files of the run into a folder, and return facts for its manifest."""
        nonlocal receipt
        receipt = make_receipt(survey, plan, uri, count_bytes(survey, plan, rests_on))
        page = render_report(receipt, quicklook, field=field_map(shown, run.prior))
        (folder / "quicklook.png").write_bytes(quicklook)
        if "plots" in receipt:
            (folder / PLOTS_FILE).write_text(plots_csv(receipt["plots"]))
        (folder / RECEIPT).write_text(to_json(receipt), encoding="utf-8")
        (folder / REPORT).write_text(page, encoding="utf-8")
        return {"survey": receipt["survey"], "settings": receipt["settings"]}

    folder = run.archive.publish_run(run.name, write, list(products.values()))
    return Published(receipt, folder)


def make_receipt(survey: OpenSurvey, plan: FinePlan, folder: str, data_bytes: Facts) -> Receipt:
    """Return the receipt of a run whose folder has the address ``folder``."""
    products = survey.products
    read = len(open_mosaic(products.mosaic.path / "mosaic.zarr").components)  # a plan assumes `SMOOTH` of them
    run = replace(survey.run, costs=replace(survey.run.costs, bands=read))
    accuracy = load_accuracy(products["evaluate"]) if "evaluate" in products else None
    effects = load_manifest(products["choose_effects"]) if run.source.simulates else {}
    stores = {key: place for name, ref in products.items() for key, place in STAGES[name].addresses(ref).items()}
    if (products["segment"].path / READING).exists():  # patches were chosen in the segmentation
        stores["attention"] = f"{products['segment'].uri}/{READING}"
    files = ("receipt.json", "quicklook.png", "report.html", *([PLOTS_FILE] if run.zones.plots is not None else []))
    versions = {"python": platform.python_version()}
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):  # run from a source tree that is not installed
            versions[name] = version(name)
    scans = {
        "taken": run.scans.chosen,
        "best_in_time": run.scans.best_in_time(run.plan.coarse_s + plan.seconds),
        "reference": run.scans.reference,
    }  # where there is a table
    return build_receipt(
        survey=run.name,
        source=run.source.name,
        scene=run.scene.key,
        seed=run.settings.seed,
        started=survey.started,
        finished=now(),
        versions=versions,
        settings=asked_settings(run),
        stages=[asdict(one) for one in survey.records.values()],
        savings=_savings(run, plan, read_in_full(products["score"], products["segment"])),
        data_bytes=data_bytes,
        accuracy=accuracy,
        training_scene=seen_in_training(run.scene, run.described),
        effects=effects.get("effects"),
        effects_total=effects.get("total"),
        products={**stores, **{name: f"{folder}/{name}" for name in files}},
        scans={name: as_figures(scan) for name, scan in scans.items() if scan is not None},
        **find_out(run, products),
    )


def asked_settings(run: SurveyRun) -> dict[str, object]:
    """Return the settings with absolute paths, and the notes on assumptions."""
    return {**anchor_paths(run.settings.to_dict(), Path.cwd()), "notes": list(run.notes)}


def _savings(run: SurveyRun, plan: FinePlan, read: NDArray[np.intp]) -> dict[str, Any]:
    """Return the costs against the full scan, and against reading every patch; for a raster the latter alone."""
    did = run.work_done(read)
    of_model = {
        "patches": SavingEntry(len(read), len(run.kept_patches)).as_dict(),
        "multiply_adds": {**SavingEntry(did.total, run.costs.of_map(run.kept_patches).total).as_dict(), **asdict(did)},
    }
    if run.raster is not None:
        return of_model
    entries = capture_savings([*run.plan.coarse, *plan.sweeps], run.plan.full, run.camera, run.grid)
    capture = SavingEntry(run.plan.coarse_s + plan.seconds, run.plan.full_s).as_dict()
    if (uniform := run.scans.reference) is not None:  # the cheapest scan with nearly the best score
        capture |= {"uniform": uniform.seconds, "uniform_scan": uniform.summary}
    return {**{name: entry.as_dict() for name, entry in entries.items()}, "capture_s": capture, **of_model}


def quicklook_data(run: SurveyRun, products: Products, plan: FinePlan) -> QuicklookData:
    """Return the data of the quicklook, with three bands."""
    bands, caption = choose_bands(run.scene.wavelength_nm)
    found = load_class_map(products["segment"].path / "class_map.zarr")
    thin = thinned(found.classes)
    chosen, choice = None, ""
    if not run.plan.plain or run.chooses:
        patches = plan.patch_index if not run.plan.plain else read_in_full(products["score"], products["segment"])
        what = "Read by the full network" if run.plan.plain else "Captured again"
        chosen = pixels_of_patches(run.grid, patches)[thin]
        choice = f"{what}: {len(patches)} patches by {run.settings.policy}"
    return QuicklookData(
        survey=run.name,
        seed=run.settings.seed,
        about=plan.reason,
        rectified=open_mosaic(products.mosaic.path / "mosaic.zarr").thinned(thin[0].step, [*bands]),
        caption=caption,
        class_map=found.classes,
        class_names=found.names,
        class_colours=found.colours,
        confidence=np.ascontiguousarray(found.confidence[thin]),
        chosen=chosen,
        choice=choice,
        truth=run.labels,
        was=ProbabilityStore(products["segment"].path / "class_probabilities.zarr").old_class(),
    )


def pixels_of_patches(grid: SceneGrid, patch_index: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which (y, x) pixels of the scene lie in these patches."""
    patches = np.zeros(grid.patch_shape, bool)
    patches.ravel()[patch_index] = True
    return patches.repeat(grid.patch, axis=0).repeat(grid.patch, axis=1)[: grid.height, : grid.width]


def find_out(run: SurveyRun, products: Products) -> dict[str, Any]:
    """Return the findings of a run by their names in the receipt."""
    plan = load_plan(products["score"])
    figures: dict[str, Any] = {"kind": plan.kind, "reason": plan.reason, "lines": plan.lines, "seconds": plan.seconds}
    found: dict[str, Any] = {"field": field_figures(run, plan), "plan": figures}
    prior = None if run.prior is None else dict(read_table(products["segment"].path / PRIOR_FIGURES))
    if run.recorded is not None:
        found["recording"] = {
            "sweeps": str(run.settings.sweeps),
            "lines_read": run.recorded.lines_served([*run.plan.coarse, *plan.sweeps]),
            "lines_recorded": sum(int(one.valid_line.sum()) for one in run.recorded.source.sweeps),
            "passes_s": run.plan.coarse_s + plan.seconds,
            "full_scan_s": run.settings.cost.seconds(run.plan.full, run.camera),
        }
    if run.chooses and (run.plan.plain or run.least_gain is not None):
        found["kept"] = run.reading_figures(read_in_full(products["score"], products["segment"]))
    if prior is not None:
        found["prior_map"] = prior
    if run.settings.extent != EXTENT_WHOLE:
        found["extent"] = {
            "lines": run.settings.extent,
            "patches_touched": len(plan.patch_index) / max(len(run.kept_patches), 1),
            "uses_prior_map": prior is not None,
            **({} if run.extent is None else asdict(run.extent)),
        }
    passes = {"coarse": products.get("register_coarse"), "fine": products.get("register_fine")}
    pointing = {name: _pointing(ref) for name, ref in passes.items() if ref is not None}
    if "fine" in pointing:
        pointing["fine"]["partly_seen"] = _partly_seen(run, products.mosaic, plan)
    if pointing:
        found["pointing"] = {"prior_px": run.settings.pointing_px, **pointing}
    drawn = load_class_map(products["segment"].path / "class_map.zarr")
    posed = next((load_ground_map(ref.path / STORE) for ref in products.there("ground")), None)
    probabilities = ProbabilityStore(products["segment"].path / "class_probabilities.zarr")
    found |= find_areas(run, posed, drawn) | find_ground(run, posed, drawn, probabilities, prior)
    found |= find_zones(run, drawn) | find_map(run, products["segment"], drawn)
    if run.raster is not None:
        return found
    record = products.mosaic.path / SIGNAL_RECORD
    saturated = read_table(record).get("saturated") if record.is_file() else None  # archives of before 2026-11-27
    if saturated:
        found["signal"] = {"saturated": saturated}
    lines = read_table(products.mosaic.path / "lines.json")
    if troubled := {name: facts for name, facts in lines.items() if any(facts.values())}:
        found["lines"] = troubled
    return found


def _partly_seen(run: SurveyRun, mosaic: Ref, plan: FinePlan) -> int:
    """Count the chosen patches that the fine pass did not capture completely."""
    kinds = open_mosaic(mosaic.path / "mosaic.zarr").captures()
    if kinds is None:
        return 0
    coarse = np.array([step >= run.plan.coarse[0].step for _, step, _ in kinds[0]])[kinds[1]]
    return int(np.count_nonzero(patch_pixels(run.grid, coarse)[plan.patch_index].any(axis=(1, 2))))


def _pointing(ref: Ref) -> dict[str, Any]:
    """Return the pointing corrections of a pass; residuals only where there are more windows than unknowns."""
    record = load_registration(ref)
    left = np.array([window["residual_px"] for window in record["windows"] if window.get("residual_px")])
    tells = len(left) > 2 * (len(record["sweeps"]) - len(record["untied"]) - 1)
    return {
        "held": record["reference"],
        "sweeps": {name: one["offset_px"] for name, one in record["sweeps"].items()},
        "residual_rms_px": float(np.sqrt(np.mean(left**2))) if left.size and tells else None,
        "not_found": record["untied"],
        "too_narrow": record["narrow"],
    }


def count_bytes(survey: OpenSurvey, plan: FinePlan, rests_on: Iterable[str]) -> Facts:
    """Return the bytes that a survey captured, wrote and keeps, and those of the reference.

    ``rests_on`` are its stores and their inputs. Raw lines that the setting ``keep`` drops do not count as kept, nor do
    the stores of the visit of its prior map.
    """
    run, archive = survey.run, survey.run.archive
    bands = len(run.scene.wavelength_nm)
    captured, reference = 0, int(np.prod(run.scene.shape)) * bands * BYTES_PER_SAMPLE
    if run.raster is None:
        captured = raw_bytes([*run.plan.coarse, *plan.sweeps], run.camera, bands)
        reference = raw_bytes(run.plan.full, run.camera, bands)
    others = set() if run.prior is None else set(archive.manifest_hashes(run.prior.stores))
    if run.settings.keep == KEEP_SIGNAL:
        others |= {ref.uri for ref in survey.products.there("capture_coarse", "capture_fine")}
    return {
        "captured": captured,
        "written": survey.bytes_written,
        "kept": sum(archive.size_of(uri) for uri in rests_on if uri not in others),
        "reference": reference,
    }

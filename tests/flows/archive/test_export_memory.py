"""Exports of a field with a prior map: changes, on field pixels and on the ground, by other readers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image

import spectralzoom.models.reading.prior_map as prior_map
from spectralzoom.flows.archive.export_command import run_export
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.models.weights.files import load_weights, save_weights, with_record
from tests.conftest import QUIET, RGB_NM, patchy_scene
from tests.exported_run import POSE, Exported
from tests.prior_work import without_effects
from tests.storage.export.stac_rules import is_cog
from tests.storage.readers.test_label_grids import write

SHAPE = (96, 128)
VISITS = ("2026-06-01T10:00:00Z", "2026-06-04T10:00:00Z")


def harvested(folder: Path, place: str) -> Iterator[Path]:
    """Yield the field before and after: later, its lower right corner is turned by 180 degrees."""
    values, _ = patchy_scene(SHAPE, 3, seed=5)
    later = values.copy()
    later[54:, 64:] = values[54:, 64:][::-1, ::-1]
    for number, image in enumerate((values, later)):
        folder.joinpath(f"{number}").mkdir()
        if place != "georeferenced":
            Image.fromarray(image.astype(np.uint8)).save(folder / f"{number}" / "field.png")
            yield folder / f"{number}" / "field.png"
            continue
        grid = rasterio.Affine(0.1, 0, 404_000, 0, -0.1, 5_757_000)
        yield write(folder / f"{number}" / "field.tif", image.astype(np.uint8), grid)


@pytest.fixture(scope="module", params=["georeferenced", "posed"])
def visited(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, weights: Path) -> list[Exported]:
    """Return both visits; the later one, after three days, captured some lines of a swath only."""
    folder = tmp_path_factory.mktemp(request.param)
    archive, out = folder / "archive", folder / "maps"
    sharp = with_record(load_weights(weights), calibration={"temperature": 0.2})  # maps that rarely differ by chance
    save_weights(sharp, folder / "sharp.safetensors")
    given = {"weights": str(folder / "sharp.safetensors"), "engine": "plain", "out": str(archive), "accuracy": False}
    given |= {"name": "north", "wavelengths": ",".join(map(str, RGB_NM)), "prior": "latest", "camera.samples": 64}
    runs = []
    with without_effects(), pytest.MonkeyPatch.context() as patch:
        for name in ("CERTAIN", "SURE"):  # untrained weights are never certain: their classes are taken as certain
            patch.setattr(prior_map, name, 1e-6)
        for scene, visit, extent in zip(harvested(folder, request.param), VISITS, ("whole", "1:40-90"), strict=True):
            asked = {"scene": str(scene), "source": "sim", "visit": visit, "scan_step": 1, "extent": extent}
            settings = load_settings(None, given | asked)
            posed = settings.but(pose=POSE) if request.param == "posed" else settings
            runs.append(run_survey(posed, QUIET))
    return [
        Exported(archive, run.receipt, out, run_export(archive, run.folder.name, out, console=QUIET)) for run in runs
    ]


def test_images_have_the_values_of_the_store(visited: list[Exported]) -> None:
    """Old classes have names and the grid of the class map; a first visit has none."""
    first, later = visited
    assert "changed_from" not in first.answer["files"]
    store = later.store("ground_map" if "ground_map" in later.receipt["products"] else "class_probabilities")
    assert is_cog(later.file("changed_from"))
    np.testing.assert_array_equal(later.image("changed_from"), store["changed_from"].values)
    assert (store["changed_from"].values != 255).any()
    names = store.attrs["class_names"]
    with rasterio.open(later.file("changed_from")) as file, rasterio.open(later.file("class_map")) as drawn:
        assert [file.tags(1)[f"CLASS_{number}"] for number in range(len(names))] == names
        assert (file.crs, file.transform, file.shape) == (drawn.crs, drawn.transform, drawn.shape)


def test_receipt_and_page_have_the_hectares(visited: list[Exported]) -> None:
    """With a place they are the area of changed pixels, as plain xarray reads them."""
    first, later = (run.receipt for run in visited)
    assert "changes_ha" not in first["ground"]
    posed = "ground_map" in later["products"]
    store = visited[1].store("ground_map" if posed else "class_probabilities")
    pixel_ha = store.attrs["spatial:transform"][0] ** 2 / 1e4
    slack = 0.05 if posed else 1e-3  # footprints' borders
    changes = later["ground"]["changes_ha"]
    names = store.attrs["class_names"]
    drawn = visited[1].store("ground_map" if posed else "class_map")["classes"].values
    there = store["changed_from"].values.astype(int) * 1000 + drawn
    wanted = {
        (old, new): (there == 1000 * names.index(old) + names.index(new)).sum() * pixel_ha * beyond / differing
        for beyond, differing, old, new in later["prior_map"]["changes"]
    }  # beyond the difference of two maps of the same ground
    assert wanted
    assert {(old, new): area for area, old, new in changes} == pytest.approx(wanted, rel=slack)
    page = (visited[1].archive / "runs" / visited[1].id / "report.html").read_text(encoding="utf-8")
    assert re.search(r"class \d to class \d [0-9.]+", page)

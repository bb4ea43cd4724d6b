"""A whole survey on the plain engine: receipt, stores read with plain xarray, report, and pixels without a value."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from PIL import Image
from rich.console import Console

from spectralzoom.flows.opening.scene import open_scene
from spectralzoom.flows.publish.receipt import check_receipt
from spectralzoom.flows.publish.receipt_table import finding_rows
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.reading.inference import segment
from spectralzoom.models.weights.files import load_weights, save_weights
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep
from spectralzoom.pipeline.planning.coverage import on_scene
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.signal.subspace import with_shared
from spectralzoom.pipeline.simulator.render import BY_NAME
from spectralzoom.storage.arrays.class_maps import ClassMap, load_class_map
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive, is_known
from tests.conftest import CLASSES, QUIET, RGB_NM, patchy_scene, random_weights
from tests.flows.conftest import FEW_BANDS, Page
from tests.models.conftest import coarse_prediction
from tests.receipts import comparable

COARSE = ("choose_effects", "capture_coarse", "condense_coarse", "locate", "rectify", "read_overview", "score")
STAGES = [*COARSE, "capture_fine", "condense_fine", "rectify_fine", "segment", "evaluate"]
FARM = (128, 192)


@dataclass(frozen=True)
class Done:
    """Survey and its archive."""

    published: Published
    archive: Path

    @property
    def receipt(self) -> Any:
        """Return the receipt."""
        return self.published.receipt

    def open(self, product: str) -> xr.Dataset:
        """Return a product, opened with plain xarray and no code of this project."""
        return xr.open_zarr(self.archive / self.receipt["products"][product], consolidated=False)

    def sweeps(self) -> list[xr.Dataset]:
        """Return all condensed sweeps."""
        found = sorted((self.archive / self.receipt["products"]["signal_fine"]).glob("*.zarr"))
        return [xr.open_zarr(path, consolidated=False) for path in found]


@pytest.fixture(scope="module")
def farm(tmp_path_factory: pytest.TempPathFactory) -> Done:
    """Return a survey of a small built-in farm with the shipped weights and controls."""
    out = tmp_path_factory.mktemp("farm")
    flags = {
        "size": f"{FARM[1]}x{FARM[0]}",
        "bands": FEW_BANDS,
        "budget": "0.9",
        "seed": "1",
        "engine": "plain",
        "controls": True,
    }
    return Done(run_survey(load_settings(None, {**flags, "out": str(out)}), QUIET), out)


def test_receipt_has_every_field(farm: Done) -> None:
    """The stages are in order and all ran; accuracy has controls, and effects stay within the tolerance of 0.1."""
    receipt = check_receipt(farm.receipt)
    ran = receipt["stages"]
    assert {stage["name"]: stage["state"] for stage in ran} == dict.fromkeys(STAGES, "ran")
    assert all(stage["wall_s"] > 0 and stage["peak_rss_bytes"] > 0 for stage in ran)
    assert all((farm.archive / "stages").glob(f"*/{stage['key']}/manifest.json") for stage in ran)
    assert {row["name"] for row in receipt["effects"]} == set(BY_NAME)
    assert receipt["effects_total"]["bound"] <= receipt["effects_total"]["tolerance"] == 0.1
    assert farm.receipt["plan"]["lines"] > 0


def test_all_maps_of_a_receipt_have_iou_for_the_classes_of_the_labels(farm: Done) -> None:
    """The map has null for the other classes, and the stored file has no NaN."""
    accuracy: Any = farm.receipt["accuracy"]
    stored = farm.archive / farm.receipt["products"]["accuracy"]
    assert "NaN" not in stored.read_text()
    scene, _ = open_scene(load_settings(None, {"size": f"{FARM[1]}x{FARM[0]}", "seed": "1"}))
    truth = {scene.class_names[number] for number in np.unique(scene.labels)}
    known = {name: iou for name, iou in accuracy["per_class_iou"].items() if iou is not None}
    assert set(known) == truth
    assert accuracy["miou"] == pytest.approx(np.mean(list(known.values())))
    assert not truth & set(accuracy["false_classes"])


def test_the_control_is_a_survey_by_the_uniform_scan(farm: Done, tmp_path: Path) -> None:
    """It scores as a survey of that scan, takes no more seconds than both passes, and its raw lines are cleared."""
    control = farm.receipt["control"]
    assert control["capture_s"] <= farm.receipt["field"]["camera_s"]["full_scan"] * 0.9 + 1e-9
    step, exposure_ms = re.fullmatch(r"every (?:(\d)\w\w )?line, ([\d.]+) ms", control["scan"]).groups()
    scan = {"scan_step": step or "1", "scan_exposure_ms": exposure_ms, "size": f"{FARM[1]}x{FARM[0]}"}
    flags = {**scan, "bands": FEW_BANDS, "seed": "1", "engine": "plain", "out": str(tmp_path)}
    uniform = run_survey(load_settings(None, flags), QUIET).receipt
    assert uniform["accuracy"]["miou"] == control["miou"]
    assert uniform["savings"]["multiply_adds"]["done"] == control["multiply_adds"]
    assert uniform["savings"]["capture_s"]["done"] == control["capture_s"]
    assert not [*farm.archive.glob("stages/capture/*/*.zarr")]


def test_savings_add_up_and_ranks_follow_the_scores(farm: Done) -> None:
    """Ratios are done over full and the capture keeps its budget; scores of chosen patches fall with their rank."""
    savings = farm.receipt["savings"]
    for name, entry in savings.items():
        assert entry["ratio"] == pytest.approx(entry["done"] / entry["full"]), name
    assert savings["capture_s"]["done"] <= 0.9 * farm.receipt["field"]["camera_s"]["full_scan"] + 1e-9
    work = savings["multiply_adds"]
    assert work["done"] == sum(work[part] for part in ("overview", "score", "detail"))
    attention, detail = farm.open("attention"), farm.open("mosaic")
    score, rank = attention["score"].values.ravel(), attention["rank"].values.ravel()
    chosen = np.flatnonzero(rank >= 0)
    y, x = (16 * int(place) for place in np.divmod(chosen[0], attention.sizes["patch_x"]))
    assert np.isfinite(detail["scores"].values[:, y : y + 16, x : x + 16]).all()
    ordered = chosen[np.argsort(rank[chosen])]
    assert (np.sort(rank[chosen]) == np.arange(len(chosen))).all()
    assert (np.diff(score[ordered]) <= 0).all()


def test_savings_match_the_stored_cubes(farm: Done) -> None:
    """Lines, samples on the scene and bytes come from the cubes; seconds are the cost model's for both passes."""
    savings = farm.receipt["savings"]
    cubes = farm.sweeps()
    shape = tuple(farm.open("class_map").sizes[axis] for axis in ("y", "x"))
    sweeps = [Sweep(**cube.attrs["sweep"]) for cube in cubes]
    assert savings["lines"]["done"] == sum(cube.sizes["line"] for cube in cubes)
    assert savings["samples"]["done"] == sum(int(on_scene(shape, LineCamera(), sweep).sum()) for sweep in sweeps)
    values = (cube.sizes["line"] * cube.sizes["sample"] * cube.sizes["band"] for cube in cubes)
    assert farm.receipt["data_bytes"]["captured"] == 2 * sum(values)
    passes = [[sweep for sweep in sweeps if sweep.kind == kind] for kind in ("coarse", "fine")]
    assert all(passes)
    seconds = sum(CostModel().seconds(part, LineCamera()) for part in passes)
    assert savings["capture_s"]["done"] == pytest.approx(seconds)


def test_second_run_is_read_from_the_archive(survey_png: Any, surveyed_png: Any, tmp_path: Path) -> None:
    """The same command runs no stage, gives the same products, and publishes another run."""
    first, second = surveyed_png(tmp_path).receipt, survey_png(tmp_path).receipt
    assert [stage["state"] for stage in second["stages"] if stage["name"] in STAGES] == ["cached"] * len(STAGES)
    assert comparable(first) == comparable(second)
    archive = Archive.open(tmp_path)
    assert len(archive.runs()) == 2
    assert [finding.problem for finding in verify_everything(archive)] == [None] * (len(STAGES) + 2)
    cleared = ("spool/*", "stages/capture/*/*.zarr", "stages/rectify/*")  # raw lines, mosaic of the first pass
    assert {path.suffix for some in cleared for path in tmp_path.glob(some)} == {".cleared"}


IMPORTED = """
import sys
from spectralzoom.flows.cli.main import main
try:
    main(sys.argv[1:])
finally:
    print(*sorted({"torch", "prefect.server"} & sys.modules.keys()))
"""


def test_a_survey_that_finds_every_store_starts_neither_server_nor_network(command_line: Any, tmp_path: Path) -> None:
    """It publishes another run with Prefect as the engine, and imports neither torch nor the server of Prefect."""
    asked = ["survey", "--scene", "farm", "--size", "64x64", "--bands", FEW_BANDS, "--out", str(tmp_path)]
    assert command_line(*asked, "--engine", "plain").code == 0
    done = subprocess.run([sys.executable, "-c", IMPORTED, *asked], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr
    assert len(Archive.open(tmp_path).runs()) == 2
    assert not (tmp_path / ".prefect").exists()


@pytest.mark.usefixtures("no_effects")
def test_without_later_lines_the_first_pass_is_read_in_full(survey_png: Any, weights: Path, tmp_path: Path) -> None:
    """A budget for the first pass alone gives the map of a uniform scan of these lines."""
    said = Console(file=io.StringIO(), width=400)
    done = Done(survey_png(tmp_path, said, budget="0.45"), tmp_path)
    assert "note: no second pass: no " in said.file.getvalue()
    assert done.receipt["plan"]["lines"] == 0
    mosaic = open_mosaic(tmp_path / done.receipt["products"]["mosaic"])
    drawn = done.open("class_map")["classes"].values
    grid = SceneGrid(*drawn.shape, 8)
    values = mosaic.values()
    seen = coarse_prediction(load_weights(weights), values, mosaic.wavelength_nm, grid, capture=LineSpec(1.0, 4))
    every = grid.every_patch()
    expected = segment(load_weights(weights), seen, seen.patches(every), every).classes
    assert (expected == drawn).mean() > 0.999


@pytest.mark.usefixtures("no_effects")
def test_uncomputed_scores_are_left_out(surveyed_png: Any, survey_png: Any, scene_files: Path, tmp_path: Path) -> None:
    """Without controls the map alone is judged; without labels there is no accuracy."""
    accuracy = surveyed_png(tmp_path / "picture").receipt["accuracy"]
    assert not {"none", "all"} & {*accuracy}
    assert accuracy["miou"] is not None
    nm = "640,460,500,550,620,600"
    found = survey_png(tmp_path, scene=str(scene_files / "cube.npy"), labels=None, wavelengths=nm, budget="1").receipt
    assert "accuracy" not in check_receipt(found)
    assert "evaluate" not in [stage["name"] for stage in found["stages"]]
    stored = Done(Published(found, tmp_path), tmp_path).open("mosaic")["wavelength"].values
    assert stored.tolist() == [float(word) for word in nm.split(",")]


def test_products_exist_at_their_addresses(farm: Done) -> None:
    """Addresses are relative, the report loads nothing from the network, and the quicklook has at least 600 px."""
    for name, address in farm.receipt["products"].items():
        assert is_known(farm.archive / address), name
    assert (farm.published.folder / "receipt.json").read_text().startswith('{\n  "survey": "farm"')
    folder = farm.archive / farm.receipt["products"]["report.html"]
    html = folder.read_text(encoding="utf-8")
    page = Page(html)
    assert all(one.startswith("data:image/") for one in page.loaded)
    assert not re.search(r"@import|url\(", html.partition("<script>")[0])
    assert "data:image/webp;base64," in html
    assert len(page.links) > 5
    for link in page.links:
        assert (folder.parent / link).exists(), link
    assert "Errors: map and truth differ" in html
    with Image.open(farm.archive / farm.receipt["products"]["quicklook.png"]) as image:
        assert image.format == "PNG"
        assert min(image.size) >= 600


GAP = np.s_[20:31, 40:60]  # of 64 x 96 px


def _scene(folder: Path, fill: float | None, toml: str = "") -> Path:
    """Write a scene with a hole of value ``fill``, or without a hole if it is None, and its labels."""
    folder.mkdir()
    values, labels = patchy_scene((64, 96), 3, seed=4)
    if fill is not None:
        values[GAP] = fill
    np.save(folder / "scene.npy", values.astype(np.float32))
    np.save(folder / "labels.npy", labels)
    (folder / "scene.toml").write_text(toml)
    return folder / "scene.npy"


def _survey(survey_png: Any, scene: Path, **flags: Any) -> Any:
    files = {"scene": str(scene), "labels": str(scene.with_name("labels.npy"))}
    return survey_png(scene.parent / "a", **files, wavelengths=",".join(map(str, RGB_NM)), **flags)


def _map(survey: Any, scene: Path) -> ClassMap:
    return load_class_map(scene.parent / "a" / survey.receipt["products"]["class_map"])


@pytest.mark.usefixtures("no_effects")
def test_nodata_has_no_class_and_does_not_darken(survey_png: Any, tmp_path: Path) -> None:
    """The hole alone is nodata, over 90 % of the other classes stay, and the receipt counts the pixels."""
    stated, whole = _scene(tmp_path / "stated", 1e30, "nodata = 1e30"), _scene(tmp_path / "whole", None)
    one, plain = (_survey(survey_png, scene) for scene in (stated, whole))
    drawn = _map(one, stated)
    gap = np.zeros(drawn.classes.shape, np.bool_)
    gap[GAP] = True
    np.testing.assert_array_equal(drawn.classes == 255, gap)
    np.testing.assert_array_equal(np.isnan(drawn.confidence), gap)
    count = int(gap.sum())
    assert one.receipt["pixels"] == {"scene_without_a_value": count, "px_no_reading": 0, "map_without_a_class": count}
    assert one.receipt["accuracy"]["pixels"] == 64 * 96 - count
    assert "pixels" not in plain.receipt
    assert (_map(plain, whole).classes == drawn.classes)[~gap].mean() > 0.9  # the brightness is unchanged


def test_undeclared_nodata_ends_a_survey(survey_png: Any, tmp_path: Path) -> None:
    """One message gives its place, before anything is captured."""
    scene = _scene(tmp_path / "s", 1e30)
    said = r"scene.npy has 1e\+30 at y 20, x 40, band 0, .* write nodata = 1e\+30 into a"
    with pytest.raises(SceneError, match=said):
        _survey(survey_png, scene)
    assert not (scene.parent / "a").exists()


@pytest.mark.usefixtures("no_effects")
def test_pixels_out_of_the_range_of_the_weights_are_counted(survey_png: Any, tmp_path: Path) -> None:
    """These weights are for values a million times smaller, so no pixel gets a class, and the receipt says so."""
    weights = random_weights(RGB_NM, CLASSES)
    small = replace(weights.normalisation, centre=np.zeros(3, np.float32), spread=np.full(3, 1e-4, np.float32))
    save_weights(replace(weights, normalisation=small), tmp_path / "w.safetensors")
    scene = _scene(tmp_path / "s", None)
    found = _survey(survey_png, scene, weights=str(tmp_path / "w.safetensors"), policy="sobel")
    pixels = found.receipt["pixels"]
    assert pixels["px_no_reading"] == pixels["map_without_a_class"] == 64 * 96
    assert "px no reading" in dict(finding_rows(found.receipt))["pixels"]


def test_two_passes_share_components_of_rare_spectra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rare spectra of both passes add components, and both passes are then stored with all components."""
    grown: list[list[int]] = []

    def watched(components: Components, residuals: Any, false_alarm: float) -> Components:
        shared = with_shared(components, residuals, false_alarm)
        grown.append([len(components), len(shared)])
        assert 256 < len(residuals) <= 512 + 2  # a part of each of two sweeps
        return shared

    monkeypatch.setattr("spectralzoom.flows.stages.condense.with_shared", watched)
    monkeypatch.setattr("spectralzoom.flows.stages.condense.MOST_COMPARED", 512)
    size = {"size": "128x112", "camera.samples": 192, "bands": ",".join(map(str, range(4, 270, 3)))}
    flags = {"zoom": "always", "seconds": "4", "effects": "none", "accuracy": "false", "engine": "plain"}
    found = load_settings(None, {"scene": "farm", "out": str(tmp_path), **size, **flags})
    done = Done(run_survey(found, QUIET), tmp_path)
    assert done.receipt["plan"]["lines"] > 0
    assert grown[-1][0] < grown[-1][1]
    assert {cube["scores"].shape[0] for cube in done.sweeps()} == {grown[-1][1]}

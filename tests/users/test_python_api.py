"""The package spectralzoom: the first calls in Python, and their results in xarray."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import rioxarray  # noqa: F401 - registers the accessor that users have

import spectralzoom
from spectralzoom.opened import OpenedRun
from spectralzoom.pipeline.errors import NoRunError
from spectralzoom.storage.arrays.class_maps import load_class_map
from spectralzoom.storage.arrays.georeference import load_geobox
from tests.conftest import WeightsMaker
from tests.flows.small_fields import write_field
from tests.prior_work import without_effects

POSE = {"lon_deg": 7.6, "lat_deg": 51.96, "height_m": 30, "heading_deg": 20, "tilt_deg": 35}
Heard = dict[str, list[float]]


@pytest.fixture(scope="module")
def asked(scene_files: Path, weights: Path) -> dict[str, object]:
    """Return the settings of a small survey with a pose, as a table."""
    files = {"scene": scene_files / "scene.png", "labels": str(scene_files / "labels.png"), "weights": weights}
    quick = {"camera": {"samples": 320}, "budget": 0.8, "accuracy": False}
    return {**files, "source": "sim", "pose": POSE, **quick}


@pytest.fixture(scope="module")
def surveyed(asked: dict[str, object], tmp_path_factory: pytest.TempPathFactory) -> tuple[OpenedRun, Heard]:
    """Return a run, and the progress values of each stage."""
    heard: Heard = defaultdict(list)
    out = tmp_path_factory.mktemp("api") / "archive"
    with without_effects():
        run = spectralzoom.survey(asked, out=out, progress=lambda stage, done, of: heard[stage].append(done / of))
    return run, heard


@pytest.fixture(scope="module")
def run(surveyed: tuple[OpenedRun, Heard]) -> OpenedRun:
    """Return the run alone."""
    return surveyed[0]


def test_importing_the_package_loads_no_heavy_library() -> None:
    """All names are listed at once; torch, numpy and xarray are loaded by the first call that needs them."""
    code = "import sys, spectralzoom; print(*dir(spectralzoom)); print({'torch', 'numpy', 'xarray'} & set(sys.modules))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines() == [" ".join(spectralzoom.__all__), "set()"]
    assert all(getattr(spectralzoom, name) for name in spectralzoom.__all__)


def test_opening_an_archive_does_not_load_torch(run: OpenedRun) -> None:
    """Opening a map must not wait for the import of torch."""
    code = (
        "import sys, spectralzoom; print(spectralzoom.open(sys.argv[1]).latest.class_map.dtype, 'torch' in sys.modules)"
    )
    command = [sys.executable, "-W", "error", "-c", code, str(run.folder.parents[1])]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == "uint8 False"


def test_runs_are_found_by_name_and_the_latest_comes_first(run: OpenedRun, tmp_path: Path) -> None:
    """An archive is a mapping, `latest` is its first value; an unknown name raises KeyError with the latest ones."""
    for name in (run.name, "20200101T000000-earlier"):
        shutil.copytree(run.folder, tmp_path / "archive" / "runs" / name)
    (tmp_path / "archive" / "stages").mkdir()
    archive = spectralzoom.open(tmp_path / "archive")
    assert list(archive) == [run.name, "20200101T000000-earlier"]
    assert archive.latest.name == next(iter(archive))
    assert archive[f"runs/{run.name}"].receipt == run.receipt
    with pytest.raises(KeyError, match=r"its latest are .*20200101"):
        archive["no-such"]
    assert 0 not in archive
    assert issubclass(NoRunError, spectralzoom.Error)


def test_class_map_and_confidence_are_those_of_the_store(run: OpenedRun) -> None:
    """Classes stay uint8 with their names; 255 is nodata."""
    found = run.class_map
    stored = load_class_map(run.folder.parents[1] / run.receipt["products"]["class_map"])
    assert (found.dtype, found.attrs["nodata"]) == (np.uint8, 255)
    np.testing.assert_array_equal(found, stored.classes)
    assert found.attrs["flag_meanings"].split() == list(run.class_names) == list(stored.names)
    np.testing.assert_array_equal(run.confidence, stored.confidence)


def test_mosaic_and_class_map_share_their_coordinates(run: OpenedRun) -> None:
    """Their coordinates are equal, so xarray aligns both."""
    classes, mosaic = run.class_map, run.mosaic
    for axis in ("y", "x"):
        np.testing.assert_array_equal(mosaic[axis].values, classes[axis].values)
        assert mosaic[axis].attrs["units"] == "rad"
    joined = mosaic.where(classes == int(classes[0, 0]))  # pixels with other coordinates would be left out
    assert joined.shape == mosaic.shape
    assert np.isfinite(joined.values[0, 0]).all()


def test_an_index_of_the_mosaic_is_its_formula(run: OpenedRun) -> None:
    """NGRDI is the difference of green and red over their sum; an index whose bands the cube lacks is an error."""
    found = run.index("ngrdi")
    mosaic = run.mosaic.astype(np.float64)
    red, green = (mosaic.sel(wavelength=nm).values for nm in (640.0, 550.0))
    assert (found.dims, found.dtype, found.name) == (("y", "x"), np.float32, "NGRDI")
    np.testing.assert_allclose(found.values, (green - red) / (green + red), atol=1e-6)
    with pytest.raises(spectralzoom.Error, match=r"NDVI wants .*, and the cube has no such band"):
        run.index("NDVI")


def test_spectra_of_classes_are_their_mean_and_deviation(run: OpenedRun) -> None:
    """Bands are those of the mosaic; each class has its pixels."""
    found = run.spectra()
    classes, mosaic = run.class_map.values, run.mosaic.values.astype(np.float64)
    assert tuple(found["class_name"].values) == run.class_names
    np.testing.assert_array_equal(found["wavelength"], run.mosaic["wavelength"])
    for number, name in enumerate(run.class_names):
        of = mosaic[classes == number]
        one = found.sel(class_name=name)
        assert int(one["pixels"]) == len(of)
        if len(of):
            np.testing.assert_allclose(one["mean"], of.mean(axis=0), rtol=1e-6)
            np.testing.assert_allclose(one["std"], of.std(axis=0), rtol=1e-4, atol=1e-6)


def test_two_runs_are_compared_class_by_class(run: OpenedRun, asked: dict[str, object], scene_files: Path) -> None:
    """Each pair of classes has its hectares on the ground; maps on two grids are refused."""
    out = run.folder.parents[1]
    with without_effects():
        later = spectralzoom.survey(asked | {"policy": "random", "budget": 0.6}, out=out)
        other = spectralzoom.survey(asked | {"pose": None, "source": "raster", "camera": {}, "budget": None}, out=out)
        smaller = spectralzoom.survey(asked | {"pose": {**POSE, "tilt_deg": 30}}, out=out)
    archive = spectralzoom.open(out)
    changes = archive.compare(run.name, later.name)
    before, after = (one.ground_map["classes"].values for one in (run, later))
    assert (changes.attrs["unit"], tuple(changes.index), tuple(changes.columns)) == (
        "ha",
        run.class_names,
        run.class_names,
    )
    pixels = np.bincount(before[before < 3] * np.intp(3) + after[before < 3], minlength=9).reshape(3, 3)
    pixel_ha = abs(float(np.prod([run.ground_map[axis].diff(axis).values[0] for axis in ("y", "x")]))) / 1e4
    np.testing.assert_allclose(changes.values, pixels * pixel_ha, rtol=2e-3)
    counted = archive.compare(run.name, other.name)
    assert (counted.attrs["unit"], int(counted.values.sum())) == ("px", run.class_map.size)
    with pytest.raises(spectralzoom.Error, match="are on two grids; compare runs of one field"):
        archive.compare(run.name, smaller.name)


def test_the_ground_map_has_its_crs(run: OpenedRun) -> None:
    """The CRS follows rioxarray's convention, and the transform is that of the store."""
    drawn = run.ground_map
    geobox = load_geobox(run.folder.parents[1] / run.receipt["products"]["ground_map"])
    assert drawn["classes"].dtype == np.uint8
    assert (drawn["classes"].rio.crs.to_epsg(), drawn["classes"].rio.nodata) == (32632, 255)
    here = drawn["classes"].rio.transform()
    assert np.allclose(np.array(here[:6]), np.array(geobox.affine[:6]), atol=0.1 * abs(geobox.affine.a))


def test_progress_rises_to_1_in_every_stage(surveyed: tuple[OpenedRun, Heard]) -> None:
    """Each stage that ran reports rising fractions that end at 1."""
    run, heard = surveyed
    ran = {row["name"] for row in run.receipt["stages"] if row["state"] == "ran"}
    assert ran <= set(heard)
    assert all(fractions == sorted(fractions) and fractions[-1] == 1 for fractions in heard.values())


def test_surveying_prints_nothing(asked: dict[str, object], run: OpenedRun, capfd: pytest.CaptureFixture[str]) -> None:
    """A survey of stored results publishes a new run without output on stdout or stderr."""
    again = spectralzoom.survey(asked, out=str(run.folder.parents[1]))
    assert {row["state"] for row in again.receipt["stages"]} == {"cached"}
    assert again.name != run.name
    assert capfd.readouterr() == ("", "")


def test_a_plan_counts_only_missing_stores(asked: dict[str, object], run: OpenedRun, tmp_path: Path) -> None:
    """The arguments of a finished survey have nothing to make; for a new archive there is, and no file is written."""
    assert spectralzoom.plan(asked, out=str(run.folder.parents[1]))["to_make"] == 0
    elsewhere = spectralzoom.plan(asked, out=tmp_path / "archive")
    assert elsewhere["to_make"] > 5
    assert not (tmp_path / "archive").exists()


def test_keywords_override_a_settings_file(asked: dict[str, object], tmp_path: Path) -> None:
    """A table in a keyword changes only its own keys."""
    (tmp_path / "survey.toml").write_text("budget = 0.3\nengine = 'plain'\n[camera]\nsamples = 320\nbits = 10\n")
    same = {"source": "sim", "scene": asked["scene"], "weights": asked["weights"], "out": tmp_path / "archive"}
    with pytest.raises(spectralzoom.Error, match=r"--camera.bits must be a whole number from 8 to 16"):
        spectralzoom.plan(tmp_path / "survey.toml", **same, camera={"bits": 40})
    (tmp_path / "survey.toml").write_text("[camera]\nsamples = 3\n")
    with pytest.raises(spectralzoom.Error, match=r"'camera.samples' in .*survey.toml must be"):
        spectralzoom.plan(tmp_path / "survey.toml", **same, camera={"bits": 12})


def test_weights_are_trained_and_evaluated(tmp_path: Path) -> None:
    """Frames of a small field give weights that are evaluated on the held-out frame."""
    heard = Mock()
    data = write_field(tmp_path / "field", (32, 32))
    made = spectralzoom.train(data, tmp_path / "mine.safetensors", hold_out=["003"], progress=heard)
    assert made == tmp_path / "mine.safetensors"
    scores = spectralzoom.evaluate(data, weights=made, fractions=[0.25], progress=heard)
    assert scores["frames"] == ["003"]
    assert {"cross-validating", "imaging scenes"} <= {
        stage for stage, _, _ in (call.args for call in heard.call_args_list)
    }


def test_every_mistake_raises_the_error_of_the_package(make_weights: WeightsMaker, tmp_path: Path) -> None:
    """Mistakes of a caller raise spectralzoom.Error with the command line's messages."""
    out = tmp_path / "archive"
    with pytest.raises(spectralzoom.Error, match="did you mean 'budget'"):
        spectralzoom.survey(budjet=0.5, out=out)
    with pytest.raises(spectralzoom.Error, match="is not there"):
        spectralzoom.open(tmp_path / "nowhere")
    with pytest.raises(spectralzoom.Error, match=r"train has no 'stepps'; it has .*steps"):
        spectralzoom.train("farm", tmp_path / "x.safetensors", stepps=2)
    with pytest.raises(spectralzoom.Error, match=r"train: steps = 'many': .* integer"):
        spectralzoom.train("farm", tmp_path / "x.safetensors", steps="many")
    with pytest.raises(spectralzoom.Error, match="needs weights=FILE"):
        spectralzoom.evaluate("farm")
    with pytest.raises(spectralzoom.Error, match="evaluate has no 'fraction'"):
        spectralzoom.evaluate("farm", weights=make_weights(), fraction=[0.1])
    with pytest.raises(spectralzoom.Error, match=r"seed must be .* got -3"):
        spectralzoom.survey(seed=np.int64(-3), out=out)
    with pytest.raises(AttributeError, match="it has Error"):
        _ = spectralzoom.surveys
    assert not out.exists()

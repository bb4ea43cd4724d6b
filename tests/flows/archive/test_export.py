"""The export of surveys: images, cubes and catalogue agree with the archive's stores, with a pose and without."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import odc.geo.xr  # noqa: F401 - gives xarray its .odc
import pystac
import pytest
import rasterio
import xarray as xr

from spectralzoom.flows.archive.export_command import run_export
from spectralzoom.flows.archive.export_layers import ExportedRun
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, NoRunError, SettingsError
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive
from tests.conftest import QUIET
from tests.exported_run import POSE, Exported
from tests.prior_work import without_effects
from tests.storage.export.stac_rules import core_problems, is_cog
from tests.storage.small_archive import flip, publish_receipt


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> list[Exported]:
    """Return exports of one farm, without a pose and with one, from one archive into one folder."""
    archive, out = tmp_path_factory.mktemp("surveys") / "field #ä", tmp_path_factory.mktemp("exports").resolve()
    flags = {"size": "128x96", "bands": "20,60,100,150,200", "budget": "0.9", "engine": "plain"}
    settings = load_settings(None, {**flags, "out": str(archive), "seed": "1"})
    with without_effects():
        published = [run_survey(settings, QUIET), run_survey(settings.but(pose=POSE), QUIET)]
    return [
        Exported(archive, one.receipt, out, run_export(archive, one.folder.name, out, console=QUIET))
        for one in published
    ]


@pytest.fixture
def plain(exports: list[Exported]) -> Exported:
    """Return the survey without a pose."""
    return exports[0]


@pytest.fixture
def posed(exports: list[Exported]) -> Exported:
    """Return the survey with a pose."""
    return exports[1]


@pytest.mark.parametrize("number", [0, 1])
def test_images_are_cloud_optimised_and_attention_keeps_its_patches(exports: list[Exported], number: int) -> None:
    """The attention image has one pixel a patch, from the scene's corner on, with the scores of the store."""
    assert all(is_cog(exports[number].file(key)) for key in ("class_map", "confidence", "attention", "rgb"))
    done = exports[number]
    with rasterio.open(done.file("attention")) as file:
        np.testing.assert_array_equal(file.read(1), done.store("attention")["score"].values)
        patch = int(file.tags()["patch_px"])
        a, b, c, d, e, f = done.store("class_map").attrs["spatial:transform"]
        assert file.transform[:6] == pytest.approx((patch * a, b, c, d, patch * e, f))
        assert file.crs is None
        assert file.tags()["policy"] == "gain"


def test_images_with_a_pose_have_the_grid_of_the_store(posed: Exported) -> None:
    """CRS, transform and values by rasterio equal those that xarray and odc.geo read from the map's store."""
    store = posed.store("ground_map")
    box = store.odc.geobox
    for key, array in (("class_map", "classes"), ("confidence", "confidence"), ("rgb", "picture")):
        with rasterio.open(posed.file(key)) as file:
            assert file.crs.to_epsg() == box.crs.epsg == 32632
            assert file.transform == box.affine
            wanted = xr.open_zarr(store.encoding["source"], consolidated=False, mask_and_scale=False)[array].values
            np.testing.assert_array_equal(np.moveaxis(file.read(), 0, -1).reshape(wanted.shape), wanted)


def test_images_without_a_pose_have_angular_coordinates(plain: Exported) -> None:
    """They have no CRS, the store's transform in radians, its values, and a tag that says so."""
    store = xr.open_zarr(
        plain.archive / plain.receipt["products"]["class_map"], consolidated=False, mask_and_scale=False
    )
    for key, array in (("class_map", "classes"), ("confidence", "confidence")):
        with rasterio.open(plain.file(key)) as file:
            assert file.crs is None
            assert list(file.transform[:6]) == store.attrs["spatial:transform"]
            np.testing.assert_array_equal(file.read(1), store[array].values)
            assert "no CRS" in file.tags()["place"]
            assert "[rad]" in file.tags()["place"]
            assert key == "class_map" or np.isnan(file.nodata)
    with rasterio.open(plain.file("rgb")) as file:
        mosaic = plain.store("mosaic")
        assert list(file.transform[:6]) == mosaic.attrs["spatial:transform"]
        assert file.shape == mosaic["coverage"].shape
        np.testing.assert_array_equal(file.read().max(axis=0) > 0, mosaic["coverage"].values > 0)


@pytest.mark.parametrize("number", [0, 1])
def test_images_have_class_names_and_their_run(exports: list[Exported], number: int) -> None:
    """The tags also have product, time and program."""
    done = exports[number]
    names = done.store("class_map").attrs["class_names"]
    with rasterio.open(done.file("class_map")) as file:
        assert [file.tags(1)[f"CLASS_{place}"] for place in range(len(names))] == names
        tags = file.tags()
    product = ("class_map", "ground_map")[number]
    assert tags["run"] == done.id
    assert tags["product"] == done.receipt["products"][product]
    assert tags["surveyed"] == f"{done.receipt['started'][:4]}-06-21T11:00:00+00:00"  # of the built-in farm
    assert tags["TIFFTAG_SOFTWARE"].startswith("spectralzoom ")


def test_the_catalogue_is_valid_and_leads_to_every_file(exports: list[Exported]) -> None:
    """STAC's schemas accept it, pystac reads it, and every address is an existing file."""
    path = Path(exports[0].answer["collection"])
    assert core_problems(path) == []
    collection = pystac.Collection.from_file(str(path))
    items = list(collection.get_items(recursive=True))
    assert [item.id for item in items] == [done.id for done in exports]
    assert {item.get_parent().id for item in items} == {collection.id}
    for done, item in zip(exports, items, strict=True):
        assert core_problems(Path(done.answer["item"])) == []
        for asset in item.assets.values():
            assert re.fullmatch("[A-Za-z0-9._~/%-]+", asset.href)
            assert Path(unquote(str(asset.get_absolute_href()))).is_file()
            assert asset.roles
    assert {"class_map", "areas", "receipt"} <= set(items[0].assets)


@pytest.mark.parametrize(
    ("source", "visit", "observed"),
    [
        ("rig", "2026-06-21", ("2026-06-21T08:00:00Z", "2026-06-21T08:05:00Z")),
        ("rig", "2026-06-20", ("2026-06-20T00:00:00+00:00", "2026-06-20T23:59:59+00:00")),
        ("raster", "2026-06-21", ("2026-06-21T00:00:00+00:00", "2026-06-21T23:59:59+00:00")),
        ("raster", None, ("2026-06-21T08:00:00Z", "2026-06-21T08:05:00Z")),
    ],
)
def test_rigs_have_the_time_of_a_run(tmp_path: Path, source: str, visit: str | None, observed: tuple[str, str]) -> None:
    """A rig's time is that of its run, unless the visit names another date; a file's time is that of its visit."""
    receipt: Any = {"source": source, "started": "2026-06-21T08:00:00Z", "finished": "2026-06-21T08:05:00Z"}
    archive = Archive.open(tmp_path)
    folder = publish_receipt(archive, receipt, settings={"visit": visit})
    assert ExportedRun(archive, folder, receipt).observed == observed


def test_items_have_time_and_place(plain: Exported, posed: Exported) -> None:
    """The time is that of the farm's visit; geometry and CRS are present with a pose only."""
    item = posed.item()
    about = item["properties"]
    assert about["datetime"] == about["end_datetime"] == f"{posed.receipt['started'][:4]}-06-21T11:00:00Z"
    assert about["proj:epsg"] == 32632
    assert about["proj:transform"][:6] == list(posed.store("ground_map").odc.geobox.affine[:6])
    west, south, east, north = item["bbox"]
    assert west < 9.5001 < east + 1e-3
    assert 52.1 < south < north < 52.101
    assert plain.item()["geometry"] is None
    assert "proj:epsg" not in plain.item()["properties"]


def test_a_folder_of_another_catalogue_is_refused(posed: Exported, tmp_path: Path) -> None:
    """The message names the collection, or the item that cannot be read."""
    done = Path(shutil.copytree(posed.out, tmp_path / "out"))
    (done / "old").mkdir()
    (done / "old" / "old.json").write_text("{}")
    with pytest.raises(ArchiveError, match=r"old.json is no STAC item: .*; remove its folder and export again"):
        run_export(posed.archive, None, done, console=QUIET)
    path = done / "collection.json"
    path.write_text(path.read_text().replace(json.loads(path.read_text())["id"], "other"))
    with pytest.raises(ArchiveError, match="is the collection 'other' of another archive"):
        run_export(posed.archive, None, done, console=QUIET)
    path.write_text("no JSON")
    with pytest.raises(ArchiveError, match="cannot be read as STAC"):
        run_export(posed.archive, None, done, console=QUIET)


SHARED = ("collection.json", ".export.lock")  # shared by all runs in a folder


def test_a_second_export_has_the_same_bytes(posed: Exported) -> None:
    """The latest run, without its name and into another folder, gives the same files."""
    copy = posed.out.parent / "again"
    answer = run_export(posed.archive, None, copy, console=QUIET)
    assert answer["run"] == posed.id
    before = {path.relative_to(posed.out): path for path in posed.out.rglob("*") if posed.id in path.parts}
    again = {path.relative_to(copy): path for path in copy.rglob("*") if path.name not in SHARED}
    again.pop(Path(posed.id))
    assert set(again) == {name for name in before if name != Path(posed.id)}
    files = {name: path for name, path in again.items() if path.is_file()}
    changed = [name for name, path in files.items() if path.read_bytes() != before[name].read_bytes()]
    shutil.rmtree(copy)
    assert changed == []


def test_missing_runs_and_bad_folders_are_refused(posed: Exported, tmp_path: Path) -> None:
    """The message lists runs, or names the place in the archive or below a file; the archive still verifies."""
    with pytest.raises(NoRunError, match=f"no run 'x'; its latest are .*{posed.id}"):
        run_export(posed.archive, "x", tmp_path / "out", console=QUIET)
    Archive.open(tmp_path / "empty")
    with pytest.raises(NoRunError, match="has no run; survey into it first"):
        run_export(tmp_path / "empty", None, tmp_path / "out", console=QUIET)
    assert not (tmp_path / "out").exists()
    with pytest.raises(SettingsError, match="lies in the archive"):
        run_export(posed.archive, None, posed.archive / "export", console=QUIET)
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file", tmp_path / "file" / "below", tmp_path / "not UTF-8 \udcff"):
        with pytest.raises(ArchiveError, match=r"cannot export to .*; choose another --out"):
            run_export(posed.archive, None, out, console=QUIET)
    assert (tmp_path / "file").read_text() == "mine"
    assert all(finding.problem is None for finding in verify_everything(Archive.open(posed.archive)))


def test_a_missing_store_is_reported(posed: Exported, tmp_path: Path) -> None:
    """The message has the store and a remedy, and no catalogue is written."""
    archive = Path(shutil.copytree(posed.archive, tmp_path / "field-a"))
    shutil.rmtree((archive / posed.receipt["products"]["attention"]).parent)
    with pytest.raises(IncompleteStoreError, match=r"is damaged: it is not there; restore it from a copy"):
        run_export(archive, posed.id, tmp_path / "out", console=QUIET)
    assert not (tmp_path / "out" / "collection.json").exists()


def test_leftovers_of_a_killed_export_are_removed(posed: Exported, tmp_path: Path) -> None:
    """The next export of the run removes them; the run may be named with its folder."""
    for folder in (tmp_path, tmp_path / posed.id):
        (folder / ".export-x.part").mkdir(parents=True)
    assert run_export(posed.archive, f"runs/{posed.id}/", tmp_path, console=QUIET)["run"] == posed.id
    assert not list(tmp_path.rglob("*.part"))


def test_a_damaged_store_gives_no_image(posed: Exported, tmp_path: Path) -> None:
    """After a flipped bit the message names store and array."""
    archive = Path(shutil.copytree(posed.archive, tmp_path / "field-a"))
    classes = archive / posed.receipt["products"]["ground_map"] / "classes"
    flip(next(path for path in sorted(classes.rglob("*")) if path.is_file() and path.name != "zarr.json"), at=40)
    with pytest.raises(IncompleteStoreError, match=r"ground_map.*classes"):
        run_export(archive, posed.id, tmp_path / "out", console=QUIET)
    assert not list((tmp_path / "out").rglob("*.tif"))

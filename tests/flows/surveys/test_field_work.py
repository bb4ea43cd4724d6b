"""Scores and map of a field by regions: equal to those of the whole field if the regions' halo covers it."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from spectralzoom.flows.frame import Prior
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.planning.patch_budget import SHARD
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.stages.drawing import Drawing, draw_field, prior_map_of
from spectralzoom.flows.stages.field_work import FieldWork, Scoring, WeightsFile, overview_file
from spectralzoom.models.network.sizes import CELL_PX, TOKEN_PX
from spectralzoom.models.reading.regions import plan_regions
from spectralzoom.models.weights.files import describe_weights, load_weights, save_weights
from spectralzoom.pipeline.errors import SettingsError, WeightsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.storage.arrays.class_maps import (
    MAP,
    PROBABILITIES,
    ClassNames,
    create_class_map,
    create_probabilities,
)
from spectralzoom.storage.arrays.layout import consolidate_stores, open_group, read_array
from spectralzoom.storage.parallel.pool import WorkerPool
from spectralzoom.storage.store import Ref
from tests.conftest import Flags, Survey

Surveyed = tuple[SurveyPlan, Path]
MOST_PX = (64, 640)  # of 96 x 128 px: two regions
ALL_PX = 96  # a halo that reaches over the whole field


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey, flags_png: Flags) -> Surveyed:
    """Return a survey of scene.png that keeps the mosaic of the first pass, and the folder of its stages."""
    out = tmp_path_factory.mktemp("field") / "archive"
    with mock.patch("spectralzoom.flows.survey.clear_intermediate"):
        survey_png(out)
    return plan_survey(open_field(load_settings(None, flags_png(out, budget="0.8")))), out / "stages"


def _store(stages: Path, stage: str) -> Ref:
    (path,) = (stages / stage).iterdir()
    return Ref(stage, path.name, path)


def _mosaics(stages: Path) -> list[Ref]:
    """Return the mosaics of both passes, the coarse one first."""
    return [_store(stages, name) for name in ("rectify", "rectify_fine")]


def _work(plan: SurveyPlan, pool: WorkerPool, halo: int) -> FieldWork:
    return replace(
        plan.reading.gains.work, regions=plan_regions(plan.field.grid, SHARD, most_px=MOST_PX, halo=halo), pool=pool
    )


def _draw(
    work: FieldWork, plan: SurveyPlan, stages: Path, out: Path, least_gain: float | None = None
) -> dict[str, bytes]:
    """Return the bytes of the map that this work writes into a new folder."""
    legend = ClassNames(plan.field.model.load().class_names, plan.field.model.load().class_colours)
    out.mkdir()
    create_class_map(out / MAP, plan.field.scene.shape, legend, grid=plan.field.frame.angular_grid())
    create_probabilities(out / PROBABILITIES, plan.field.scene.shape, legend, grid=plan.field.frame.angular_grid())
    drawing = Drawing(work.weights, _mosaics(stages)[1], _store(stages, "score"), plan.capture)
    draw_field(work, drawing, out, least_gain, lambda done: None)
    assert sorted(path.name for path in out.iterdir()) == [MAP, PROBABILITIES]  # no overview is left
    consolidate_stores(out)  # as published stores are
    return _contents(out / MAP)


def _contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("pool", [WorkerPool(workers=1), WorkerPool(workers=2)], ids=["one", "two"])
def test_regions_with_a_full_halo_give_the_same_map(surveyed: Surveyed, tmp_path: Path, pool: WorkerPool) -> None:
    """The bytes are equal for one and two workers; the stage's own map is that of one region."""
    plan, stages = surveyed
    stored = _contents(_store(stages, "segment").path / MAP)
    assert len(_work(plan, pool, ALL_PX).regions) == 2
    assert _draw(_work(plan, pool, ALL_PX), plan, stages, tmp_path / "m") == stored
    assert _draw(plan.reading.gains.work, plan, stages, tmp_path / "one") == stored


@pytest.mark.parametrize(("overviews", "stored"), [(16, True), (16, False), (1, True)])
def test_regions_choose_patches_by_the_classes_of_the_field(
    surveyed: Surveyed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overviews: int, stored: bool
) -> None:
    """With a halo over the whole field they choose as one region does."""
    plan, stages = surveyed
    gain = plan.reading.gains.work.score("gain", _mosaics(stages)[1], plan.capture, lambda done: None)
    least = float(np.quantile(gain, 0.7)) + 1e-9
    monkeypatch.setattr("spectralzoom.flows.stages.drawing.MOST_OVERVIEWS", overviews)
    if not stored:  # an overview that was not kept is computed again
        monkeypatch.setattr("spectralzoom.flows.stages.drawing.load_overview", lambda path, weights: None)
    regions = _draw(_work(plan, WorkerPool(workers=2), ALL_PX), plan, stages, tmp_path / "m", least)
    whole = _draw(plan.reading.gains.work, plan, stages, tmp_path / "one", least)
    assert (regions == whole) == (overviews == 16)  # one of two regions has other classes
    assert regions != _contents(_store(stages, "segment").path / MAP)


@pytest.mark.parametrize(
    ("policy", "halo_px", "within"),
    [("gain", ALL_PX, 1e-12), ("entropy", ALL_PX, 0), ("sobel", ALL_PX, 0), ("sobel", 32, 1e-5)],
)
def test_scores_of_regions_equal_those_of_the_field(
    surveyed: Surveyed, policy: str, halo_px: int, within: float
) -> None:
    """The halo covers the field, or one patch, which edges need; the stage's own scores are the same for its policy."""
    plan, stages = surveyed
    mosaic = _mosaics(stages)[0]
    whole = plan.reading.gains.work.score(policy, mosaic, plan.capture, lambda done: None)
    parts = _work(plan, WorkerPool(workers=2), halo_px).score(policy, mosaic, plan.capture, lambda done: None)
    np.testing.assert_allclose(parts, whole, rtol=within)  # gains are sums over the field
    if policy == plan.settings.policy:
        assert (read_array(open_group(_store(stages, "score").path / "attention.zarr"), "score") == whole).all()


def test_pickled_work_contains_its_weights(surveyed: Surveyed, tmp_path: Path) -> None:
    """A worker uses the weights that were sent, whatever file is at their path."""
    plan, stages = surveyed
    copy = tmp_path / "w.safetensors"
    copy.write_bytes(plan.reading.gains.work.weights.path.read_bytes())
    scoring = Scoring(
        replace(plan.reading.gains.work.weights, path=copy), _mosaics(stages)[0], plan.capture, policy="entropy"
    )
    sent = pickle.dumps((scoring, plan.reading.gains.work.regions[0]))
    assert len(sent) < copy.stat().st_size + 2000
    expected = scoring(plan.reading.gains.work.regions[0])
    copy.write_bytes(b"other weights")
    travelled, region = pickle.loads(sent)
    assert (travelled(region) == expected).all()


@pytest.mark.parametrize(
    ("pool", "words"), [(WorkerPool(), "the process itself"), (WorkerPool("processes"), "each of two proc")]
)
def test_too_little_memory_is_refused(surveyed: Surveyed, tmp_path: Path, pool: WorkerPool, words: str) -> None:
    """The message gives the memory of a region and the minimum, and that minimum suffices."""
    work = replace(surveyed[0].reading.gains.work, pool=pool, memory=300 * 2**20)
    with pytest.raises(SettingsError, match=rf"exceeds --memory 300 MiB: .*96 x 128 px.*{words}") as refused:
        work.pool_for(np.arange(192), 3)
    least = int(str(refused.value).split("--memory")[-1].split()[0])
    replace(work, memory=least * 2**20).pool_for(np.arange(192), 3)


def test_simultaneous_regions_fit_into_the_memory(surveyed: Surveyed) -> None:
    """A worker pool shrinks to fit, and keeps its size if all of it fits."""
    work = replace(surveyed[0].reading.gains.work, pool=WorkerPool(workers=7))
    assert work.pool_for(np.arange(9), 3) is work.pool
    pools = [replace(work, memory=size * 2**20).pool_for(np.arange(9), 3).workers for size in (516, 520, 600)]
    assert pools == sorted(pools, key=int)
    assert pools[0] < pools[-1] == 7


def test_weights_that_changed_are_refused(tmp_path: Path, weights: Path) -> None:
    """A worker does not use another file than the survey began with."""
    copy = tmp_path / "w.safetensors"
    copy.write_bytes(weights.read_bytes())
    with pytest.raises(WeightsError, match=r"w\.safetensors have changed since the survey began"):
        WeightsFile(copy, "0" * 20, "key").load()


def test_weights_are_those_that_were_described(tmp_path: Path, weights: Path) -> None:
    """Between its description and its tensors a file may be replaced by one with the same names."""
    path = tmp_path / "w.safetensors"
    path.write_bytes(weights.read_bytes())
    described = describe_weights(path)
    loaded = load_weights(path, described)
    save_weights(replace(loaded, class_colours=loaded.class_colours + np.uint8(1)), path)
    with pytest.raises(WeightsError, match="or changed while it was read"):
        load_weights(path, described)


@pytest.mark.parametrize("size", [(640, 640), (641, 90), (90, 641)])
def test_keys_contain_regions_for_divided_fields_only(size: tuple[int, int]) -> None:
    """The pool and the memory do not count; a field of more than 640 px gives another result in regions."""
    regions, file = plan_regions(SceneGrid(*size, 16), SHARD), WeightsFile(Path("w"), "seal", "key")
    keys = [FieldWork(file, regions, WorkerPool(workers=count), count).key for count in (1, 2)]
    assert (keys[0]["regions"] is not None) == (max(size) > 640)
    assert keys[0] == keys[1]


def test_a_prior_map_has_no_seams_between_regions(surveyed: Surveyed) -> None:
    """Features come from outside of a region's halo, as far as the field has them."""
    plan, stages = surveyed
    classes = tuple(range(len(plan.field.model.load().class_names)))
    before = Prior("a run", _store(stages, "segment"), _mosaics(stages)[0], 1.0, None, classes)
    (field,) = plan_regions(plan.field.grid, SHARD)
    whole = prior_map_of(before, field, plan.field.model.load()).coarse
    assert whole is not None
    for region in plan_regions(plan.field.grid, SHARD, most_px=MOST_PX, halo=16):
        here = region.read.over(CELL_PX)
        found = prior_map_of(before, region, plan.field.model.load()).coarse
        np.testing.assert_array_equal(found, whole[here.rows, here.columns])


def test_overviews_are_read_again_around_changed_patches(surveyed: Surveyed, tmp_path: Path) -> None:
    """With all patches changed they are those of the second mosaic, with none those of the first one."""
    plan, stages = surveyed
    first, second = _mosaics(stages)
    work = _work(plan, WorkerPool(workers=2), plan.field.described.config.halo_px)
    every = plan.field.grid.every_patch()
    folders = {name: tmp_path / name for name in ("first", "second", "all", "none", "some")}
    for folder in folders.values():
        folder.mkdir()
    work.write_overviews(first, plan.capture, folders["first"], lambda done: None)
    work.write_overviews(second, plan.capture, folders["second"], lambda done: None)
    for name, changed in (("all", every), ("none", every[:0]), ("some", every[:1])):
        work.renew_overviews(second, plan.capture, folders[name], folders["first"], changed)
    kept = {name: _kept(work, folder) for name, folder in folders.items()}
    np.testing.assert_array_equal(kept["all"], kept["second"])
    np.testing.assert_array_equal(kept["none"], kept["first"])
    renewed = (kept["some"] != kept["first"]).any(axis=0)
    assert renewed[0, 0]
    assert not renewed[TOKEN_PX:].any()
    assert not renewed[:, TOKEN_PX:].any()


def _kept(work: FieldWork, folder: Path) -> np.ndarray:
    """Return the overviews (feature, y, x) of a field that is cut from top to bottom."""
    parts = [np.load(overview_file(folder, region))[0][:, *region.kept_here] for region in work.regions]
    return np.concatenate(parts, axis=1)

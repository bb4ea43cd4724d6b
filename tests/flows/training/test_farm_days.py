"""The farm with its season: one land on all days, keys that name the day, and training on these days."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spectralzoom.flows.archive.reprocess_command import asked_again, newest_runs
from spectralzoom.flows.opening.scene import farm_refusal, open_scene
from spectralzoom.flows.settings.settings import Settings, parse_settings
from spectralzoom.flows.training.data import farm_days, farm_test_data, open_training_data, read_farm_name
from spectralzoom.flows.training.train_scenes import TrainRequest, observe_all
from spectralzoom.models.network.spectral import SpectralBasis
from spectralzoom.models.training.examples import observe, observe_scene
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASSES
from spectralzoom.pipeline.simulator.scenes.farm.land import sun_over_farm
from spectralzoom.pipeline.simulator.scenes.laws import FARM_LAW
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.storage.runs import Catalogue
from spectralzoom.storage.store import Archive
from tests.storage.small_archive import publish_receipt

BANDS = (20, 60, 110, 160, 210, 250)


def _settings(**table: Any) -> Settings:
    return parse_settings({"scene": FARM_LAW, "size": "240x200", "bands": BANDS, **table})


def _lines(scene: RasterScene) -> np.ndarray[Any, Any]:
    """Return the mask of tracks and water, which are at the same place on all days."""
    assert scene.labels is not None
    return np.isin(scene.labels, [CLASSES.index(name) for name in ("track", "water")])


def test_two_days_of_a_field_share_one_land() -> None:
    """Tracks and ditches keep their place and more than 10 % of the labels change; the key holds day and hour."""
    june, april = (open_scene(_settings(seed=5, day=day))[0] for day in (172, 100))
    there, then = _lines(june), _lines(april)
    assert np.count_nonzero(there & then) > 0.8 * np.count_nonzero(there | then) > 1000
    assert np.mean(june.labels != april.labels) > 0.1
    given: list[dict[str, int]] = [{}, {"day": 173}, {"hour": 9}, {"day": 172, "hour": 11}]
    assert len({open_scene(_settings(**moment))[0].key for moment in given}) == 3
    assert open_scene(_settings(day=173))[0].key.startswith("farm@2/seed=0/day=173/shape=200x240/hour=11/bands=270")


def test_night_is_refused() -> None:
    """The sun must be above the horizon: 3 o'clock on day 355 is refused."""
    with pytest.raises(SceneError, match="sun"):
        open_scene(_settings(day=355, hour=3))


def _publish(archive: Archive, key: str, **settings: Any) -> str:
    receipt = {"survey": "farm", "scene": key, "settings": settings, "products": {"class_map": "stages/segment/aaaa/m"}}
    return publish_receipt(archive, receipt).name


def test_the_default_day_of_a_farm_is_one_field(tmp_path: Path) -> None:
    """Both names of the farm, with the day named or left out, are one field; another day is another field."""
    archive = Archive.open(tmp_path)
    key = "farm@2/seed=0/day=172/shape=8x8/hour=11/bands=9"
    made = [
        _publish(archive, key, scene="farm"),
        _publish(archive, key, scene="farm@2", day=172),
        _publish(archive, key.replace("172", "173"), scene="farm@2", day=173),
    ]
    assert [run.folder.name for run in newest_runs(Catalogue.read(Archive(tmp_path)))] == made[1:]
    again = [asked_again(run, tmp_path, None) for run in Catalogue.read(Archive(tmp_path)).runs]
    assert [(one.scene, one.day) for one in again] == [("farm", None), (FARM_LAW, 172), (FARM_LAW, 173)]


def test_training_days_cover_the_season() -> None:
    """Each month from April to October has training days with enough sun; test days and seeds differ; names parse."""
    data = open_training_data("farm", 3, None, LineCamera())
    learnt = [read_farm_name(name) for name in data.train]
    judged = [read_farm_name(name) for name in (*data.validation, *farm_test_data(4, LineCamera()).train)]
    assert np.histogram([day for _, day, _ in learnt], np.linspace(91, 305, 8))[0].min() >= 5
    for _, day, hour in (*learnt, *judged):
        assert sun_over_farm(day, hour).elevation_deg > 15
    assert not {day for _, day, _ in learnt} & {day for _, day, _ in judged}
    seeds = {seed for seed, _, _ in (*learnt, *judged)}
    assert len(seeds) == len(learnt) + len(judged)
    assert min(seeds) >= 100_000  # far above those a user tries
    assert data.law == FARM_LAW
    assert [read_farm_name(name)[0] for name in farm_days(7, 2)] == [7, 8]
    assert read_farm_name("100003-day-168-hour-14") == (100_003, 168, 14.0)


def test_training_mixes_built_in_scenes() -> None:
    """For names with commas each law gives a part of the scenes, on days with crops, and has test scenes of its own."""
    data = open_training_data("farm@2, scouting", None, 7, LineCamera())
    assert data.law == "farm@2,scouting@1"
    scouted = [name for name in data.train if name.startswith("scouting-")]
    assert (len(data.train), len(scouted), len(data.validation)) == (7, 3, 6)
    assert data.train[:4] == open_training_data("farm", None, 4, LineCamera()).train
    assert all(136 <= read_farm_name(name)[1] <= 201 for name in scouted)
    assert [data.scene(name).name for name in (data.train[0], scouted[0])] == ["farm", "scouting"]
    assert open_training_data("scouting@1", 0, 3, LineCamera()).train == tuple(scouted)
    judged = farm_test_data(2, LineCamera(), "scouting").train
    assert not {read_farm_name(name)[0] for name in judged} & {read_farm_name(name)[0] for name in scouted}


@pytest.mark.parametrize("bands", [BANDS, tuple(range(0, 270, 5))])
def test_training_scenes_have_the_effects_of_the_rig(bands: tuple[int, ...]) -> None:
    """Blur and shading change the columns a little beyond footprint and noise; many bands come with a noise model."""
    scene = open_scene(_settings(seed=5, size="96x64", bands=bands))[0]
    camera = LineCamera(samples=96)
    grid = SceneGrid(*scene.shape, 8)
    basis = SpectralBasis.spanning(scene.wavelength_nm, 6)
    seen = observe_scene(scene, camera, grid, basis, np.random.default_rng(3))
    plain = observe(scene, camera, grid, basis, np.random.default_rng(3))
    np.testing.assert_array_equal(seen.labels, plain.labels)
    assert seen.columns.shape == plain.columns.shape
    assert 0.01 * plain.columns.std() < np.abs(seen.columns - plain.columns).mean() < 0.2 * plain.columns.std()
    assert (seen.noise.spectra is not None) == (bands != BANDS)
    if seen.noise.spectra is not None:
        spectra = seen.noise.spectra
        np.testing.assert_allclose(spectra.condensing(1.0).mean, seen.columns[:64, :96].mean(axis=(0, 1)), rtol=0.02)
        sigma = np.sqrt(np.sum(spectra.noise(1.0), axis=0))
        power = np.linalg.eigvalsh(spectra.covariance / np.outer(sigma, sigma))
        assert power[-1] > 1000
        assert abs(np.median(power)) < 0.3  # most directions have noise alone, which is taken out


@pytest.mark.parametrize(("size", "measured"), [("1280x1024", 1.42e9), ("2560x2048", 1.57e9)])
def test_a_farm_larger_than_the_memory_is_refused(size: str, measured: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with the measured bytes of a survey is too small; 10 % more suffice."""
    for there, refused in ((measured, True), (1.1 * measured, False)):
        monkeypatch.setattr("spectralzoom.flows.opening.scene.machine_bytes", lambda there=there: int(there))
        assert (farm_refusal(_settings(size=size)) is not None) == refused


def test_each_scene_has_a_noise_stream_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """No two scenes of training or validation share a random stream."""
    streams: list[int] = []

    def imaged(
        scene: RasterScene, camera: LineCamera, grid: SceneGrid, basis: Any, rng: Any, *, captured: bool
    ) -> None:
        streams.append(rng.bit_generator.state["state"]["state"])

    monkeypatch.setattr("spectralzoom.flows.training.train_scenes.observe_scene", imaged)
    monkeypatch.setattr("spectralzoom.flows.training.train_scenes.trained_pixels", lambda scene: np.ones(1, bool))
    data = open_training_data("farm", 2, 2, LineCamera())
    observe_all(TrainRequest("farm", Path()), data, lambda what, done, figure: None)
    assert len(set(streams)) == len(streams) == 4

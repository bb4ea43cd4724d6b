"""Scenes and weights that are small enough for a whole survey in about a second."""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import settings as law_settings
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console

from spectralzoom.flows import survey_command
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.models.network.segmenter import Segmenter
from spectralzoom.models.network.sizes import SegmenterConfig
from spectralzoom.models.network.spectral import Normalisation, SpectralBasis
from spectralzoom.models.weights.files import Weights, save_weights, with_record
from spectralzoom.storage.readers.labels import DEFAULT_COLOURS
from tests.object_server import bucket, s3_server  # noqa: F401 - fixtures
from tests.prior_work import remember, with_effects, without_effects
from tests.zarr_at_once import close_loops, work_at_once

QUIET = Console(quiet=True)
RGB_NM = (640.0, 550.0, 460.0)
CLASSES = ("class_0", "class_1", "class_2")  # as a label file with the numbers 0..2 names them

WeightsMaker = Callable[..., Path]
Survey = Callable[..., Published]
Flags = Callable[..., dict[str, Any]]
os.environ.setdefault("OMP_NUM_THREADS", "1")  # for child processes; workers on shared cores lose most time
torch.set_num_threads(1)
law_settings.register_profile("anew", deadline=None, max_examples=40)  # no deadline: a loaded machine breaks no law
law_settings.register_profile("settled", law_settings.get_profile("anew"), derandomize=True)  # fails after changes only
law_settings.load_profile("settled")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Exclude all objects of import and collection from garbage collection, for the rest of the session."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def random_weights(wavelength_nm: tuple[float, ...], names: tuple[str, ...] = CLASSES, **sizes: Any) -> Weights:
    """Return a tiny segmenter with random weights for bands at these wavelengths."""
    basis = SpectralBasis.spanning(np.array(wavelength_nm), 4)
    small = {"patch": 8, "width": 8, "overview_width": 4, "dim": 16, "layers": 1, "heads": 2}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        model = Segmenter(SegmenterConfig(len(names), basis.columns, **{**small, **sizes})).eval()
        for parameter in model.parameters():
            if not parameter.any():  # training starts some terms at zero; here every term has an effect
                torch.nn.init.normal_(parameter, std=0.3)
        for last in (model.overview_classes, model.full_classes):  # values decide, so that maps have every class
            torch.nn.init.normal_(last.weight, std=2.0)
            with torch.no_grad():
                last.weight -= last.weight.mean(dim=1, keepdim=True)  # the brightness of all channels favours no class
        with torch.no_grad():
            for number, row in enumerate(model.spectral.weight):  # a class for each hue, so that maps have several
                turn = 2 * np.pi * (number / len(names) + np.arange(len(row)) / len(row))
                row[:, 0, 0] = torch.from_numpy(6 * np.cos(turn))
            for head in (model.overview_head, model.full_head):
                for up in head.up:
                    up.weight *= 0.1  # a pixel's own value decides
                    up.bias.zero_()
            torch.nn.init.zeros_(last.bias)
    one = np.ones(basis.columns, np.float32)
    normalisation = Normalisation(110 * one, 40 * one, np.eye(basis.columns, dtype=np.float32))
    colours = np.array([DEFAULT_COLOURS[number] for number in range(len(names))], np.uint8)
    return Weights(model, basis, normalisation, names, colours, {"seed": 5})


def patchy_scene(shape: tuple[int, int], bands: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return blocks of three classes with a texture: values 0..255 (y, x, band), labels (y, x) 0..2."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 3, (-(-shape[0] // 11), -(-shape[1] // 11)), dtype=np.uint8)
    labels = np.repeat(np.repeat(small, 11, axis=0), 11, axis=1)[: shape[0], : shape[1]]
    colours = rng.uniform(50, 200, (3, bands))
    values = colours[labels] + rng.normal(0, 12, (*shape, bands))
    return np.clip(values, 0, 255).astype(np.float32), labels


@pytest.fixture(scope="session", autouse=True)
def prior_work(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Share results that surveys of one scene and rig have in common between all workers of a session."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with pytest.MonkeyPatch.context() as patch:
        remember(shared / "prior_map", patch.setattr)
        yield


@pytest.fixture(scope="session", autouse=True)
def no_waiting() -> Iterator[None]:
    """Skip the waiting for the disk (about 300 fsync calls a survey) and garbage collections in surveys."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        patch.setattr(survey_command, "gc", SimpleNamespace(collect=int))
        yield


@pytest.fixture(scope="session", autouse=True)
def zarr_in_this_thread() -> Iterator[None]:
    """Run every Zarr call in the calling thread: see `tests.zarr_at_once`."""
    with pytest.MonkeyPatch.context() as patch:
        work_at_once(patch)
        yield
    close_loops()


@pytest.fixture
def no_effects() -> Iterator[None]:
    """Run surveys without the automatic choice of effects; only effects that the settings name are simulated."""
    with without_effects():
        yield


@pytest.fixture(scope="session")
def make_weights(tmp_path_factory: pytest.TempPathFactory) -> WeightsMaker:
    """Return a maker of weight files: ``make_weights(wavelengths, names, scans=..., factor=...)`` gives the path."""
    folder = tmp_path_factory.mktemp("weights")

    def make(
        wavelength_nm: tuple[float, ...] = RGB_NM,
        names: tuple[str, ...] = CLASSES,
        scans: dict[str, Any] | None = None,
        **sizes: Any,
    ) -> Path:
        path = folder / f"{len(list(folder.iterdir()))}.safetensors"
        made = random_weights(wavelength_nm, names, **sizes)
        save_weights(made if scans is None else with_record(made, scans=scans), path)
        return path

    return make


@pytest.fixture(scope="session")
def weights(make_weights: WeightsMaker) -> Path:
    """Return tiny weights for red, green and blue."""
    return make_weights()


@pytest.fixture(scope="session")
def scene_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with scene.png (96 x 128 px), labels.png (numbers) and cube.npy (40 x 56 px, 6 bands)."""
    folder = tmp_path_factory.mktemp("scenes")
    values, labels = patchy_scene((96, 128), 3, seed=1)
    Image.fromarray(values.astype(np.uint8)).save(folder / "scene.png")
    Image.fromarray(labels).save(folder / "labels.png")
    np.save(folder / "cube.npy", patchy_scene((40, 56), 6, seed=2)[0])
    return folder


@pytest.fixture(scope="session")
def flags_png(scene_files: Path, weights: Path) -> Flags:
    """Return a function that gives the flags of a simulated survey of scene.png; keywords change or add flags."""
    given = {"scene": str(scene_files / "scene.png"), "source": "sim", "weights": str(weights)}
    return lambda out, **flags: {**given, "out": str(out), **flags}


@pytest.fixture(scope="session")
def survey_png(scene_files: Path, flags_png: Flags) -> Survey:
    """Return a function that surveys scene.png with its labels by the simulated rig; a keyword of None drops a flag."""

    def survey(out: Path, console: Console | None = None, **flags: Any) -> Published:
        labels = str(scene_files / "labels.png")
        given = flags_png(out, labels=labels, engine="plain", budget="0.8")
        return survey_command.run_survey(load_settings(None, given | flags), console or QUIET)

    return survey


@pytest.fixture(scope="session")
def surveyed_png(survey_png: Survey, tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """Return a function that copies the session's one survey of scene.png to a folder, as ``survey_png(out)`` gives."""
    made: list[tuple[Path, Published]] = []

    def copy(out: Path) -> Published:
        if not made:
            root = tmp_path_factory.mktemp("surveyed") / "archive"
            with with_effects():  # the same effects, whichever test calls first
                made.append((root, survey_png(root)))
        root, published = made[0]
        shutil.copytree(root, out, dirs_exist_ok=True)
        return replace(published, folder=out / published.folder.relative_to(root))

    return copy


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of the real data sets; skip tests that need it if it is absent."""
    folder = Path(os.environ.get("SPECTRALZOOM_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder} (set SPECTRALZOOM_DATA)")
    return folder

"""One small field, surveyed twice: the tests of each page begin with a copy of it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.conftest import Survey, WeightsMaker, patchy_scene
from tests.docs.instrument_files import write_drone_files, write_instrument_files
from tests.prior_work import without_effects

CAMERA = "[camera]\nsamples = 320\n"  # narrow, as most time of a small survey goes into samples outside of the field
SETTINGS = (
    'name = "{name}"\nsource = "sim"\nscene = "field.png"\nlabels = "labels.png"\nweights = "mine.safetensors"\n'
    f"budget = 0.8\n{CAMERA}"
)
CLASSES = 'labels = "labels/{number}_labels.png"\n[classes]\nclass_0 = 0\nclass_1 = 1\nclass_2 = 2\n'
HEADER = "ENVI\nsamples = 40\nlines = 24\nbands = 3\ndata type = 4\ninterleave = bip\nbyte order = 0\n"


@pytest.fixture(scope="session")
def surveyed(
    tmp_path_factory: pytest.TempPathFactory,
    scene_files: Path,
    weights: Path,
    make_weights: WeightsMaker,
    survey_png: Survey,
) -> Path:
    """Return a folder with pictures, labels, a cube, weights, settings of two fields, and an archive of two surveys."""
    folder = tmp_path_factory.mktemp("surveyed")
    for name, source in {"field.png": "scene.png", "labels.png": "labels.png"}.items():
        shutil.copy(scene_files / source, folder / name)
    shutil.copy(weights, folder / "mine.safetensors")
    shutil.copy(make_weights(dim=24), folder / "newer.safetensors")
    patchy_scene((24, 40), 3, seed=3)[0].tofile(folder / "cube.img")
    (folder / "cube.hdr").write_text(HEADER + "wavelength units = nm\nwavelength = {640, 550, 460}\n")
    for number in ("001", "002"):
        values, labels = patchy_scene((64, 64), 3, seed=int(number))
        image = values.astype(np.uint8)
        colours = np.array([(0, 0, 0), (0, 255, 0), (255, 0, 0)], np.uint8)
        pictures = {
            **{f"fields/images/{number}_image.png": image, f"fields/labels/{number}_labels.png": labels},
            **{f"meadow/images/{number}.png": image, f"meadow/masks/{number}.png": colours[labels]},  # no scene.toml
        }
        for path, picture in pictures.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture).save(folder / path)
    (folder / "fields" / "scene.toml").write_text(CLASSES)
    for file, name in {"north": "north", "south": "south", "survey": "north"}.items():
        (folder / f"{file}.toml").write_text(SETTINGS.format(name=name))
    (folder / "camera.toml").write_text(CAMERA)
    write_instrument_files(folder)
    write_drone_files(folder)
    with without_effects():
        for given in ({"budget": "0.6"}, {"accuracy": False}):
            survey_png(folder / "archive", name="north", **{"camera.samples": 320}, **given)
    return folder


@pytest.fixture
def place(surveyed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of that folder as the current directory."""
    folder = shutil.copytree(surveyed, tmp_path / "place")
    monkeypatch.chdir(folder)
    return folder

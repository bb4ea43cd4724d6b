"""A folder of pictures and labels becomes a scene.toml, weights and a survey with the commands' messages alone."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from affine import Affine
from PIL import Image

from spectralzoom.flows.evaluate.frames import open_candidates, open_frames, sort_frames
from spectralzoom.flows.opening.scene import open_scene
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.training.data import load_data_set, open_training_data
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.storage.readers.scene_toml import load_scene_settings
from tests.flows.conftest import command_line
from tests.storage.readers.test_label_grids import write
from tests.users.mistaken_files import write_files

__all__ = ["command_line"]

SMALL = ["--steps", "1"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folders of a user with their own data; tests copy or restore what they change."""
    here = tmp_path_factory.mktemp("folders")
    write_files(here)
    return here


@pytest.mark.parametrize("folder", ["apart", "beside", "lacking", "tiles", "hidden", "one_of_each"])
def test_the_scene_toml_of_init_reads_like_the_folder(folder: str, made: Path, command_line: Any) -> None:
    """With the written scene.toml every image keeps the labels found by name, in the same classes."""
    path = made / folder
    before = load_data_set(path)
    seen = {name: before.load(name).labels for name in before.label_files}
    ended = command_line("init", path, "--json")
    assert ended.code == 0, ended.err
    after = load_data_set(path)
    assert (list(after.files), after.label_files, after.alone) == (list(before.files), before.label_files, before.alone)
    for name, labels in seen.items():
        np.testing.assert_array_equal(after.load(name).labels, labels)
    assert tuple(load_scene_settings(path / "scene.toml").classes) == after.load(next(iter(seen))).class_names
    assert "its fraction of the labelled pixels" in (path / "scene.toml").read_text()
    assert json.loads(ended.out)["next"].startswith("spectralzoom train ")


def test_init_keeps_an_existing_scene_toml(made: Path, command_line: Any) -> None:
    """With --force init renames it to scene.toml.old; if init fails, the file stays unchanged."""
    (made / "bad_key" / "labels").mkdir()
    for name in ("001", "002"):
        Image.fromarray(np.eye(32, dtype=np.uint8)[:24]).save(made / "bad_key" / "labels" / f"{name}.png")
    old = (made / "bad_key" / "scene.toml").read_bytes()
    assert command_line("init", made / "bad_key", "--force").code == 0
    assert load_scene_settings(made / "bad_key" / "scene.toml").classes == {"class_0": 0, "class_1": 1}
    assert (made / "bad_key" / "scene.toml.old").read_bytes() == old
    (made / "hollow" / "labels").mkdir(parents=True)
    (made / "hollow" / "scene.toml").write_text("nodata = 0\n")
    command_line("init", made / "hollow", "--force").refused(1, "holds no image")
    assert (made / "hollow" / "scene.toml").read_text() == "nodata = 0\n"


def test_init_lists_unusable_files_and_missing_facts(made: Path, command_line: Any) -> None:
    """It lists images without labels, labels without images, other sizes or bands, a single class, no wavelengths."""
    for folder, words in {
        "lacking": ["labels of 1 image, left out", "the image of 1 label file: 009.png"],
        "sizes": ["002.png are 9 x 32 px, the scene is 24 x 32 px"],
        "soft": ["different colours"],
        "other_bands": ["002.png has 1 bands, the first image 3"],
        "soil": ["a second class: all labels are class_0"],
        "bare": ["label files: beside an image NAME.png"],
    }.items():
        told = json.loads(command_line("init", made / folder, "--json", "--force").out)["unseen"]
        assert [one for one in words if not any(one in line for line in told)] == []
    told = json.loads(command_line("init", made / "cube.npy", "--json", "--force").out)["unseen"]
    assert "the wavelengths of 5 bands" in told
    (made / "scene.toml").unlink()


def stripes(*numbers: int, gap: int | None = 0) -> np.ndarray:
    """Return a picture with a stripe for each number, between stripes of the gap."""
    return np.tile(np.repeat([one for n in numbers for one in (n, gap) if one is not None], 4), (24, 1)).astype(
        np.uint8
    )


@pytest.mark.parametrize(
    ("labels", "unlabelled", "words"),
    [
        (
            stripes(1, 2, 3, 4, 5, 6),
            0,
            r"label 0 \(50.0% of the pixels\) means no class; if it is one, remove unlabelled",
        ),
        (
            stripes(0, 1, 2, 3, gap=None),
            None,
            r"label 0 .* is a class; if it means none, write unlabelled = 0 and remove",
        ),
        (stripes(1, 2), None, "label 0 .* is a class"),  # soil, crop and weed
        (stripes(0, 1, 2, 255, gap=None), 255, r"label 255 \(25.0% of the pixels\) means no class"),
        (stripes(255), None, r"label 255 .* is a class"),
        (
            np.array([[0] * 3, [0, 255, 0], [255, 0, 0]], np.uint8)[stripes(1, 2)],
            None,
            r"label \[0, 0, 0\] .* is a class",
        ),
        (stripes(1, 2, gap=None), None, "next: spectralzoom train"),
    ],
)
def test_init_ends_with_its_assumption(
    labels: np.ndarray, unlabelled: int | None, words: str, tmp_path: Path, command_line: Any
) -> None:
    """Labels such as 0 may mean no class: the last line says what scene.toml takes them for, and how to change it."""
    Image.fromarray(labels).save(tmp_path / "a_mask.png")
    Image.fromarray(np.zeros((*labels.shape[:2], 3), np.uint8)).save(tmp_path / "a.png")
    last = command_line("init", tmp_path / "a.png").out.strip().splitlines()[-1]
    assert re.search(words, last)
    found = load_scene_settings(tmp_path / "scene.toml")
    assert found.unlabelled == unlabelled
    assert unlabelled not in found.classes.values()


def test_init_keeps_what_scene_toml_says_of_label_0(tmp_path: Path, command_line: Any) -> None:
    """With --force a value that was a class stays one, and one that was none stays none."""
    np.save(tmp_path / "a.npy", np.zeros((24, 48, 3)))
    np.save(tmp_path / "a_gt.npy", stripes(1, 2, 3, 4, 5, 6))
    for text, classes in (("[classes]\nsoil = 0\n", range(7)), ("unlabelled = 0\n", range(1, 7))):
        (tmp_path / "scene.toml").write_text(text)
        assert command_line("init", tmp_path / "a.npy", "--force").code == 0
        assert list(load_scene_settings(tmp_path / "scene.toml").classes.values()) == list(classes)


def test_init_asks_for_repair_of_labels_of_another_size(tmp_path: Path, command_line: Any) -> None:
    """If no label file fits, the next step is the same command with --force."""
    for name, size in (("001", 32), ("001_mask", 24)):
        Image.fromarray(np.eye(size, dtype=np.uint8)).save(tmp_path / f"{name}.png")
    told = json.loads(command_line("init", tmp_path, "--json").out)
    assert told["next"].split()[1:] == ["init", str(tmp_path), "--force"]
    assert told["first"] == f"repair these label files, or write what is missing into {tmp_path / 'scene.toml'}"


def test_training_notes_the_scenes_that_it_leaves_out(made: Path, tmp_path: Path, command_line: Any) -> None:
    """Scenes without labels are left out; tiles that lack a class are kept, with the classes of all tiles."""
    out = tmp_path / "mine.safetensors"
    ended = command_line("train", made / "lacking", "-o", out, *SMALL)
    assert ended.code == 0
    assert "note: of 2 scenes 1 without labels left out: 002.png" in ended.err
    assert "note: label files without a scene, 1: 009.png" in ended.err
    (made / "tiles" / "scene.toml").unlink(missing_ok=True)
    data = open_training_data(str(made / "tiles"), 0, None, LineCamera())
    assert {scene.class_names for scene in map(data.scene, data.train)} == {("class_0", "class_1", "class_2")}


def test_training_and_evaluation_note_shifted_labels(tmp_path: Path, command_line: Any) -> None:
    """Labels of two frames begin 7 m east of their images; one note in training and one in evaluation name them."""
    (folder := tmp_path / "field").mkdir()
    (folder / "scene.toml").write_text("wavelengths_nm = [800]\n")
    classes = np.kron(np.random.default_rng(1).integers(0, 2, (4, 4)), np.ones((8, 8))).astype(np.uint8)
    for number, beside in (("001", 0), ("002", 7), ("003", 7)):
        write(folder / f"{number}.tif", classes * 50 + np.uint8(number), Affine(1, 0, 0, 0, -1, 60))
        write(folder / f"{number}_labels.tif", classes[:, beside:], Affine(1, 0, beside, 0, -1, 60))
    out = tmp_path / "w.safetensors"
    ended = command_line("train", folder, "-o", out, "--validation", "1", "--hold-out", "003", *SMALL)
    assert ended.code == 0, ended.err
    assert re.findall(r"note: labels of (.*) have another place", ended.err) == ["002"]
    judged = command_line("evaluate", folder, "--weights", out, "--fractions", "0.5")
    assert judged.code == 0, judged.err + judged.out
    assert re.findall(r"note: labels of (.*) have another place", judged.err) == ["003"]


@pytest.mark.parametrize("folder", ["sizes", "soft", "several"])
def test_unusable_found_labels_are_refused(folder: str, made: Path) -> None:
    """Labels of another size, of mixed colours or in several files are refused, until scene.toml leaves them out."""
    settings = made / folder / "scene.toml"
    settings.unlink(missing_ok=True)
    scene = next(path for path in sorted((made / folder).rglob("00*.png")) if "002" in path.name or folder != "sizes")
    scene = scene.parent.parent / "images" / scene.name if scene.parent.name == "labels" else scene
    survey = load_settings(None, {"scene": str(scene), "weights": "w"})
    with pytest.raises(SceneError, match="labels"):
        open_scene(survey)
    settings.write_text('labels = ""\n')
    assert open_scene(survey)[0].labels is None
    settings.unlink()


def test_an_evaluation_notes_frames_of_a_single_class(made: Path, weights: Path) -> None:
    """The note asks whether the value of that class means unlabelled."""
    candidates = open_candidates((weights,))
    data = open_frames(str(made / "soil"), (), None, LineCamera(), {"labels": None, "bands": None, "wavelengths": None})
    jobs = sort_frames(data, candidates, lambda *words: None)
    assert jobs.notes[0].startswith("all labels are class_0 in 001, 002; if its value")

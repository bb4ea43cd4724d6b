"""compare: two runs of one field, by laws on maps as chance made them and on the runs of real, tiny surveys."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flows.archive.compare_command import _by_one_list, _comparison, compare, find_run
from pipeline.errors import ArchiveError, SceneError, SettingsError, ShapeError
from pipeline.geometry.grid import UNLABELLED
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.arrays.class_maps import ClassMap
from tests.conftest import Survey
from tests.flows.conftest import turned
from tests.storage.small_archive import flip

pytestmark = pytest.mark.usefixtures("no_effects")

POSE = {"lon_deg": 9.5, "lat_deg": 52.1, "heading_deg": 25.0, "tilt_deg": 50.0, "height_m": 14.0}


def _compared(
    capsys: pytest.CaptureFixture[str], archive: Path, old: str, new: str, out: Path | None = None
) -> dict[str, Any]:
    capsys.readouterr()
    assert compare(str(archive), old, new, out=out, as_json=True) == 0
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    return content


def _map(classes: np.ndarray[Any, Any], names: tuple[str, ...], seed: int = 0) -> ClassMap:
    colours = np.random.default_rng(seed).integers(0, 256, (len(names), 3), dtype=np.uint8)
    return ClassMap(np.asarray(classes, np.uint8), np.ones(classes.shape, np.float32), names, colours)


def test_two_budgets_are_told_apart_either_way(
    two_budgets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Areas add up to the field, the changed setting is named; swapped runs swap the figures, and agreement stays."""
    content = _compared(capsys, two_budgets, "previous", "latest", tmp_path)
    assert content["settings"] == [{"name": "budget", "old": 0.8, "new": 0.7}]
    for side in (0, 1):
        assert sum(row["pixels"][side] for row in content["classes"]) == 96 * 128
    assert sum(row["pixels"] for row in content["largest"]) == content["differing"]["pixels"] > 0
    assert content["savings"]["lines"][0] > content["savings"]["lines"][1] > 0
    assert content["a"]["miou"] != content["b"]["miou"]
    with Image.open(content["picture"]) as picture:
        assert picture.format == "PNG"
        assert picture.width > 3 * 400
    compare(two_budgets, "previous", "latest", out=tmp_path)
    out = capsys.readouterr().out
    for words in ("budget", "capture time", "IoU of A and B", "stage.score", "compare-"):
        assert words in out
    one, other = (
        _compared(capsys, two_budgets, *runs, tmp_path) for runs in (("previous", "latest"), ("latest", "previous"))
    )
    assert one["differing"] == other["differing"]
    assert [(row["name"], row["pixels"], row["iou"]) for row in one["classes"]] == [
        (row["name"], row["pixels"][::-1], row["iou"]) for row in other["classes"]
    ]
    assert {(row["from"], row["to"], row["pixels"]) for row in one["largest"]} == {
        (row["to"], row["from"], row["pixels"]) for row in other["largest"]
    }


def test_runs_of_different_fields_are_refused(survey_png: Survey, scene_files: Path, tmp_path: Path) -> None:
    """Also by `previous`, which looks for the same field."""
    other = turned(scene_files / "scene.png", tmp_path / "turned.png")
    for scene in (scene_files / "scene.png", other):
        survey_png(tmp_path / "archive", scene=str(scene), labels=None)
    old, new = (path.name for path in Archive.open(tmp_path / "archive").runs())
    with pytest.raises(SceneError, match=r"different fields.*turned\.png"):
        compare(tmp_path / "archive", old, new)
    with pytest.raises(ArchiveError, match="no run of the field"):
        compare(tmp_path / "archive", "previous", "latest")
    with pytest.raises(ArchiveError, match="there is no run nothing"):
        compare(tmp_path / "archive", "nothing", "latest")


def test_a_map_that_cannot_be_believed_is_not_compared(two_budgets: Path, tmp_path: Path) -> None:
    """Though its numbers can still be read."""
    archive = Path(shutil.copytree(two_budgets, tmp_path / "archive"))
    address = Catalogue.read(archive).runs[-1].products["class_map"]
    flip(archive / address.rpartition("/")[0] / "manifest.json", at=40)
    with pytest.raises(ArchiveError, match=r"the class map .* is missing or damaged; run verify --repair"):
        compare(archive, "previous", "latest", out=tmp_path)


def test_previous_is_the_run_just_before(tmp_path: Path) -> None:
    """Of the same field, whatever lies between; runs without a map do not count; an empty archive has none."""
    archive = Archive.open(tmp_path)
    made = []
    for seed, product in ((0, "class_map"), (0, "class_map"), (0, "plan"), (1, "class_map"), (0, "class_map")):
        receipt = {"scene": f"farm@1/seed={seed}", "settings": {"scene": "farm", "seed": seed}}
        with archive.new_run("farm") as draft:
            draft.write_file("receipt.json", json.dumps(receipt | {"products": {product: "stages/segment/aaaa/m"}}))
            made.append(draft.id)
    catalogue = Catalogue.read(tmp_path)
    assert [find_run(catalogue, text).folder.name for text in ("latest", "previous")] == [made[4], made[1]]
    Archive.open(tmp_path / "empty")
    with pytest.raises(ArchiveError, match="no run of this archive"):
        find_run(Catalogue.read(tmp_path / "empty"), "latest")


def test_a_file_in_the_place_of_the_folder_is_refused(two_budgets: Path, tmp_path: Path) -> None:
    """And is left as it is."""
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(SettingsError, match="lies in the archive, where nothing else belongs"):
        compare(two_budgets, "previous", "latest", out=two_budgets / "runs")
    for out in (tmp_path / "mine", tmp_path / "mine" / "below"):
        with pytest.raises(ArchiveError, match=r"mine.* is or lies below a file, expected a folder; choose another"):
            compare(two_budgets, "previous", "latest", out=out)
    assert (tmp_path / "mine").read_text() == "mine"


def test_classes_are_matched_by_name() -> None:
    """In another order it is the same map; a class of one list alone stays its own; sizes have to agree."""
    classes = np.random.default_rng(3).integers(0, 3, (9, 7)).astype(np.uint8)
    classes[0, 0] = UNLABELLED
    order = np.full(256, UNLABELLED, np.uint8)
    order[:3] = (2, 0, 1)
    old, new = _by_one_list([_map(classes, ("a", "b", "c")), _map(order[classes], ("b", "c", "a", "d"), seed=1)])
    assert old.names == new.names == ("a", "b", "c", "d")
    np.testing.assert_array_equal(old.colours[:3], _map(classes, ("a", "b", "c")).colours)
    np.testing.assert_array_equal(old.classes, new.classes)
    with pytest.raises(ShapeError, match=r"\(4, 4\) and \(4, 5\)"):
        _by_one_list([_map(np.zeros((4, width)), ("a",)) for width in (4, 5)])


def test_hectares_are_told_where_both_runs_have_them() -> None:
    """One map on the ground alone has nothing beside it; pixels are counted class by class."""
    alike = _by_one_list([_map(np.zeros((2, 2)), ("a",)) for _ in range(2)])
    posed, bare = (Run(Path("x"), {}, receipt, None) for receipt in ({"areas": {"ha": {"a": 2.5}}}, {}))
    for runs in ((posed, bare), (bare, posed), (bare, bare)):
        assert not any("ha" in row for row in _comparison(runs, alike)["classes"])
    half = _by_one_list([_map(np.zeros((2, 2)), ("a", "b")), _map(np.eye(2), ("a", "b"))])
    found = _comparison((bare, bare), half)
    assert [(row["name"], row["pixels"]) for row in found["classes"]] == [("a", [4, 2]), ("b", [0, 2])]
    assert found["largest"] == [{"from": "a", "to": "b", "pixels": 2, "fraction": 0.5}]
    (row,) = _comparison((posed, posed), alike)["classes"]
    assert (row["ha"], row["pixels"], row["iou"]) == ([2.5, 2.5], [4, 4], 1.0)

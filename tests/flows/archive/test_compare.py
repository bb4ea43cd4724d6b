"""compare: two runs of one field, by laws on maps as chance made them and on the runs of real, tiny surveys."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flows.archive.compare_command import _classes, _confidence, _pair_of, compare, find_run
from flows.publish.change_pictures import OTHER, SAME, MapPair, change_rgb, draw_difference, thin_changes
from pipeline.errors import ArchiveError, SceneError, SettingsError, ShapeError
from pipeline.geometry.grid import UNLABELLED
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.records import Run
from storage.arrays.class_maps import ClassMap
from tests.conftest import Survey, WeightsMaker
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


def test_a_run_is_the_same_as_itself(two_budgets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every class agrees wholly; the picture lies beside the archive, which is left as it is."""
    content = _compared(capsys, two_budgets, "latest", "latest", tmp_path)
    assert content["differing"] == {"pixels": 0, "share": 0.0, "pairs": 0}
    assert (content["settings"], content["versions"], content["largest"]) == ([], [], [])
    assert {row["iou"] for row in content["classes"]} == {1.0}
    assert content["confidence"]["change"] == 0
    assert compare(two_budgets, "latest", "latest", out=tmp_path) == 0
    assert "settings and versions are the same" in capsys.readouterr().out
    old, new = (path.name for path in Archive.open(two_budgets).runs())
    before = sorted(two_budgets.rglob("*"))
    content = _compared(capsys, two_budgets, old, f"runs/{new}")
    assert Path(content["picture"]) == two_budgets.parent / f"compare-{old}-{new}.png"
    assert sorted(two_budgets.rglob("*")) == before


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
    for words in ("budget", "time of capture", "IoU of A and B", "confidence", "compare-"):
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


def test_new_weights_and_hectares_are_told(
    survey_png: Survey, make_weights: WeightsMaker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Weights by their content, and hectares where both runs have a map on the ground."""
    small = {"pose": POSE, "map": {"resolution_m": 0.02}}
    for names in (("class_0", "class_1", "class_2"), ("class_1", "class_0", "class_2", "more")):
        survey_png(tmp_path / "archive", weights=str(make_weights(names=names)), **small)
    content = _compared(capsys, tmp_path / "archive", "previous", "latest", tmp_path)
    assert "weights" in {row["name"] for row in content["versions"]}
    assert sum(row["ha"][1] for row in content["classes"]) > 0
    compare(tmp_path / "archive", "previous", "latest", out=tmp_path)
    assert "ha in B" in capsys.readouterr().out


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


def test_what_sets_two_farms_apart_is_told(tmp_path: Path) -> None:
    """Seed and size stand in what a built-in scene is called by; its bands are of the camera."""
    archive = Archive.open(tmp_path)
    for size in ("96x64", "96x96"):
        receipt = {"scene": f"farm@1/seed=0/shape={size}/bands=9", "settings": {"scene": "farm", "seed": 0}}
        with archive.new_run("farm") as draft:
            draft.write_file("receipt.json", json.dumps(receipt | {"products": {"class_map": "stages/segment/aaaa/m"}}))
    old, new = (path.name for path in archive.runs())
    with pytest.raises(SceneError, match=r"shape=96x64, runs/.*shape=96x96;"):
        compare(tmp_path, old, new)


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
    pair = _pair_of([_map(classes, ("a", "b", "c")), _map(order[classes], ("b", "c", "a", "d"), seed=1)])
    assert pair.maps.names == ("a", "b", "c", "d")
    np.testing.assert_array_equal(pair.maps.colours[:3], _map(classes, ("a", "b", "c")).colours)
    np.testing.assert_array_equal(pair.maps.old, pair.maps.new)
    assert not pair.maps.pairs
    assert np.trace(pair.joint) == classes.size
    with pytest.raises(ShapeError, match=r"\(4, 4\) and \(4, 5\)"):
        _pair_of([_map(np.zeros((4, width)), ("a",)) for width in (4, 5)])


def test_hectares_are_told_where_both_runs_have_them() -> None:
    """One map on the ground alone has nothing beside it."""
    pair = _pair_of([_map(np.zeros((2, 2)), ("a",)) for _ in range(2)])
    posed, bare = (
        Run(Path("x"), {}, receipt, None, frozenset()) for receipt in ({"ground": {"areas_ha": {"a": 2.5}}}, {})
    )
    assert ["ha" in row for runs in ((posed, bare), (bare, posed), (bare, bare)) for row in _classes(runs, pair)] == [
        False
    ] * 3
    half = _pair_of([_map(np.zeros((2, 2)), ("a", "b")), _map(np.eye(2), ("a", "b"))])
    assert [(row["name"], row["pixels"]) for row in _classes((bare, bare), half)] == [("a", [4, 2]), ("b", [0, 2])]
    (row,) = _classes((posed, posed), pair)
    assert (row["ha"], row["pixels"], row["iou"]) == ([2.5, 2.5], [4, 4], 1.0)


def test_confidence_is_compared_where_both_have_a_class() -> None:
    """Means, change from A to B, and the share that rose; none where there is nothing to compare."""
    old, new = (np.array(values, np.float32) for values in ([0.5, 0.5, np.nan, 0.5, 0.9], [0.75, 0.5, 1, np.nan, 0.95]))
    found = _confidence(old, new)
    assert found["a"] == pytest.approx(1.9 / 3)
    assert found["b"] == pytest.approx(2.2 / 3)
    assert found["change"] == pytest.approx(0.1)
    assert found["rose"] == pytest.approx(2 / 3)
    assert set(_confidence(old[2:3], new[2:3]).values()) == {None}


def test_changes_have_colours_of_their_own() -> None:
    """The largest pairs each, the rest dark, what is the same light; maps of any shape and name are drawn."""
    rng = np.random.default_rng(1)
    names = tuple("abcdef")
    old, new = (rng.integers(0, 6, (40, 50)).astype(np.uint8) for _ in range(2))
    new[:2] = UNLABELLED
    maps = _pair_of([_map(old, names), _map(new, names)]).maps
    assert [count for *_, count in maps.pairs] == sorted((count for *_, count in maps.pairs), reverse=True)
    picture = change_rgb(maps)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 12
    np.testing.assert_array_equal((picture == np.float32(SAME)).all(axis=-1), old == new)
    assert (picture == np.float32(OTHER)).all(axis=-1).any()
    assert (maps.name(0), maps.name(UNLABELLED)) == ("a", "no class")
    for shape in ((1, 90), (300, 8)):
        zero = np.zeros(shape, np.uint8)
        drawn = draw_difference(MapPair(zero, zero, ("a $x$_b",), np.zeros((1, 3), np.uint8), []), ("A", "B", "none"))
        with Image.open(io.BytesIO(drawn)) as picture:
            assert picture.format == "PNG"


@pytest.mark.parametrize(("step", "shape"), [(1, (6, 9)), (3, (2, 3)), (4, (2, 3)), (20, (1, 1))])
def test_no_change_is_left_out_of_a_thinned_picture(step: int, shape: tuple[int, int]) -> None:
    """A block shows a change where it holds any, with both of its classes, and else its first pixel."""
    old = np.arange(54, dtype=np.uint8).reshape(6, 9) % 5
    new = old.copy()
    new[4, 8] = 7
    maps = thin_changes(MapPair(old, new, tuple("abcdefgh"), np.zeros((8, 3), np.uint8), [(4, 7, 1)]), step)
    assert maps.old.shape == maps.new.shape == shape
    (place,) = np.argwhere(maps.old != maps.new)
    assert tuple(place) == (4 // step, 8 // step)
    assert (maps.old[tuple(place)], maps.new[tuple(place)]) == (old[4, 8], 7)
    if step == 3:
        np.testing.assert_array_equal(maps.old[0], old[0, ::3])

"""What rests on what, what changed, and what a person means by a product; damaged files are told, never raised."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.errors import ArchiveError
from storage.archive import Archive
from storage.changes import ABSENT, Change, changes_between, flatten, version_before
from storage.lineage import Catalogue, rests_on
from storage.product_names import find_product
from storage.records import Run
from tests.storage.small_archive import flip, small_survey


def test_inputs_and_dependents_are_followed_all_the_way(tmp_path: Path) -> None:
    """A map rests on its mosaic and, through it and directly, on the raw lines."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    catalogue = Catalogue.read(tmp_path)
    assert catalogue.ancestors([small.map.uri]) == {small.mosaic.uri, small.raw.uri}
    assert catalogue.dependents([small.raw.uri]) == {small.mosaic.uri, small.map.uri}
    assert catalogue.inputs_first(catalogue.stores) == [small.raw.uri, small.mosaic.uri, small.map.uri]
    assert [ref.uri for ref in rests_on(tmp_path, [small.mosaic])] == [small.raw.uri, small.mosaic.uri]
    assert small.run is not None
    assert [run.folder for run in catalogue.named_by(small.raw.uri)] == [small.run]
    assert catalogue.roles(small.raw.uri) == {"capture_coarse"}


def test_a_store_tells_what_its_making_took(tmp_path: Path) -> None:
    """Seconds, work and bytes; none of a manifest of before."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    cost = archive.cost(small.map)
    assert cost is not None
    assert (cost.work, cost.size) == (64.0, archive.stored_bytes(small.map))
    assert cost.wall_s >= 0 <= cost.cpu_s
    path = small.map.path / "manifest.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({name: content[name] for name in content if name not in ("cost", "seal", "format")}))
    assert archive.cost(small.map) is None
    assert archive.find("segment", small.map.key) == small.map


def test_work_that_is_no_amount_is_refused(tmp_path: Path) -> None:
    """It would spoil every estimate made of it."""
    archive = Archive.open(tmp_path)
    with pytest.raises(ArchiveError, match="work is nan"), archive.publish("segment", "key", work=float("nan")):
        pass
    assert archive.refs() == []


@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", '{"files": []}', "[" * 100_000, '{"files": {"../../x": {"sha256": "0", "size": 1}}}',
     '{"files": {"a": 3}}', '{"files": {"/etc/passwd": {"sha256": "0", "size": 1}}}', '{"files": {}, "format": 2}'],
)  # fmt: skip
def test_any_manifest_can_be_read_or_is_told_damaged(tmp_path: Path, content: str) -> None:
    """Nothing a manifest says ends in a traceback, or in reading a file elsewhere."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    (small.mosaic.path / "manifest.json").write_text(content)
    catalogue = Catalogue.read(tmp_path)
    problem = catalogue.stores[small.mosaic.uri].problem
    assert problem is not None
    assert problem.startswith("manifest.json cannot be believed")
    assert catalogue.inputs_of(small.mosaic.uri) == []
    broken = [one.uri for one in archive.verify_all() if one.problem is not None]
    assert broken == [small.mosaic.uri]


@pytest.mark.parametrize("inputs", [7, "abc", [3, None], {"a": 5}, ["nowhere", "stages/rectify/nowhere"]])
def test_odd_inputs_are_borne(tmp_path: Path, inputs: object) -> None:
    """Of a manifest of before, which has no seal, anything may be found."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    path = small.map.path / "manifest.json"
    content = json.loads(path.read_text())
    for name in ("seal", "format"):
        del content[name]
    path.write_text(
        json.dumps(content | {"inputs": inputs, "params": 3, "created": None, "libraries": [], "cost": "x"})
    )
    catalogue = Catalogue.read(tmp_path)
    assert catalogue.dependents([small.map.uri]) == set()
    assert version_before(catalogue, small.map.uri) is None
    assert all(isinstance(one.uri, str) for one in archive.verify_all())


def test_what_changed_is_followed_to_where_it_began(tmp_path: Path) -> None:
    """The map has another mosaic, which has another kernel; the version before is that of the same scene and part."""
    archive = Archive.open(tmp_path)
    first, _, second = (small_survey(archive, kernel=kernel) for kernel in ("bilinear", "nearest", "catmull-rom"))
    catalogue = Catalogue.read(tmp_path)
    before = version_before(catalogue, second.map.uri)
    assert before is not None
    assert before.ref != first.map
    changes = changes_between(catalogue, before, catalogue.stores[second.map.uri])
    assert changes == [
        Change("segment", "input", "rectify", catalogue.inputs_of(before.ref.uri)[0], second.mosaic.uri),
        Change("rectify", "parameter", "kernel", "nearest", "catmull-rom"),
    ]
    assert version_before(catalogue, first.map.uri) is None


def test_versions_and_libraries_count_as_changes(tmp_path: Path) -> None:
    """A stage that got a new version, and parameters that came and went."""
    archive = Archive.open(tmp_path)
    for key, version, params in (("one", 1, {"a": {"b": 1}, "c": 2}), ("two", 2, {"a": {"b": 3}, "d": [1, 2]})):
        with archive.publish("segment", key, version=version, params=params):
            pass
    catalogue = Catalogue.read(tmp_path)
    one, two = (catalogue.stores[f"stages/segment/{key}"] for key in ("one", "two"))
    assert version_before(catalogue, "stages/segment/two") == one
    assert [(c.kind, c.name, c.old, c.new) for c in changes_between(catalogue, one, two)] == [
        ("version", "stage", "1", "2"),
        ("parameter", "a.b", 1, 3),
        ("parameter", "c", 2, ABSENT),
        ("parameter", "d", ABSENT, [1, 2]),
    ]


def test_nested_parameters_have_dotted_names() -> None:
    """Lists of tables by number, lists of numbers as one value."""
    assert flatten({"a": {"b": 1}, "s": [{"x": 1}, {"x": 2}], "l": [1, 2], "e": {}}) == {
        "a.b": 1, "s[0].x": 1, "s[1].x": 2, "l": [1, 2], "e": {},
    }  # fmt: skip


def test_products_go_by_many_names(tmp_path: Path) -> None:
    """Address, address of a file in it, stage and key, beginning of a key, run, and name in the newest run."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    assert small.run is not None
    catalogue = Catalogue.read(tmp_path)
    key = small.map.key
    for text in (small.map.uri, f"{small.map.uri}/class_map.zarr/", f"segment/{key}", key, key[:8], "class_map"):
        assert find_product(catalogue, text) == small.map.uri
    for text in (small.run.name, f"runs/{small.run.name}", f"runs/{small.run.name}/receipt.json"):
        found = find_product(catalogue, text)
        assert isinstance(found, Run)
        assert found.folder == small.run


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("../x", "cannot be a name"), ("stages/../../etc", "cannot be a name"), ("/etc/passwd", "cannot be a name"),
        ("", "cannot be a name"), ("stages/segment/none", "no store stages/segment/none in this archive; there is"),
        ("stages/nothing/none", "no store of this stage"), ("runs/none", "there is no run none"),
        ("class_mop", "did you mean class_map"), ("xyz", "products of the newest run: class_map, mosaic"),
    ],
)  # fmt: skip
def test_what_is_no_product_is_refused(tmp_path: Path, text: str, words: str) -> None:
    """With the nearest that there is."""
    small_survey(Archive.open(tmp_path))
    with pytest.raises(ArchiveError, match=words):
        find_product(Catalogue.read(tmp_path), text)


def test_a_damaged_receipt_names_what_its_manifest_recorded(tmp_path: Path) -> None:
    """The receipt's own words do not count any more."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    assert small.run is not None
    flip(small.run / "receipt.json")
    (run,) = Catalogue.read(tmp_path).runs
    assert run.receipt == {}
    assert run.problem is not None
    assert run.names == {small.raw.uri, small.mosaic.uri, small.map.uri}


def test_a_run_that_is_no_table_is_borne(tmp_path: Path) -> None:
    """Receipts of any shape are read."""
    archive = Archive.open(tmp_path)
    for receipt in ("[1, 2]", '{"stages": [3, {"key": 4}], "products": 5, "settings": null}', '"text"'):
        with archive.new_run("odd") as draft:
            draft.write_file("receipt.json", receipt)
    catalogue = Catalogue.read(tmp_path)
    assert [(run.names, run.products, run.settings) for run in catalogue.runs] == [(frozenset(), {}, {})] * 3

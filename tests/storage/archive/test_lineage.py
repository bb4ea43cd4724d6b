"""Lineage of stores: inputs, dependents, changes, and products by name. Damaged files are reported, never raised."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from spectralzoom.pipeline.errors import ArchiveError
from spectralzoom.storage.archive import lineage
from spectralzoom.storage.runs import Run, verify_everything
from spectralzoom.storage.store import Archive, uri_of
from tests.storage.small_archive import flip, rewrite, small_survey


def test_lineage_includes_indirect_inputs(tmp_path: Path, archive: Archive) -> None:
    """A map depends on its mosaic and, through it and directly, on the raw lines."""
    small = small_survey(archive)
    catalogue = lineage.Catalogue.read(tmp_path)
    assert catalogue.ancestors([small.map.uri]) == {small.mosaic.uri, small.raw.uri}
    assert catalogue.inputs_first(catalogue.stores) == [small.raw.uri, small.mosaic.uri, small.map.uri]
    assert [ref.uri for ref in lineage.rests_on(tmp_path, [small.mosaic])] == [small.raw.uri, small.mosaic.uri]
    assert [run.folder for run in catalogue.named_by(small.raw.uri)] == [small.run]
    assert catalogue.roles(small.raw.uri) == {"capture_coarse"}


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[" * 100_000,
        '{"files": {"../../x": {"sha256": "0", "size": 1}}}',
        '{"files": {"/etc/passwd": {"sha256": "0", "size": 1}}}',
        '{"files": {}, "format": 2}',
    ],
)
def test_an_invalid_manifest_is_reported_as_damaged(tmp_path: Path, archive: Archive, content: str) -> None:
    """No content of a manifest causes another error, or makes verify read a file elsewhere."""
    small = small_survey(archive)
    (small.mosaic.path / "manifest.json").write_text(content)
    catalogue = lineage.Catalogue.read(tmp_path)
    assert catalogue.stores[small.mosaic.uri].problem.startswith("manifest.json is damaged")
    assert catalogue.inputs_of(small.mosaic.uri) == []
    assert [one.uri for one in verify_everything(archive) if one.problem is not None] == [small.mosaic.uri]


@pytest.mark.parametrize("inputs", [7, "abc", [3, None], {"a": 5}, ["nowhere", "stages/rectify/nowhere"]])
def test_malformed_inputs_of_a_manifest_are_tolerated(tmp_path: Path, archive: Archive, inputs: object) -> None:
    """Inputs, parameters and dates of a wrong type raise no exception."""
    small = small_survey(archive)
    rewrite(small.map.path / "manifest.json", **{"inputs": inputs, "params": 3, "created": None, "libraries": []})
    assert isinstance(lineage.Catalogue.read(tmp_path).inputs_of(small.map.uri), list)
    assert all(isinstance(one.uri, str) for one in verify_everything(archive))


def test_raw_lines_of_unknown_origin_are_the_only_copy(tmp_path: Path, archive: Archive) -> None:
    """Simulated lines are marked by a run or by their own parameters; one run of a rig outweighs all others."""
    for key, params in (("bare", {}), ("light", {"effects": []}), ("rig", {"effects": [], "source": "rig"})):
        with archive.publish("capture", key, params=params):
            pass
    with archive.publish("rectify", "mosaic"):
        pass

    def only() -> list[str]:
        catalogue = lineage.Catalogue.read(tmp_path)
        return [uri.rpartition("/")[2] for uri in catalogue.stores if catalogue.is_only_copy(uri)]

    assert only() == ["bare", "rig"]
    named = archive.manifest_hashes(archive.ref("capture", key) for key in ("bare", "light"))
    archive.new_run("a").publish(settings={"source": "sim"}, rests_on=named)
    assert only() == ["rig"]
    archive.new_run("b").publish(settings={"source": "rig"}, rests_on=named)
    assert only() == ["bare", "light", "rig"]


def test_products_are_found_by_address_key_run_and_name(tmp_path: Path, archive: Archive) -> None:
    """Accepted are addresses of stores and files, stage and key, a key's start, a run, and a name in the newest run."""
    small = small_survey(archive)
    catalogue = lineage.Catalogue.read(tmp_path)
    key = small.map.key
    for text in (small.map.uri, f"{small.map.uri}/class_map.zarr/", f"segment/{key}", key, key[:8], "class_map"):
        assert lineage.find_product(catalogue, text) == small.map.uri
    for text in (small.run.name, f"runs/{small.run.name}", f"runs/{small.run.name}/receipt.json"):
        found = lineage.find_product(catalogue, text)
        assert isinstance(found, Run)
        assert found.folder == small.run


def test_a_stage_name_resolves_an_ambiguous_key(tmp_path: Path, archive: Archive) -> None:
    """The prefix `stages/` is optional; a beginning that still fits several keys is refused with a list of them."""
    for stage, key in (("rectify", "abcd1"), ("segment", "abcd1"), ("segment", "abcd2"), ("segment", "abce3")):
        with archive.publish(stage, key):
            pass
    catalogue = lineage.Catalogue.read(tmp_path)
    for text in ("rectify/abcd", "stages/rectify/abcd", "stages/rectify/abcd1"):
        assert lineage.find_product(catalogue, text) == "stages/rectify/abcd1"
    assert lineage.find_product(catalogue, "abce") == "stages/segment/abce3"
    with pytest.raises(ArchiveError, match=r"segment/abcd begins 2 stores: .*abcd1, stages/segment/abcd2; give more"):
        lineage.find_product(catalogue, "segment/abcd")
    with pytest.raises(ArchiveError, match="abcd begins 3 stores"):
        lineage.find_product(catalogue, "abcd")


def test_a_product_name_means_the_newest_readable_run(tmp_path: Path, archive: Archive) -> None:
    """A newer run whose receipt is damaged is skipped."""
    made = [small_survey(archive, seed=seed) for seed in range(3)]
    catalogue = lineage.Catalogue.read(tmp_path)
    assert lineage.find_product(catalogue, "class_map") == made[2].map.uri
    assert isinstance(newest := lineage.find_product(catalogue, "latest"), Run)
    assert newest.folder == made[2].run
    flip(made[2].run / "receipt.json")
    assert lineage.find_product(lineage.Catalogue.read(tmp_path), "class_map") == made[1].map.uri


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("../x", "cannot be a name"),
        ("stages/../../etc", "cannot be a name"),
        ("/etc/passwd", "cannot be a name"),
        ("", "cannot be a name"),
        ("stages/segment/none", "is no product, store or run"),
        ("runs/none", "there is no run none"),
        ("xyz", "there is class_map, mosaic"),
        ("mosaic", "the mosaic of runs/.* lacks its store stages/.*; survey again to make it"),
    ],
)
def test_find_product_refuses_unknown_names(tmp_path: Path, text: str, words: str) -> None:
    """The error lists the products of the newest run; a product whose store is missing has its own message."""
    small_survey(Archive.open(tmp_path))
    shutil.rmtree(tmp_path / str(uri_of(lineage.Catalogue.read(tmp_path).runs[-1].products["mosaic"])))
    with pytest.raises(ArchiveError, match=words):
        lineage.find_product(lineage.Catalogue.read(tmp_path), text)


@pytest.mark.parametrize("well", [False, True])
def test_a_run_with_a_damaged_receipt_uses_its_manifest(tmp_path: Path, archive: Archive, well: bool) -> None:
    """The content of the receipt is ignored, even where one digit changed and it is valid JSON."""
    small = small_survey(archive)
    receipt = small.run / "receipt.json"
    if well:
        receipt.write_text(receipt.read_text().replace('"seed": 0', '"seed": 7'))
    else:
        flip(receipt)
    (run,) = lineage.Catalogue.read(tmp_path).runs
    assert (run.receipt, run.settings) == ({}, {})
    assert "receipt.json has changed since it was published" in str(run.problem)
    assert run.names == {small.raw.uri, small.mosaic.uri, small.map.uri}


def test_settings_come_from_the_manifest_if_the_receipt_is_damaged(tmp_path: Path, archive: Archive) -> None:
    """The receipt comes first, because the manifest's numbers are rounded."""
    with archive.new_run("farm") as draft:
        draft.write_file("receipt.json", json.dumps({"settings": {"seed": 1}}))
        draft.publish(settings={"seed": 2})
    assert lineage.Catalogue.read(tmp_path).runs[0].settings == {"seed": 1}
    flip(archive.runs()[0] / "receipt.json")
    assert lineage.Catalogue.read(tmp_path).runs[0].settings == {"seed": 2}


def test_receipts_of_any_shape_are_read(tmp_path: Path, archive: Archive) -> None:
    """A receipt that is a list, a text, or a table of wrong types names no store, product or setting."""
    for receipt in ("[1, 2]", '{"stages": [3, {"key": 4}], "products": 5, "settings": null}', '"text"'):
        with archive.new_run("odd") as draft:
            draft.write_file("receipt.json", receipt)
    catalogue = lineage.Catalogue.read(tmp_path)
    assert [(run.names, run.products, run.settings) for run in catalogue.runs] == [(frozenset(), {}, {})] * 3

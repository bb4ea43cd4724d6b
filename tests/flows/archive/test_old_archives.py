"""An archive of an earlier version, whose spectra lie band by band: one message each says what makes it anew."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import spectralzoom
from flows.archive.export_command import run_export
from flows.archive.reprocess_command import reprocess_fields, run_judge
from pipeline.errors import OldStoreError
from storage.archive.archive import Archive
from storage.archive.manifests import read_manifest, write_manifest
from storage.arrays.mosaics import open_mosaic
from storage.arrays.signal_cubes import open_signal_cube
from tests.conftest import Survey
from tests.storage.plain_mosaic import write_values

pytestmark = pytest.mark.usefixtures("no_effects")

QUIET = Console(quiet=True)
SAID = (
    r"holds spectra band by band, as earlier versions stored them; `spectralzoom reprocess ARCHIVE` makes its run anew"
)


def name_values(path: Path) -> None:
    """Make a mosaic look as it did before spectra were condensed."""
    (path / "scores").rename(path / "values")


def remake(folder: Path, change: Callable[[], object], **facts: Any) -> None:
    """Change the files of a published folder, and write a manifest that fits them."""
    before = read_manifest(folder)
    (folder / "manifest.json").unlink()
    change()
    write_manifest(folder, {name: one for name, one in before.items() if name not in ("files", "seal")} | facts)


def without_signal(receipt: dict[str, Any]) -> dict[str, Any]:
    """Return a receipt as it was before spectra were condensed."""
    products = {name: uri for name, uri in receipt["products"].items() if not name.startswith(("signal", "detail"))}
    return receipt | {"products": products, "stages": [row for row in receipt["stages"] if "cond" not in row["name"]]}


@pytest.fixture
def old(surveyed_png: Survey, tmp_path: Path) -> Archive:
    """An archive as an earlier version left it: raw lines, a mosaic of values, and nothing condensed."""
    folder = surveyed_png(tmp_path / "archive").folder
    archive, text = Archive.open(tmp_path / "archive"), (folder / "receipt.json").read_text()
    for ref in archive.refs("rectify"):  # by a key of its own, as the version is a part of it
        place, key = ref.path.with_name(ref.key[::-1]), ref.key[::-1]
        ref.path.rename(place)
        remake(place, lambda place=place: name_values(place / "mosaic.zarr"), version=4, key=key)  # type: ignore[misc]
        text = text.replace(ref.key, key)
    for ref in (*archive.refs("condense"), *archive.refs("condense_fine")):
        shutil.rmtree(ref.path)
    text = json.dumps(without_signal(json.loads(text)))
    remake(folder, lambda: (folder / "receipt.json").write_text(text), rests_on={})
    return archive


def test_a_store_of_bands_is_named_with_its_cure(tmp_path: Path) -> None:
    """It is whole: nothing sends its owner to verify."""
    write_values(tmp_path / "mosaic.zarr", np.ones((24, 32, 3), np.float32), np.array([460.0, 550.0, 640.0]))
    name_values(tmp_path / "mosaic.zarr")
    for open_store in (open_mosaic, open_signal_cube):
        with pytest.raises(OldStoreError, match=SAID) as found:
            open_store(tmp_path / "mosaic.zarr")
        assert "verify" not in str(found.value)


def test_every_verb_says_it_once(old: Archive, survey_png: Survey, tmp_path: Path) -> None:
    """Export, a prior map, a later judgement, and Python: each ends in the message; maps can still be read."""
    run = spectralzoom.open(old.root).latest
    for ask in (
        lambda: run.mosaic,
        lambda: run.cube,
        lambda: run_export(old.root, None, tmp_path / "maps", False, QUIET),
    ):
        with pytest.raises(OldStoreError, match=SAID):
            ask()
    with pytest.raises(OldStoreError, match="has no condensed lines; `spectralzoom reprocess"):
        _ = run.lines
    assert run.class_map.values.shape
    with pytest.raises(spectralzoom.Error, match=rf"--prior {run.name}: .*{SAID}"):
        survey_png(old.root, prior=run.name)
    with pytest.raises(spectralzoom.Error, match=r"`spectralzoom reprocess .*` makes a new run"):
        run_judge(str(old.root), run.name, QUIET, labels=run.receipt["settings"]["labels"])


def test_reprocess_makes_the_run_anew(old: Archive) -> None:
    """It is due by a dry run, and afterwards its cube opens."""
    assert [row["state"] for row in reprocess_fields(old.root, QUIET, dry_run=True)["fields"]] == ["would run"]
    assert [row["state"] for row in reprocess_fields(old.root, QUIET)["fields"]] == ["ran"]
    run = spectralzoom.open(old.root).latest
    assert np.isfinite(run.cube.values).any()
    assert run.lines

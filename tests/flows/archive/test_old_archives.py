"""An archive of an earlier version, whose spectra lie band by band: one message each says what makes it anew."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spectralzoom
from flows.archive.reprocess_command import reprocess_fields
from flows.terminal.progress import on_stderr
from pipeline.errors import OldStoreError
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.lineage import RAW_STAGES
from storage.archive.manifests import read_manifest, write_manifest
from storage.archive.records import read_run
from storage.arrays.layout import create_group, write_bands, write_counts, write_small
from storage.arrays.mosaics import open_mosaic
from storage.arrays.signal_cubes import open_signal_cube
from storage.maintenance.repair import plan_repair
from storage.maintenance.verification import verify_everything
from tests.conftest import Survey
from tests.flows.conftest import CommandLine, problems

pytestmark = pytest.mark.usefixtures("no_effects")

OLD = {"capture": 10, "rectify": 4}  # versions of the stages that kept every band
SAID = r"holds spectra band by band, as earlier versions stored them; `spectralzoom reprocess ARCHIVE` makes its run"


def write_old_mosaic(path: Path, shape: tuple[int, int, int] = (24, 32, 3)) -> Path:
    """Write a mosaic as it was before spectra were condensed."""
    group = create_group(path, "mosaic", {})
    write_bands(group, np.array([460.0, 550.0, 640.0]), None)
    write_counts(group, band=shape[2])
    write_small(group, "values", ("y", "x", "band"), np.ones(shape, np.float32), {"units": "1"})
    write_small(group, "coverage", ("y", "x"), np.ones(shape[:2], np.float32), {"units": "1"})
    return path


def remake(folder: Path, change: Callable[[Path], object], **facts: Any) -> None:
    """Change the files of a published folder, and write a manifest that fits them."""
    before = read_manifest(folder)
    (folder / "manifest.json").unlink()
    change(folder)
    write_manifest(folder, {name: one for name, one in before.items() if name not in ("files", "seal")} | facts)


@pytest.fixture
def old(surveyed_png: Survey, tmp_path: Path) -> Archive:
    """An archive as an earlier version left it: raw lines, a mosaic of values, and nothing condensed."""
    root = tmp_path / "archive"
    surveyed_png(root)
    for ref in Archive.open(root).refs("rectify"):
        remake(ref.path, lambda folder: write_old_mosaic(shutil.rmtree(folder / "mosaic.zarr") or folder / "mosaic.zarr"), version=4)
    for ref in Archive.open(root).refs("condense"):
        shutil.rmtree(ref.path)
    (folder,) = Archive.open(root).runs()
    receipt = json.loads((folder / "receipt.json").read_text())
    receipt["products"] = {name: uri for name, uri in receipt["products"].items() if "signal" not in name and name != "detail"}
    receipt["stages"] = [row for row in receipt["stages"] if "condense" not in row["name"]]
    remake(folder, lambda place: (place / "receipt.json").write_text(json.dumps(receipt)), rests_on={})
    return Archive.open(root)

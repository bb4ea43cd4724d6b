"""`statistics` on the archive of a real, tiny survey: figures, tables, what is refused; and a survey by processes."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from rich.console import Console

from flows.archive.commands import DONE
from flows.archive.statistics_command import run_statistics
from pipeline.errors import ArchiveError, SettingsError
from tests.conftest import Survey

QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> Path:
    """An archive of one survey; not to be changed."""
    folder = tmp_path_factory.mktemp("surveyed")
    survey_png(folder)
    return folder


def test_figures_are_those_of_the_stored_mosaic(surveyed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As JSON: what NumPy finds in the mosaic that a stranger opens, percentiles within 1/512."""
    assert run_statistics(surveyed, "mosaic", QUIET, as_json=True) == DONE
    content = json.loads(capsys.readouterr().out)
    path = next(surveyed.glob("stages/rectify/*/mosaic.zarr"))
    values = xr.open_zarr(path, consolidated=False)["values"].values.astype(np.float64)
    assert content["product"].startswith("stages/rectify/")
    assert content["pixels"] == values[..., 0].size
    for band, row in enumerate(content["bands"]):
        one = values[..., band][np.isfinite(values[..., band])]
        assert (row["finite"], row["min"], row["max"]) == (one.size, one.min(), one.max())
        np.testing.assert_allclose([row["mean"], row["std"]], [one.mean(), one.std()], rtol=1e-12)
        below, above = (np.percentile(one, [2, 50, 98], method=method) for method in ("lower", "higher"))
        found = np.array([row["p2"], row["p50"], row["p98"]])
        assert (found >= below * (1 - 1 / 512)).all()
        assert (found <= above * (1 + 1 / 512)).all()


def test_raw_sweeps_are_counted_together(surveyed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A capture of several sweeps is one table over all of their lines."""
    assert run_statistics(surveyed, "raw_coarse", QUIET, as_json=True) == DONE
    content = json.loads(capsys.readouterr().out)
    folder = surveyed / content["product"]
    lines = [xr.open_zarr(path, consolidated=False)["dn"] for path in sorted(folder.glob("*.zarr"))]
    assert content["pixels"] == sum(one.shape[0] * one.shape[1] for one in lines)
    assert content["bands"][0]["max"] == max(int(one[..., 0].max()) for one in lines)


def test_people_read_a_table(surveyed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Wavelengths, shares and figures in columns, and how close the percentiles are."""
    run_statistics(surveyed, "mosaic", QUIET)
    out = capsys.readouterr().out
    assert all(word in out for word in ("median", "98 %", "std", "640", "100.0%", "3 bands", "within 1/512"))


def test_what_holds_no_cube_is_refused(surveyed: Path) -> None:
    """A map, a run and a name that is none: one error each that says what would do."""
    with pytest.raises(SettingsError, match=r"holds no cube of .* give a mosaic, raw lines or an ingested cube"):
        run_statistics(surveyed, "class_map", QUIET)
    run = next((surveyed / "runs").iterdir()).name
    with pytest.raises(SettingsError, match="is a run; give one of its products, such as mosaic"):
        run_statistics(surveyed, run, QUIET)
    with pytest.raises(ArchiveError, match="mosiac"):
        run_statistics(surveyed, "mosiac", QUIET)


def test_processes_make_the_same_archive(surveyed: Path, tmp_path: Path, survey_png: Survey) -> None:
    """A whole survey by two processes publishes the same keys and the same bytes as one by threads."""
    survey_png(tmp_path, scheduler="processes", workers=2)
    kept = [
        {path.relative_to(root): hashlib.sha256(path.read_bytes()).hexdigest() for path in files_of(root)}
        for root in (surveyed, tmp_path)
    ]
    assert kept[0] == kept[1]


def files_of(root: Path) -> list[Path]:
    """What stages made, but for the times in manifests."""
    return [path for path in (root / "stages").rglob("*") if path.is_file() and path.name != "manifest.json"]

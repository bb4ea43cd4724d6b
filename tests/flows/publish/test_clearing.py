"""Raw lines are cleared when a run is published that does not keep them, after comparison with the condensed signal."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spectralzoom
from spectralzoom.flows.publish import publishing
from spectralzoom.storage.arrays import signal_cubes
from spectralzoom.storage.store import Archive
from tests.conftest import Survey
from tests.flows.conftest import problems
from tests.prior_work import without_effects
from tests.storage.small_archive import flip

pytestmark = pytest.mark.usefixtures("no_effects")


@pytest.fixture(scope="module")
def surveyed(survey_png: Survey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive of a survey that was stopped before it cleared its raw lines; do not change it."""
    root = tmp_path_factory.mktemp("clearing") / "archive"
    with without_effects(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("spectralzoom.flows.survey.clear_raw", lambda stores, plan, products, run, note: run)
        survey_png(root, accuracy=False)
    return root


@pytest.fixture
def archive(surveyed: Path, tmp_path: Path) -> Archive:
    """Return a copy of it."""
    return Archive.open(shutil.copytree(surveyed, tmp_path / "archive"))


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> list[str | None]:
    """Return a list that gets the result of each comparison of raw lines with their signal."""
    compare = publishing.raw_differs
    results: list[str | None] = []

    def compared(*given: Any) -> str | None:
        results.append(compare(*given))
        return results[-1]

    monkeypatch.setattr(publishing, "raw_differs", compared)
    return results


def raw_uris(archive: Archive) -> set[str]:
    """Return the addresses of raw lines in the archive."""
    return {ref.uri for ref in archive.refs("capture") if archive.is_there(ref.uri)}


def test_the_next_survey_clears_raw_lines(archive: Archive, survey_png: Survey) -> None:
    """The archive is valid, with the same condensed lines; a reader of raw lines is referred to them.

    A survey that keeps them captures them again, and a later one that does not leaves them.
    """
    before = {name: one.values for name, one in spectralzoom.open(archive.root).latest.lines.items()}
    there = raw_uris(archive)
    assert len(there) == 2
    survey_png(archive.root, accuracy=False)
    assert raw_uris(archive) == set()
    assert problems(archive.root) == []
    again = spectralzoom.open(archive.root).latest
    for name, values in before.items():
        np.testing.assert_array_equal(again.lines[name].values, values)
    with pytest.raises(spectralzoom.Error, match="`lines` has their signal"):
        _ = again.sweeps
    for keep in ("raw", "signal"):
        survey_png(archive.root, keep=keep, accuracy=False)
        assert raw_uris(archive) == there
    assert problems(archive.root) == []


def test_what_another_process_cleared_is_cleared_or_made_again(archive: Archive, survey_png: Survey) -> None:
    """The raw lines of one pass go alone too; the mosaic, which a run shows, comes back though the map is stored."""
    (mosaic,) = archive.refs("rectify_fine")
    for ref in (archive.refs("capture")[0], mosaic):
        archive.clear(ref)
    survey_png(archive.root, accuracy=False)
    assert raw_uris(archive) == set()
    assert archive.find(mosaic.stage, mosaic.key) == mosaic
    assert problems(archive.root) == []


def test_a_flipped_bit_keeps_raw_lines(archive: Archive, survey_png: Survey, found: list[str | None]) -> None:
    """The signal is read to its last byte before."""
    there = raw_uris(archive)
    files = archive.root.glob("stages/condense_fine/*/coarse-0.zarr/scores/c/**/*")
    flip(max((path for path in files if path.is_file()), key=lambda path: path.stat().st_size), at=5)
    survey_png(archive.root, accuracy=False)
    (why,) = found
    assert "has changed since it was published" in str(why)
    assert raw_uris(archive) == there


def test_raw_lines_that_differ_from_the_signal_are_kept(
    archive: Archive, survey_png: Survey, found: list[str | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One changed score suffices; the reason names the sweep and its line."""
    read = signal_cubes.SignalCube.read

    def off(self: signal_cubes.SignalCube, start: int = 0, stop: int | None = None, *samples: slice) -> Any:
        values = read(self, start, stop, *samples).copy()
        if start == 0 and self.sweep.name == "coarse-0":
            values[3, 7, 0] += 2
        return values

    there = raw_uris(archive)
    monkeypatch.setattr(signal_cubes.SignalCube, "read", off)
    survey_png(archive.root, accuracy=False)
    assert found == ["sweep coarse-0: line 3 of the signal are not those of the raw lines"]
    assert raw_uris(archive) == there

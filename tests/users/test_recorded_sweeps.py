"""Somebody surveys sweeps that were taken before: the same map as the rig's own, fewer lines, and what goes wrong."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

import storage.readers.recordings
from flows.publish.run_folder import Published
from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from pipeline.simulator.scenes.scene import RasterScene, raster_from_values
from storage.archive.archive import Archive
from storage.archive.keys import array_digest
from storage.arrays.class_maps import load_class_map
from storage.arrays.cubes import open_raw_cube
from storage.arrays.mosaics import load_mosaic
from storage.export.recorded_files import write_recorded_files
from storage.remote.opening import verify_archive
from tests.conftest import Survey, patchy_scene
from tests.flows.tasks.test_survey_rig import emulated
from tests.remembered_work import without_effects

pytestmark = pytest.mark.usefixtures("no_effects")
QUIET = Console(quiet=True)
SIZE = (128, 96)  # x, y
NARROW = {"camera.samples": 80}  # two strips for the field
PASSES: dict[str, dict[str, Any]] = {
    "two passes": {"budget": 0.8, "policy": "entropy"},
    "every line": {"scan_step": 1},
    "every second line, shorter": {"scan_step": 2, "scan_exposure_ms": 25},
}


def field() -> RasterScene:
    """A field of three classes before the emulated rig."""
    camera = load_settings(None, dict(NARROW)).camera
    values = patchy_scene(SIZE[::-1], 3, 1)[0]
    return raster_from_values(values, camera, name="x", wavelength_nm=np.array([640.0, 550.0, 460.0]))


def rig_settings(out: Path, weights: Path, **asked: Any) -> Any:
    """Settings of a survey of the field through the rig."""
    told = {
        **{"source": "rig", "scene": "field", "size": f"{SIZE[0]}x{SIZE[1]}", "wavelengths": "640,550,460"},
        **{"rig.port": f"rig-{os.getpid()}", "rig.pulses": "position", "visit": "first", "engine": "plain"},
        **{"weights": str(weights), "out": str(out), **NARROW, **asked},
    }
    return load_settings(None, told)


def survey_sweeps(out: Path, sweeps: Path | str, **asked: Any) -> Published:
    """Survey recorded sweeps, as the command does."""
    return run_survey(load_settings(None, {"sweeps": str(sweeps), "engine": "plain", "out": str(out), **asked}), QUIET)


def digest_of_map(out: Path, published: Published) -> tuple[str, str]:
    """Hashes of class numbers and confidences."""
    found = load_class_map(out / published.receipt["products"]["class_map"])
    return array_digest(np.asarray(found.classes)), array_digest(np.asarray(found.confidence))


def write_sweeps(out: Path, published: Published, folder: Path) -> Path:
    """Write the raw cubes of a survey as ENVI files with a pointing table each."""
    products = published.receipt["products"]
    for product in ("raw_coarse", "raw_fine"):
        for path in sorted((out / products[product]).glob("*.zarr")) if product in products else ():
            write_recorded_files(open_raw_cube(path), folder)
    return folder


@pytest.mark.parametrize("asked", PASSES.values(), ids=PASSES)
def test_sweeps_of_the_rig_give_its_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path, asked: dict[str, Any]
) -> None:
    """Written as ENVI and CSV and surveyed as a recording, or out of the archive itself: the class map by hash."""
    settings = rig_settings(tmp_path / "rig", weights, **asked)
    with emulated(settings, {}, monkeypatch, scene=field()):
        published = run_survey(settings, QUIET)
    expected = digest_of_map(tmp_path / "rig", published)
    assert len(np.unique(load_class_map(tmp_path / "rig" / published.receipt["products"]["class_map"]).classes)) > 1
    folder = write_sweeps(tmp_path / "rig", published, tmp_path / "sweeps")
    plan = asked if "budget" in asked else {}
    size = f"{SIZE[0]}x{SIZE[1]}"
    of_files = survey_sweeps(tmp_path / "files", folder, weights=str(weights), size=size, **plan)
    assert digest_of_map(tmp_path / "files", of_files) == expected
    of_run = survey_sweeps(tmp_path / "again", published.folder)
    assert digest_of_map(tmp_path / "again", of_run) == expected
    for one in (of_files, of_run):
        told = one.receipt["recording"]
        assert (one.receipt["source"], told["lines_read"]) == ("recorded", told["lines_recorded"])
        assert "lines" not in one.receipt
    assert {finding.kind for finding in verify_archive(Archive.open(tmp_path / "files"))} == {"whole"}


@contextmanager
def counted_lines(patch: pytest.MonkeyPatch) -> Iterator[set[tuple[str, int]]]:
    """Count every line of a file or raw cube that is read as numbers, at the reader."""
    read: set[tuple[str, int]] = set()
    real = storage.readers.recordings._line_reader

    def line_reader(source: Any, own: NDArray[np.intp]) -> Any:
        reader = real(source, own)

        def read_lines(numbers: NDArray[np.intp]) -> NDArray[np.uint16]:
            read.update((source.name, int(line)) for line in own[numbers])
            return reader(numbers)

        return read_lines

    with patch.context() as within:
        within.setattr(storage.readers.recordings, "_line_reader", line_reader)
        yield read


@pytest.fixture(scope="module")
def full_scan(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> tuple[Path, Published, Path]:
    """A full scan of the session's picture by the simulated rig: its archive, its run, and its sweeps as files."""
    folder = tmp_path_factory.mktemp("recorded")
    with without_effects():
        published = survey_png(folder / "sim", budget=None, scan_step="1", **NARROW)
    return folder / "sim", published, write_sweeps(folder / "sim", published, folder / "sweeps")


def test_raw_cubes_of_a_simulated_survey_give_its_map(tmp_path: Path, full_scan: tuple[Path, Published, Path]) -> None:
    """An archive of a simulated survey is a recording like another, and its run says how it was planned."""
    archive, published, _ = full_scan
    again = survey_sweeps(tmp_path / "again", f"{archive}/runs/{published.folder.name}")
    assert digest_of_map(tmp_path / "again", again) == digest_of_map(archive, published)
    assert again.receipt["survey"] == published.receipt["survey"]


def test_a_budget_reads_only_the_lines_that_it_asks_for(
    tmp_path: Path, full_scan: tuple[Path, Published, Path], weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a recorded full scan two passes read their own lines and no other; the receipt says what zooming saves."""
    _, _, sweeps = full_scan
    with counted_lines(monkeypatch) as read:
        published = survey_sweeps(tmp_path / "a", sweeps, weights=str(weights), budget=0.6)
    told = published.receipt["recording"]
    recorded = sum(open_raw_cube(path).sweep.lines for path in raw_cubes(full_scan))
    assert told["lines_recorded"] == recorded
    assert told["lines_read"] == len(read) < 0.75 * recorded
    products = published.receipt["products"]
    fine = [open_raw_cube(path) for path in (tmp_path / "a" / products["raw_fine"]).glob("*.zarr")]
    coarse = [open_raw_cube(path) for path in (tmp_path / "a" / products["raw_coarse"]).glob("*.zarr")]
    assert fine
    strips = {round(open_raw_cube(path).sweep.strip_px, 6) for path in raw_cubes(full_scan)}
    assert {cube.sweep.strip_px for cube in fine} <= strips
    asked = sum(cube.sweep.lines for cube in (*coarse, *fine))
    assert len(read) <= asked
    assert told["full_scan_is"] == "recorded"
    assert told["passes_s"] <= 0.6 * told["full_scan_s"]
    assert published.receipt["savings"]["lines"] == {
        **published.receipt["savings"]["lines"],
        "done": asked,
        "full": recorded,
    }


def raw_cubes(full_scan: tuple[Path, Published, Path]) -> list[Path]:
    """Stores of the sweeps of the full scan."""
    archive, published, _ = full_scan
    return sorted((archive / published.receipt["products"]["raw_coarse"]).glob("*.zarr"))


def write_pushbroom(folder: Path, values: NDArray[np.uint16]) -> Path:
    """A cube (line, sample, band) of a straight scan as ENVI, with dark and white frames and no pointing."""
    _, samples, bands = values.shape
    folder.mkdir()
    fields = f"bands = {bands}\ninterleave = bil\nbyte order = 0\nwavelength units = nm\n"
    fields += "wavelength = {640, 550, 460}\n"
    for name, frame in (
        ("scan", values),
        ("scan.dark", np.full((1, samples, bands), 60, np.uint16)),
        ("scan.white", np.full((1, samples, bands), 3500, np.uint16)),
    ):
        head = f"ENVI\nsamples = {samples}\nlines = {len(frame)}\ndata type = 12\n{fields}"
        (folder / f"{name}.hdr").write_text(head)
        (folder / f"{name}.img").write_bytes(frame.astype("<u2").transpose(0, 2, 1).tobytes())
    return folder


@pytest.fixture
def pushbroom(tmp_path: Path) -> tuple[Path, NDArray[np.uint16]]:
    """A straight scan of 96 lines of 64 samples, and its numbers."""
    values = (patchy_scene((96, 64), 3, 3)[0] * 12 + 60).astype(np.uint16)
    return write_pushbroom(tmp_path / "drone", values), values


@pytest.mark.parametrize(
    ("column", "place"),
    [
        (None, None),
        ("position_m", lambda line: 0.05 * line),
        ("position_px", lambda line: 200.0 - line),
        ("angle_deg", lambda line: float(np.rad2deg(np.arctan((line - 47.5) * 7.4e-3 / 70)))),
    ],
)
def test_a_straight_scan_is_a_recording(
    tmp_path: Path, pushbroom: tuple[Path, NDArray[np.uint16]], weights: Path, column: str | None, place: Any
) -> None:
    """Drone, stage or conveyor: by metres, pixels or one angle a line, or, as the run says, taken to be even."""
    folder, values = pushbroom
    asked = {}
    if column is not None:
        table = tmp_path / "track.csv"
        table.write_text(column + "\n" + "".join(f"{place(line)!r}\n" for line in range(len(values))))
        asked["pointing"] = str(table)
    published = survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights), **asked)
    notes = " ".join(published.receipt["settings"]["notes"])
    assert ("scan has no pointing: taken as an even straight scan" in notes) == (column is None)
    assert ("a pixel is taken to be as long as lines are apart, 0.05 m" in notes) == (column == "position_m")
    width, height = published.receipt["settings"]["size"]
    assert (width, height) == ((64, 96) if column != "angle_deg" else (63, 95))
    mosaic = load_mosaic(tmp_path / "a" / published.receipt["products"]["mosaic"]).values
    light = (values.astype(np.float64) - 60) / (3500 - 60)
    light = light[::-1] if column == "position_px" else light
    coarse = light[:96, :64].reshape(24, 4, 16, 4, 3).mean(axis=(1, 3))
    inner = (slice(2, 20), slice(2, 14))
    assert np.nanmax(np.abs(mosaic[inner] - coarse[inner])) < (0.02 if column != "angle_deg" else 0.2)
    assert published.receipt["recording"]["lines_read"] == 96

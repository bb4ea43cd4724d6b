"""Surveys of recorded sweeps: the same map as the rig's own survey, fewer lines read, and clear errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import shapely
from numpy.typing import NDArray
from PIL import Image

import spectralzoom.storage.readers.recordings
from spectralzoom.flows.archive.commands import gc
from spectralzoom.flows.archive.reprocess_command import run_reprocess
from spectralzoom.flows.opening.recorded_field import as_its_run, usual_of_recording
from spectralzoom.flows.publish.receipt import load_receipt
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.flows.terminal.processes import DONE, PARTLY
from spectralzoom.models.weights.files import save_weights
from spectralzoom.pipeline.errors import SceneError, SettingsError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene, raster_from_values
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.storage.arrays.class_maps import load_class_map
from spectralzoom.storage.arrays.cubes import RawCubeWriter, SweepHeader, open_raw_cube
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive, array_digest
from tests.blocks import block_means
from tests.conftest import QUIET, Survey, WeightsMaker, patchy_scene, random_weights
from tests.envi_files import write_recorded_files
from tests.flows.conftest import CommandLine, be_version, command_line
from tests.flows.surveys.test_survey_rig import FAKE
from tests.flows.surveys.test_uniform_scan import RECORD
from tests.prior_work import without_effects
from tests.storage.readers.test_recordings import write_envi_cube
from tests.storage.small_archive import flip
from tests.users.zone_sketches import sketch

__all__ = ["command_line"]

pytestmark = pytest.mark.usefixtures("no_effects")
FullScan = tuple[Path, Published, Path]  # archive, run, sweeps as files
Pushbroom = tuple[Path, NDArray[np.uint16]]  # files of a straight scan, and its numbers
SIZE = (128, 96)  # x, y
NARROW = {"camera.samples": 80}  # two swaths for the field
PASSES: dict[str, dict[str, Any]] = {
    "two passes": {"budget": 0.8, "policy": "entropy"},
    "every second line down the field, shorter": {"scan_step": 2, "scan_exposure_ms": 25, "camera.samples": 96},
}


def field() -> RasterScene:
    """Return a field of three classes."""
    camera = load_settings(None, dict(NARROW)).camera
    values = patchy_scene(SIZE[::-1], 3, 1)[0]
    return raster_from_values(values, camera, name="x", wavelength_nm=np.array([640.0, 550.0, 460.0]))


def rig_settings(out: Path, weights: Path, **asked: Any) -> Any:
    """Return settings of a survey of a field of three classes through a fake rig."""
    scene = out.with_suffix(".npy")
    np.save(scene, patchy_scene(SIZE[::-1], 3, 1)[0])
    told = {
        **{"source": "rig", "scene": str(scene), "wavelengths": "640,550,460", "effects": "none"},
        **{**FAKE, "visit": "first", "engine": "plain"},
        **{"weights": str(weights), "out": str(out), **NARROW, **asked},
    }
    return load_settings(None, told)


def survey_sweeps(out: Path, sweeps: Path | str, **asked: Any) -> Published:
    """Survey recorded sweeps, as the command does."""
    return run_survey(load_settings(None, {"sweeps": str(sweeps), "engine": "plain", "out": str(out), **asked}), QUIET)


def digest_of_map(out: Path, receipt: Mapping[str, Any]) -> tuple[str, str]:
    """Return hashes of class numbers and confidences."""
    found = load_class_map(out / receipt["products"]["class_map"])
    return array_digest(np.asarray(found.classes)), array_digest(np.asarray(found.confidence))


def write_sweeps(out: Path, published: Published, folder: Path) -> Path:
    """Write the raw cubes of a survey as ENVI files with a pointing table each."""
    products = published.receipt["products"]
    for product in ("raw_coarse", "raw_fine"):
        for path in sorted((out / products[product]).glob("*.zarr")) if product in products else ():
            write_recorded_files(open_raw_cube(path), folder)
    return folder


@pytest.mark.parametrize("asked", PASSES.values(), ids=PASSES)
def test_sweeps_of_the_rig_give_its_map(tmp_path: Path, asked: dict[str, Any]) -> None:
    """The class map's hash is the same from ENVI and CSV files, and from the raw cubes of the archive."""
    weights = tmp_path / "reflectance.safetensors"
    made = random_weights((640.0, 550.0, 460.0))
    centre, spread = (np.full_like(made.normalisation.centre, level) for level in (0.3, 0.05))
    save_weights(replace(made, normalisation=replace(made.normalisation, centre=centre, spread=spread)), weights)
    settings = rig_settings(tmp_path / "rig", weights, keep="raw", **asked)
    published = run_survey(settings, QUIET)
    expected = digest_of_map(tmp_path / "rig", published.receipt)
    assert len(np.unique(load_class_map(tmp_path / "rig" / published.receipt["products"]["class_map"]).classes)) > 1
    folder = write_sweeps(tmp_path / "rig", published, tmp_path / "sweeps")
    along = {open_raw_cube(path).sweep.along for path in (tmp_path / "rig").glob("stages/capture/*/*.zarr")}
    assert along == ({"y"} if "camera.samples" in asked else {"x"})
    plan = asked if "budget" in asked else {}
    of_files = survey_sweeps(tmp_path / "files", folder, weights=str(weights), size=f"{SIZE[0]}x{SIZE[1]}", **plan)
    assert digest_of_map(tmp_path / "files", of_files.receipt) == expected
    of_run = survey_sweeps(tmp_path / "again", published.folder)
    assert digest_of_map(tmp_path / "again", of_run.receipt) == expected
    assert of_run.receipt["survey"] == published.receipt["survey"]
    for one in (of_files, of_run):
        told = one.receipt["recording"]
        assert (one.receipt["source"], told["lines_read"]) == ("recorded", told["lines_recorded"])
        assert "lines" not in one.receipt
    assert {finding.kind for finding in verify_everything(Archive.open(tmp_path / "files"))} == {"whole"}


@contextmanager
def counted_lines(patch: pytest.MonkeyPatch) -> Iterator[set[tuple[str, int]]]:
    """Yield the set of the lines that are read as numbers from files or raw cubes."""
    read: set[tuple[str, int]] = set()
    real = spectralzoom.storage.readers.recordings._line_reader

    def line_reader(source: Any, own: NDArray[np.intp]) -> Any:
        reader = real(source, own)

        def read_lines(numbers: NDArray[np.intp]) -> NDArray[np.uint16]:
            read.update((source.name, int(line)) for line in own[numbers])
            return reader(numbers)

        return read_lines

    with patch.context() as within:
        within.setattr(spectralzoom.storage.readers.recordings, "_line_reader", line_reader)
        yield read


@pytest.fixture(scope="module")
def full_scan(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> FullScan:
    """Return a full scan of the session's picture by the simulated rig: archive, run, and sweeps as files."""
    folder = tmp_path_factory.mktemp("recorded")
    with without_effects():
        published = survey_png(folder / "sim", budget=None, scan_step="1", keep="raw", **NARROW)
    return folder / "sim", published, write_sweeps(folder / "sim", published, folder / "sweeps")


def test_a_budget_reads_only_the_requested_lines(
    tmp_path: Path, full_scan: FullScan, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two passes read only their own lines of a recorded full scan; the receipt counts them against all lines."""
    with counted_lines(monkeypatch) as read:
        published = survey_sweeps(tmp_path / "a", full_scan[2], weights=str(weights), budget=0.6, keep="raw")
    told = published.receipt["recording"]
    recorded = sum(open_raw_cube(path).sweep.lines for path in raw_cubes(full_scan))
    assert told["lines_recorded"] == recorded
    assert told["lines_read"] == len(read) < 0.75 * recorded
    products = published.receipt["products"]
    fine = [open_raw_cube(path) for path in (tmp_path / "a" / products["raw_fine"]).glob("*.zarr")]
    coarse = [open_raw_cube(path) for path in (tmp_path / "a" / products["raw_coarse"]).glob("*.zarr")]
    assert fine
    swaths = {round(open_raw_cube(path).sweep.swath_px, 6) for path in raw_cubes(full_scan)}
    assert {cube.sweep.swath_px for cube in fine} <= swaths
    asked = sum(cube.sweep.lines for cube in (*coarse, *fine))
    assert len(read) <= asked
    assert told["passes_s"] <= 0.6 * told["full_scan_s"]
    lines = published.receipt["savings"]["lines"]
    assert (lines["done"], lines["full"]) == (asked, recorded)


def test_plans_use_the_recorded_exposure(tmp_path: Path, full_scan: FullScan, make_weights: WeightsMaker) -> None:
    """Both passes use the exposure of the recorded lines, not a shorter one from the weights' table."""
    asked = {"weights": str(make_weights(scans=RECORD)), "seconds": 15, "zoom": "always", "keep": "raw"}
    receipt = survey_sweeps(tmp_path / "a", full_scan[2], **asked).receipt
    assert receipt["recording"]["passes_s"] <= 15
    assert (receipt["plan"]["lines"] > 0, receipt["settings"]["scan_exposure_ms"]) == (True, None)
    assert "100 ms" in receipt["plan"]["reason"]


def test_a_budget_is_a_fraction_of_the_recorded_seconds(tmp_path: Path, survey_png: Survey, weights: Path) -> None:
    """The camera of the run has 100 ms, its lines have 10 ms: both passes use most of the time that these give."""
    quick = {"cost.reload_s": 0, "cost.capture_start_s": 0, "cost.slew_s": 0}
    asked = {"keep": "raw", "labels": None, "scan_step": "1", "scan_exposure_ms": "10", **NARROW, **quick}
    run = survey_png(tmp_path / "sim", budget=None, **asked)
    receipt = survey_sweeps(tmp_path / "a", run.folder, weights=str(weights), budget=0.6).receipt
    given_s = 0.6 * run.receipt["savings"]["capture_s"]["done"]
    assert 0.8 * given_s < receipt["recording"]["passes_s"] <= given_s
    assert receipt["plan"]["reason"].endswith("every line, 10 ms")


def test_a_recorded_scan_is_compared_with_all_of_its_lines(tmp_path: Path, full_scan: FullScan, weights: Path) -> None:
    """An area of interest limits only the map: all lines are read and count in the reference, so savings are 1."""
    at = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(7.6, 51.96)
    corner = sketch(tmp_path / "area.gpkg", {"corner": shapely.box(*at, at[0] + 5, at[1] + 5)}, 32632)
    pose = {"lon_deg": 7.6, "lat_deg": 51.96, "height_m": 100, "heading_deg": 0, "tilt_deg": 90}
    asked = {"weights": str(weights), "area": corner, "pose": pose}
    savings = survey_sweeps(tmp_path / "a", full_scan[2], **asked).receipt["savings"]
    assert [savings[name]["ratio"] for name in ("lines", "samples", "capture_s")] == [1, 1, 1]


def test_recorded_lines_of_a_run_have_its_date(full_scan: FullScan) -> None:
    """Exports, histories and prior maps then use the date of capture; an explicit visit takes precedence."""
    sweeps = str(full_scan[1].folder)
    visit = as_its_run(load_settings(None, {"sweeps": sweeps})).visit
    assert datetime.fromisoformat(visit) == datetime.fromisoformat(full_scan[1].receipt["started"])
    assert as_its_run(load_settings(None, {"sweeps": sweeps, "visit": "mine"})).visit == "mine"


def test_a_survey_of_a_run_keeps_its_reference(tmp_path: Path, survey_png: Survey, make_weights: WeightsMaker) -> None:
    """Although the coarse pass was shorter, the full scan has the camera's exposure, and settings are kept."""
    asked: dict[str, Any] = {"weights": str(make_weights(scans=RECORD)), "zoom": "always", "seconds": "15"}
    own = {"expected_loss": 0, "signal.step": 2}
    run = survey_png(tmp_path / "sim", budget=None, keep="raw", labels=None, **NARROW, **asked, **own)
    assert run.receipt["settings"]["scan_exposure_ms"] < 100
    stated = {"sweeps": str(run.folder), "expected_loss": "0.3", "zoom": "always", "signal.false_alarm": "0.02"}
    for found in (load_settings(None, stated, usual=usual_of_recording), as_its_run(load_settings(None, stated))):
        assert (found.expected_loss, found.seconds, found.budget) == (0.3, 15, None)  # a stated default counts
        assert (found.signal.step, found.signal.false_alarm) == (2, 0.02)
    again = survey_sweeps(tmp_path / "again", run.folder).receipt
    assert [again["settings"][name] for name in ("expected_loss", "signal")] == [0, run.receipt["settings"]["signal"]]
    assert again["recording"]["full_scan_s"] == run.receipt["savings"]["capture_s"]["full"]
    scan = survey_sweeps(tmp_path / "scan", run.folder, seconds=15).receipt  # with shorter exposures
    assert scan["savings"]["capture_s"]["full"] == run.receipt["savings"]["capture_s"]["full"]
    assert scan["scans"]["taken"]["seconds"] == pytest.approx(scan["savings"]["capture_s"]["done"])
    assert scan["settings"]["scan_exposure_ms"] < 100
    with pytest.raises(SettingsError, match=r"camera\.exposure_ms is for a camera, and recorded lines have their own"):
        survey_sweeps(tmp_path / "own", run.folder, **{"camera.exposure_ms": 10})


def raw_cubes(full_scan: FullScan) -> list[Path]:
    """Return the stores of the sweeps of the full scan."""
    archive, published, _ = full_scan
    return sorted((archive / published.receipt["products"]["raw_coarse"]).glob("*.zarr"))


def write_pushbroom(folder: Path, values: NDArray[np.uint16]) -> Path:
    """Write the cube (line, sample, band) of a straight scan as ENVI, with dark and white frames, without pointing."""
    folder.mkdir()
    dark, white = (np.full((1, *values.shape[1:]), level, np.uint16) for level in (60, 3500))
    for name, numbers in (("scan", values), ("scan.dark", dark), ("scan.white", white)):
        write_envi_cube(folder / f"{name}.img", numbers, wavelength="{640, 550, 460}")
    return folder


@pytest.fixture
def pushbroom(tmp_path: Path) -> Pushbroom:
    """Return the files of a straight scan of 96 lines of 64 samples, and its numbers."""
    values = (patchy_scene((96, 64), 3, 3)[0] * 12 + 60).astype(np.uint16)
    return write_pushbroom(tmp_path / "drone", values), values


@pytest.mark.parametrize(("column", "place"), [(None, None), ("position_px", lambda line: 200.0 - line)])
def test_a_straight_scan_is_surveyed_as_a_recording(
    tmp_path: Path, pushbroom: Pushbroom, weights: Path, column: str | None, place: Any
) -> None:
    """A scan by drone, stage or conveyor has a position for each line, or a note says that its lines are even."""
    folder, values = pushbroom
    asked = {}
    if column is not None:
        table = tmp_path / "track.csv"
        table.write_text(column + "\n" + "".join(f"{place(line)!r}\n" for line in range(len(values))))
        asked["pointing"] = str(table)
    published = survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights), **asked)
    notes = " ".join(published.receipt["settings"]["notes"])
    assert ("scan has no pointing: taken as an even straight scan" in notes) == (column is None)
    assert published.receipt["settings"]["size"] == [64, 96]
    mosaic = block_means(open_mosaic(tmp_path / "a" / published.receipt["products"]["mosaic"]).values(), 4)
    light = (values.astype(np.float64) - 60) / (3500 - 60)
    light = light[::-1] if column == "position_px" else light
    coarse = light.reshape(24, 4, 16, 4, 3).mean(axis=(1, 3))
    inner = (slice(2, 20), slice(2, 14))
    assert np.nanmax(np.abs(mosaic[inner] - coarse[inner])) < 0.02
    assert published.receipt["recording"]["lines_read"] == 96


@pytest.mark.parametrize("column", ["position_m", "position_px"])
def test_positions_in_metres_give_areas(tmp_path: Path, pushbroom: Pushbroom, weights: Path, column: str) -> None:
    """A pixel is as long as lines are apart; positions in pixels give no metres."""
    folder, values = pushbroom
    known = column == "position_m"
    table(folder, column, [f"{(0.05 if known else 1.0) * line!r}" for line in range(len(values))])
    published = survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights))
    receipt = published.receipt
    again = survey_sweeps(tmp_path / "b", published.folder).receipt  # of the stored lines
    assert again["field"]["ground_pixel_m"] == receipt["field"]["ground_pixel_m"]
    assert receipt["field"]["ground_pixel_m"] == (pytest.approx(0.05) if known else None)
    hectares = receipt["areas"].get("ha")
    assert (hectares is not None) == known
    if known:
        assert receipt["field"]["hectares"] == pytest.approx(64 * 96 * 0.05**2 / 1e4)
        assert sum(hectares.values()) == pytest.approx(sum(receipt["areas"]["px"].values()) * 0.05**2 / 1e4)


def mosaic_of(archive: Path, published: Published) -> NDArray[np.floating]:
    """Return the values of a mosaic as means of 4 x 4 px, without its rim."""
    return block_means(open_mosaic(archive / published.receipt["products"]["mosaic"]).values(), 4)[2:20, 2:14]


def test_lines_are_scaled_by_their_own_exposure(tmp_path: Path, pushbroom: Pushbroom, weights: Path) -> None:
    """Lines of 5 and 10 ms below a white frame of 10 ms give one field, also from the signal that a run stored."""
    folder, values = pushbroom
    expected = mosaic_of(tmp_path / "a", survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights)))
    ms = np.where(np.arange(96) // 12 % 2, 5, 10)
    numbers = np.rint(60 + (values.astype(np.float64) - 60) * ms[:, None, None] / 10).astype(np.uint16)
    write_envi_cube(folder / "scan.img", numbers, wavelength="{640, 550, 460}")
    table(folder, "position_px,exposure_ms", [f"{line},{one}" for line, one in enumerate(ms)])
    header = folder / "scan.white.hdr"
    header.write_text(header.read_text() + "exposure (ms) = 10\n")
    scaled = survey_sweeps(tmp_path / "b", folder / "scan.hdr", weights=str(weights))
    assert any("the lines with 5 to 10 ms: values are scaled" in note for note in scaled.receipt["settings"]["notes"])
    again = survey_sweeps(tmp_path / "c", scaled.folder)
    for archive, published in ((tmp_path / "b", scaled), (tmp_path / "c", again)):
        np.testing.assert_allclose(mosaic_of(archive, published), expected, atol=2e-3)


def test_a_line_may_have_fewer_samples_than_a_scan_has_steps(tmp_path: Path, make_weights: WeightsMaker) -> None:
    """Scans of more steps than samples are not offered, as their overlap would refuse the survey."""
    folder = write_pushbroom(tmp_path / "drone", np.full((96, 1, 3), 900, np.uint16))
    receipt = survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(make_weights(scans=RECORD))).receipt
    assert receipt["settings"]["size"] == [1, 96]


def table(folder: Path, header: str, rows: Sequence[str]) -> None:
    """Write the pointing table beside the cube of a straight scan."""
    (folder / "scan.pointing.csv").write_text("\n".join([header, *rows]) + "\n")


@pytest.mark.parametrize("by_value", [False, True])
def test_pixels_without_a_valid_line_have_no_class(
    tmp_path: Path, pushbroom: Pushbroom, weights: Path, by_value: bool
) -> None:
    """A third of the lines is invalid: their pixels have neither class nor confidence, and the receipt counts them."""
    folder, values = pushbroom
    if by_value:
        values[40:72] = 7
        write_envi_cube(folder / "scan.img", values, wavelength="{640, 550, 460}", data_ignore_value=7)
    else:
        table(folder, "position_px,valid", [f"{line},{int(not 40 <= line < 72)}" for line in range(96)])
    receipt = survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights)).receipt
    found = load_class_map(tmp_path / "a" / receipt["products"]["class_map"])
    lost = found.classes == UNLABELLED
    assert lost[42:70].all()
    assert not lost[:38].any()
    assert np.isnan(found.confidence[lost]).all()
    assert (receipt["pixels"]["map_without_a_class"], receipt.get("signal")) == (lost.sum(), None)
    known = 96 if by_value else 64  # ignored values are found only when the lines are read
    assert [receipt["recording"][name] for name in ("lines_read", "lines_recorded")] == [known, known]


POSITIONS = {"fewer rows": range(95), "lines far apart": range(0, 9 * 96, 9)}  # of the lines, in the pointing table
BAD = {  # flags, and the message
    "fewer rows": ("", "has 95 rows for scan, fewer than its 96 lines; give one row for each line"),
    "lines far apart": ("", "the lines of the recording lie 9 px .* apart, and a uniform scan may have up to 8 px"),
    "a frame of other bands": (
        "--white two.hdr",
        "has 2 bands from 640 to 550 nm, the cube 3 bands from 640 to 460 nm; give a",
    ),
    "frames exchanged": (
        "--dark scan.white.hdr --white scan.dark.hdr",
        "white frame is not brighter than the dark one",
    ),
    "no such table": ("--pointing nowhere.csv", "there is no pointing table .*nowhere.csv"),
    "no such recording": ("--sweeps nowhere", "there is no recording nowhere; check the name"),
    "an archive among them": ("--out .", "--out = '.' is the folder of the sweeps, and would hide them; choose"),
    "a scene": ("--scene farm", "--scene = 'farm', and the field of recorded sweeps is what they show; leave it out"),
    "simulated rig": ("--source sim", "--sweeps is for recorded sweeps, and source = 'sim'; give --source recorded"),
    "a part of the field": ("--extent part --seconds 5", "--extent = 'part' chooses lines to capture"),
    "a scan's exposure": ("--scan-step 1 --scan-exposure-ms 5", "--scan-exposure-ms is for a camera.* leave it out"),
    "an exposure": ("--budget 0.5 --scan-exposure-ms 25", "--scan-exposure-ms is for a camera.* leave it out"),
    "too little time": ("--budget 0.01", "full scan's [0-9.]+ s; give more, or take one uniform scan"),
}


@pytest.mark.parametrize("mistake", BAD)
def test_bad_input_gives_one_message(
    command_line: CommandLine, monkeypatch: pytest.MonkeyPatch, pushbroom: Pushbroom, weights: Path, mistake: str
) -> None:
    """The command prints one message with value and remedy, no traceback, and writes no archive."""
    folder, _ = pushbroom
    flags, message = BAD[mistake]
    monkeypatch.chdir(folder)
    write_envi_cube(folder / "two.img", np.full((1, 64, 2), 3500, np.uint16), wavelength="{640, 550}")
    if mistake in POSITIONS:
        table(folder, "position_px", [str(position) for position in POSITIONS[mistake]])
    asked = ["--engine", "plain", *([] if "--out" in flags else ["--out", "a"]), "--weights", weights]
    sweeps = [] if "--sweeps" in flags else ["--sweeps", "scan.hdr"]
    ended = command_line("survey", *sweeps, *asked, *flags.split())
    ended.refused(2 if ended.code == 2 else 1, message)  # 2 if the settings alone are wrong
    assert not [path for path in (folder / "a", folder / "stages") if path.exists()]


def test_source_recorded_needs_sweeps(command_line: CommandLine, tmp_path: Path) -> None:
    """Without --sweeps the command is refused, and the message names the flag."""
    command_line("survey", "--source", "recorded", "--scene", "field", "--out", tmp_path / "a").refused(
        2, "source = 'recorded' reads sweeps that were taken before; give --sweeps"
    )


def test_a_rig_survey_is_reprocessed_from_raw(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, weights: Path) -> None:
    """After a new version of the capture, the archive's lines give the same map without the rig, and only once."""
    archive = tmp_path / "rig"
    published = run_survey(rig_settings(archive, weights, keep="raw", scan_step=2), QUIET)
    be_version(monkeypatch, "capture", 99)
    assert run_reprocess(archive, QUIET) == 0
    first, second = Archive.open(archive).runs()
    again = load_receipt(second)
    assert first == published.folder
    assert (again["source"], again["survey"]) == ("recorded", published.receipt["survey"])
    assert digest_of_map(archive, again) == digest_of_map(archive, published.receipt)
    assert run_reprocess(archive, QUIET) == 0
    assert len(Archive.open(archive).runs()) == 2


def test_a_recording_is_reprocessed_after_its_files_moved(
    tmp_path: Path, pushbroom: Pushbroom, weights: Path, make_weights: WeightsMaker
) -> None:
    """New weights read the archive's raw cubes, and give the same map as the moved files."""
    folder, _ = pushbroom
    archive = tmp_path / "a"
    survey_sweeps(archive, folder / "scan.hdr", weights=str(weights), keep="raw")
    folder.rename(tmp_path / "elsewhere")
    other = make_weights(dim=24)
    assert run_reprocess(archive, QUIET, weights=other) == 0
    again = load_receipt(Archive.open(archive).runs()[-1])
    assert again["settings"]["keep"] == "raw"
    fresh = survey_sweeps(tmp_path / "b", tmp_path / "elsewhere" / "scan.hdr", weights=str(other))
    assert digest_of_map(archive, again) == digest_of_map(tmp_path / "b", fresh.receipt)


def test_a_recording_that_is_there_is_reprocessed_from_its_files(
    tmp_path: Path, pushbroom: Pushbroom, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Raw lines that were cleared, and that a new version of a later stage needs, are read from it again."""
    folder, _ = pushbroom
    survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights))
    be_version(monkeypatch, "condense", 99)
    assert run_reprocess(tmp_path / "a", QUIET) == 0
    runs = Archive.open(tmp_path / "a").runs()
    assert [load_receipt(run)["settings"]["sweeps"] for run in runs] == [str(folder / "scan.hdr")] * 2


def test_a_damaged_signal_of_a_recording_goes_on_request(tmp_path: Path, pushbroom: Pushbroom, weights: Path) -> None:
    """It is the only copy in the archive, so it stays; with --raw-too the next survey reads the recording again."""
    folder, _ = pushbroom
    survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights))
    (chunk, *_) = sorted((tmp_path / "a").glob("stages/condense/*/*.zarr/scores/c/0/0/0"))
    flip(chunk, 40)
    assert gc(tmp_path / "a", damaged=True) == PARTLY
    assert chunk.is_file()
    assert gc(tmp_path / "a", damaged=True, raw_too=True) == DONE
    survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights))
    assert {finding.kind for finding in verify_everything(Archive.open(tmp_path / "a"))} == {"whole"}


def test_labels_of_a_recording_give_accuracy(tmp_path: Path, pushbroom: Pushbroom, weights: Path) -> None:
    """Labels must have the size of the field; those of another size are refused."""
    folder, _ = pushbroom
    Image.fromarray(patchy_scene((96, 64), 3, 3)[1]).save(tmp_path / "labels.png")
    labels = str(tmp_path / "labels.png")
    published = survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights), labels=labels)
    assert 0 < published.receipt["accuracy"]["overall_accuracy"] < 1
    Image.fromarray(patchy_scene((90, 64), 3, 3)[1]).save(tmp_path / "labels.png")
    with pytest.raises(SceneError, match="are 90 x 64 px, the scene is 96 x 64 px"):
        survey_sweeps(tmp_path / "b", folder / "scan.hdr", weights=str(weights), labels=labels)


def test_recorded_swaths_are_surveyed_in_two_passes(tmp_path: Path, weights: Path) -> None:
    """The swaths lie at positions that no plan would choose, and both passes use exactly these."""
    own = [Sweep(f"mine-{at}", "fine", "x", at, -52.5, 106) for at in (-35.0, 4.0, 38.0)]
    camera = load_settings(None, dict(NARROW)).camera
    source = SimulatedSource(field(), Rig(camera), seed=3)
    for sweep in own:
        header = SweepHeader(sweep, source.references(sweep), source.wavelength_nm, None, "sim")
        with RawCubeWriter(tmp_path / "raw" / f"{sweep.name}.zarr", header) as cube:
            cube.write(source.lines(sweep))
    for path in sorted((tmp_path / "raw").glob("*.zarr")):
        write_recorded_files(open_raw_cube(path), tmp_path / "files")
    asked = {"weights": str(weights), "size": "120x96", "budget": 0.7, "policy": "entropy", "keep": "raw"}
    published = survey_sweeps(tmp_path / "a", tmp_path / "files", **asked)
    raw = {
        path.stem: open_raw_cube(path).sweep
        for product in ("raw_coarse", "raw_fine")
        for path in (tmp_path / "a" / published.receipt["products"][product]).glob("*.zarr")
    }
    assert {round(sweep.swath_px) for sweep in raw.values() if sweep.step == 4} == {-35, 4, 38}
    assert {round(sweep.swath_px) for sweep in raw.values()} == {-35, 4, 38}
    assert published.receipt["recording"]["lines_read"] < 318
    assert np.isfinite(open_mosaic(tmp_path / "a" / published.receipt["products"]["mosaic"]).values()).mean() > 0.99


def test_a_16_bit_recording_is_surveyed_and_reprocessed(tmp_path: Path, weights: Path) -> None:
    """The receipt's camera has the bits and the line period of the recording, and reprocessing finds nothing to do."""
    folder = write_pushbroom(tmp_path / "drone", (patchy_scene((96, 64), 3, 3)[0] * 200 + 60).astype(np.uint16))
    table(folder, "time,position_px", [f"{3.5 * line},{line}" for line in range(96)])
    published = survey_sweeps(tmp_path / "a", folder / "scan.hdr", weights=str(weights))
    camera = published.receipt["settings"]["camera"]
    assert (camera["bits"], camera["exposure_ms"] + camera["readout_ms"]) == (16, 3500)
    assert run_reprocess(tmp_path / "a", QUIET) == 0
    assert len(Archive.open(tmp_path / "a").runs()) == 1

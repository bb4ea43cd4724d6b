"""A survey of one uniform scan: capture, storage, reading and report; the choice between scans and two passes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from PIL import Image

from spectralzoom.flows.archive.plan_command import plan_content
from spectralzoom.flows.archive.reprocess_command import run_reprocess
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.publish.receipt_table import finding_rows
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.errors import BudgetError, SettingsError, WeightsError
from tests.conftest import QUIET, Flags, Survey, WeightsMaker
from tests.prior_work import with_effects

RECORD = {
    "scenes": 3,
    "steps": [1, 2, 4],
    "exposures_ms": [100.0, 25.0, 6.0],
    "miou": [[0.94, 0.93, 0.89], [0.92, 0.91, 0.85], [0.83, 0.81, 0.74]],
    "spread": [[0.02] * 3, [0.03] * 3, [0.04] * 3],
    "per_class_iou": {"class_1": [[0.8, 0.7, 0.6], [0.7, 0.65, 0.5], [0.5, 0.4, 0.3]]},
}
pytestmark = pytest.mark.usefixtures("no_effects")

BY_HAND: dict[str, Any] = {"budget": None, "scan_step": "2", "scan_exposure_ms": "25", "accuracy": False}


@pytest.fixture(scope="module")
def recorded(make_weights: WeightsMaker) -> Path:
    """Return tiny weights with scan performance."""
    return make_weights(scans=RECORD)


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey, recorded: Path) -> tuple[Path, Any]:
    """Return archive and run of a survey of every second line with 25 ms, set by hand."""
    out = tmp_path_factory.mktemp("scanned")
    with with_effects():  # noise has scores of its own size
        return out, survey_png(out, **BY_HAND, weights=str(recorded))


def _store(out: Path, name: str) -> xr.Dataset:
    (path,) = out.glob(f"**/{name}.zarr")
    return xr.open_zarr(path, consolidated=False)


def test_a_uniform_scan_covers_the_field_once(scanned: tuple[Path, Any]) -> None:
    """One pass of unbinned lines 2 px apart covers every patch, in the seconds of these lines."""
    out, published = scanned
    cubes = [xr.open_zarr(path, consolidated=False) for path in out.glob("stages/condense/*/*.zarr")]
    assert {value for cube in cubes for value in cube["exposure_ms"].values.tolist()} == {25.0}
    assert {cube.sizes["sample"] for cube in cubes} == {640}
    lines = sum(cube.sizes["line"] for cube in cubes)
    assert 96 / 2 <= lines <= 96 / 2 + 4
    assert published.receipt["savings"]["capture_s"]["done"] == pytest.approx(0.025 * (lines + 2) + 0.25 + 1.6)
    assert (_store(out, "mosaic")["coverage"].values > 0).all()
    assert published.receipt["savings"]["patches"]["ratio"] == 1


def test_receipt_and_page_describe_the_scan(scanned: tuple[Path, Any]) -> None:
    """They give its expected mIoU and the best scan of the same seconds; nothing on the page is about a second pass."""
    _, published = scanned
    receipt = published.receipt
    page = (published.folder / "report.html").read_text(encoding="utf-8")
    assert receipt["plan"]["kind"] == "scan"
    taken = receipt["scans"]["taken"]
    assert (taken["step"], taken["exposure_ms"], taken["expected_miou"]) == (2, 25.0, pytest.approx(0.91))
    assert taken["seconds"] == pytest.approx(receipt["savings"]["capture_s"]["done"])
    assert receipt["scans"]["best_in_time"]["expected_miou"] >= taken["expected_miou"]
    assert "captured again" not in page
    capture = receipt["savings"]["capture_s"]
    assert capture["done"] < capture["full"] == pytest.approx(receipt["field"]["camera_s"]["full_scan"])
    assert "the field was scanned once: every 2nd line, 25 ms" in page
    assert "expected mIoU 91.0 ± 3.0" in page


def test_seconds_choose_a_scan(survey_png: Survey, recorded: Path, make_weights: WeightsMaker, tmp_path: Path) -> None:
    """The scan ends in time and the settings name it; reprocessing with other weights uses the stored lines."""
    published = survey_png(tmp_path, budget=None, seconds="4", weights=str(recorded))
    settings = published.receipt["settings"]
    assert 3.5 < published.receipt["savings"]["capture_s"]["done"] <= 4
    assert settings["seconds"] == 4
    assert settings["scan_step"] in (1, 2, 4)
    flat = {**RECORD, "miou": [[0.5] * 3, [0.5] * 3, [0.9, 0.5, 0.5]]}  # these would have taken every fourth line
    captured = {path.parent.name for path in tmp_path.glob("stages/condense/*/*.zarr")}
    assert run_reprocess(tmp_path, QUIET, weights=make_weights(scans=flat)) == 0
    assert {path.parent.name for path in tmp_path.glob("stages/condense/*/*.zarr")} == captured
    newest = max(tmp_path.glob("runs/*/receipt.json"), key=lambda path: path.stat().st_mtime)
    again = json.loads(newest.read_text())
    for name in ("scan_step", "scan_exposure_ms"):
        assert again["settings"][name] == settings[name]
    assert {one["name"]: one["state"] for one in again["stages"]}["capture_coarse"] == "cached"


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ({"seconds": "0.5"}, BudgetError, r"--seconds 0\.5; the least is \d"),
        ({"seconds": "nan"}, SettingsError, r"--seconds must be a number from 0\.1"),
        ({"seconds": "5", "budget": "0.5"}, SettingsError, r"--seconds asks for one uniform scan .* --budget is for"),
        ({"macs": "50%", "budget": "0.5"}, SettingsError, r"--macs is .* two passes: leave it out, or --bud"),
        ({"seconds": "5", "scan_step": "2"}, SettingsError, r"--scan-step makes it: leave one out"),
        (
            {"seconds": "5", "extent": "part", "zoom": "always"},
            SettingsError,
            r"--extent is for one .* or zoom and budget",
        ),
        ({"seconds": "5", "camera.exposure_ms": "5"}, SettingsError, r"starts at 6 ms.*--scan-step"),
        ({"scan_exposure_ms": "25"}, SettingsError, r"give --scan-step too"),
        ({"scan_step": "0"}, SettingsError, r"--scan-step must be a whole number from 1 to 8"),
    ],
)
def test_impossible_requests_are_refused(
    survey_png: Survey, recorded: Path, tmp_path: Path, given: dict[str, str], error: type[Exception], words: str
) -> None:
    """One message gives the value, the limits and a remedy; no archive is made."""
    with pytest.raises(error, match=words):
        survey_png(tmp_path / "out", **{"budget": None, "weights": str(recorded)} | given)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("exposure_ms", "told"), [("6", True), ("5", False), ("100", True), ("101", False)])
def test_a_scan_beyond_the_scan_performance_has_no_expected_miou(
    flags_png: Flags, recorded: Path, tmp_path: Path, exposure_ms: str, told: bool
) -> None:
    """Any exposure may be set by hand; exposures outside of 6 to 100 ms have no expected mIoU."""
    given = flags_png(tmp_path, weights=str(recorded), scan_step="2", scan_exposure_ms=exposure_ms)
    assert (plan_content(load_settings(None, given))["scans"]["taken"] is not None) == told


def test_weights_without_scan_performance_scan_by_hand(survey_png: Survey, tmp_path: Path) -> None:
    """--seconds is refused with an alternative, and a scan set by hand has no expected mIoU."""
    with pytest.raises(WeightsError, match=r"no record of uniform scans.*--scan-step and .*validation scenes"):
        survey_png(tmp_path / "none", budget=None, seconds="5")
    published = survey_png(tmp_path / "by hand", budget=None, scan_step="4")
    assert "scans" not in published.receipt
    assert "full_scan" not in published.receipt["savings"]["capture_s"]
    assert published.receipt["plan"]["reason"] == "the field was scanned once: every 4th line, 100 ms"


def test_a_receipt_has_the_fraction_of_saturated_spectra(survey_png: Survey, tmp_path: Path) -> None:
    """The exposure is too long for the bright part of the field; the fraction equals that of the raw lines."""
    published = survey_png(tmp_path, **BY_HAND | {"scan_exposure_ms": "200", "keep": "raw"})
    (cube,) = (xr.open_zarr(path, consolidated=False) for path in tmp_path.glob("stages/capture/*/*.zarr"))
    saturated = float((cube["dn"].to_numpy() >= 4095).any(axis=2).mean())
    assert 0.01 < saturated < 0.5
    assert published.receipt["signal"] == {"saturated": pytest.approx(saturated)}
    assert "of the spectra have saturated bands" in dict(finding_rows(published.receipt))["signal"]
    assert "signal" not in survey_png(tmp_path, **BY_HAND).receipt


@pytest.mark.parametrize("limit", [{}, {"macs": "80%", "policy": "sobel"}], ids=str)
def test_the_cheapest_good_scan_is_the_usual(survey_png: Survey, recorded: Path, tmp_path: Path, limit: Any) -> None:
    """It is the reference, within 0.5 points of the best; a limit of multiply-adds alone holds for it."""
    with with_effects():  # noise has scores of its own size
        receipt = survey_png(tmp_path, weights=str(recorded), budget=None, **limit).receipt
    assert receipt["savings"]["multiply_adds"]["ratio"] <= (0.8 if "macs" in limit else 1)
    taken = receipt["scans"]["taken"]
    capture = receipt["savings"]["capture_s"]
    assert taken == receipt["scans"]["reference"]
    assert (receipt["settings"]["scan_step"], receipt["settings"]["budget"]) == (taken["step"], None)
    assert capture["done"] == pytest.approx(taken["seconds"])
    assert capture["done"] < capture["full"]
    assert taken["expected_miou"] >= 0.94 - 0.005


@pytest.mark.parametrize(("name", "value"), [("policy", "sobel"), ("zoom", "always")])
def test_flags_of_two_passes_select_two_passes(recorded: Path, name: str, value: str) -> None:
    """A flag without a use in a uniform scan is not ignored."""
    flags = {"scene": "farm", "weights": str(recorded)}
    assert load_settings(None, {**flags, name: value}).budget == 0.5
    assert not load_settings(None, flags).plain
    assert not load_settings(None, flags).zooms


@pytest.mark.parametrize("shape", [(1, 1, 3), (32, 32)])
@pytest.mark.parametrize("source", ["raster", "sim"])
def test_scenes_of_any_size_need_no_flag(weights: Path, tmp_path: Path, shape: tuple[int, ...], source: str) -> None:
    """A scene of one pixel or one band gets a map of its size; with a camera every line is captured."""
    values = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    Image.fromarray(values).save(tmp_path / "scene.png")
    flags = {"scene": str(tmp_path / "scene.png"), "weights": str(weights), "source": source, "engine": "plain"}
    published = run_survey(load_settings(None, flags | {"out": str(tmp_path / "out"), "effects": None}), QUIET)
    assert _store(tmp_path / "out", "class_map")["classes"].shape == shape[:2]
    if source == "sim":
        assert published.receipt["plan"]["kind"] == "scan"
        assert any("every line is captured" in note for note in published.receipt["settings"]["notes"])


def test_spacings_that_do_not_fit_are_no_candidates(tmp_path: Path) -> None:
    """Every 8th line of 640 px cannot overlap by 712 px: it is no candidate, and refused on request."""
    farm = {"size": "160x128", "pointing_px": "100"}
    scans = plan_content(load_settings(None, farm | {"out": str(tmp_path), "scan_step": "1"}))["scans"]
    assert {one["step"] for one in scans["candidates"]} == {1, 2, 4}
    with pytest.raises(SettingsError, match="overlap by 712 px of a line of 640 px; give less than 64"):
        planned(tmp_path, **farm, scan_step="8")
    with pytest.raises(SettingsError, match="a line of 64 px; lines are too short"):
        planned(tmp_path, **farm, **{"camera.samples": "64"})


def test_a_faster_coarse_pass_gives_its_seconds_to_the_fine_pass(survey_png: Any, tmp_path: Path) -> None:
    """The budget is the same; the cubes hold the exposure of each pass."""
    usual = survey_png(tmp_path / "usual", budget="0.6").receipt
    fast = survey_png(tmp_path / "fast", budget="0.6", scan_exposure_ms="25").receipt
    found = (tmp_path / "fast").glob("stages/condense*/*/*.zarr")
    cubes = {path.stem: xr.open_zarr(path, consolidated=False) for path in found}
    coarse = [cube for name, cube in cubes.items() if name.startswith("coarse")]
    assert {value for cube in coarse for value in cube["exposure_ms"].values.tolist()} == {25.0}
    assert {len(set(np.diff(cube["time"].values).round(6).tolist())) for cube in coarse} == {1}
    fine = [cube for name, cube in cubes.items() if name.startswith("fine")]
    assert {value for cube in fine for value in cube["exposure_ms"].values.tolist()} == {100.0}
    fine_s = [receipt["plan"]["seconds"] for receipt in (usual, fast)]
    coarse_s = [one["savings"]["capture_s"]["done"] - fine for one, fine in zip((usual, fast), fine_s, strict=True)]
    spared_s = (sum(cube.sizes["line"] for cube in coarse) + 2 * len(coarse)) * 0.075  # lines, and frames to settle
    assert coarse_s[0] - coarse_s[1] == pytest.approx(spared_s)
    assert fine_s[1] > fine_s[0] + spared_s / 2
    seconds = [receipt["savings"]["capture_s"] for receipt in (usual, fast)]
    assert seconds[0]["full"] == seconds[1]["full"]
    assert all(one["done"] <= 0.6 * one["full"] for one in seconds)


WIDE = {"camera.samples": "80", "seconds": "27"}  # eight swaths; the default camera covers the field with one


def planned(out: Path, **flags: str) -> SurveyPlan:
    """Return the plan of a survey of the farm."""
    settings = load_settings(None, {"scene": "farm", "size": "640x512", "out": str(out), **flags})
    return plan_survey(open_field(settings, planning=True))


@pytest.mark.parametrize(
    ("flags", "zooms"),
    [
        (WIDE, True),
        ({**WIDE, "seconds": "182", "sky.light_fraction": "0.0625"}, True),
        ({**WIDE, "camera.samples": "160", "seconds": "14"}, False),  # four swaths
        ({**WIDE, "camera.samples": "640", "seconds": "6"}, False),
        ({**WIDE, "seconds": "200"}, False),  # a uniform scan is as good as the best
        ({"camera.samples": "80"}, False),
        ({**WIDE, "zoom": "never"}, False),
        ({**WIDE, "macs": "60%"}, False),
        ({"size": "5120x4096", "seconds": "150"}, True),
        ({"size": "5120x4096", "seconds": "150", "pointing_px": "2"}, False),
    ],
    ids=str,
)
def test_two_passes_are_taken_on_wide_fields_in_short_times(tmp_path: Path, flags: dict[str, str], zooms: bool) -> None:
    """The settings of the run name the choice, and no limit of a uniform scan is dropped."""
    plan = planned(tmp_path, **flags)
    assert (plan.settings.zoom, plan.passes.plain) == ("always" if zooms else "never", not zooms)
    exposures = {sweep.exposure_ms for sweep in plan.typical}  # simulated effects are chosen for these
    assert (len(exposures) >= 3) if zooms else (plan.typical == tuple(plan.passes.coarse))
    assert (plan.scans.chosen is None) == zooms
    assert any(note.startswith("two passes: every 4th line") for note in plan.notes) == zooms


def test_the_chosen_plan_equals_that_of_zoom_always(tmp_path: Path) -> None:
    """First pass and remaining time are those of `--zoom always`, and so are the settings of the run."""
    chosen, asked = planned(tmp_path, **WIDE), planned(tmp_path, **WIDE, zoom="always")
    assert (chosen.passes, chosen.settings) == (asked.passes, asked.settings)
    assert chosen.passes.coarse_s + chosen.passes.fine_s == pytest.approx(27)


def test_the_line_spacing_of_the_first_pass_may_be_given(tmp_path: Path) -> None:
    """The exposure is the best for that spacing; by default the weights choose every 4th line."""
    steps = {"scan_step": "8"}, {}, {"scan_step": "8", "seconds": None, "budget": "0.5"}
    given, usual, half = (planned(tmp_path, **{**WIDE, "zoom": "always", **one}) for one in steps)
    assert [plan.settings.scan_step for plan in (given, usual, half)] == [8, 4, 8]
    asked, taken = given.passes, usual.passes
    assert asked.coarse_s < taken.coarse_s < asked.coarse_s + asked.fine_s == pytest.approx(27)

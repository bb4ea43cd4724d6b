"""Settings: defaults, precedence, and errors that name place and remedy."""

from __future__ import annotations

import json
import math
import shlex
import tomllib
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from spectralzoom.flows.archive.commands import command
from spectralzoom.flows.cli.main import build_app
from spectralzoom.flows.settings.documents import example_toml, settings_table
from spectralzoom.flows.settings.flags import KEYS, by_setting
from spectralzoom.flows.settings.load import declared, nested
from spectralzoom.flows.settings.settings import Settings, load_settings, parse_settings
from spectralzoom.pipeline.errors import BudgetError, SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import CostModel
from spectralzoom.pipeline.ground.view import RigPose
from spectralzoom.pipeline.simulator.effects.probe import Tolerance
from spectralzoom.pipeline.simulator.render import EFFECTS
from spectralzoom.pipeline.simulator.rig_model import Air, Detector, Optics, Rig, Sky
from spectralzoom.storage.whole_files import to_json

EXAMPLE = Path(__file__).parents[3] / "survey.example.toml"
POSE = {"lon_deg": 9.5, "lat_deg": 52.1, "heading_deg": 30, "tilt_deg": 40, "height_m": 12}


@pytest.fixture
def toml(tmp_path: Path):
    """Return a function that writes text as a survey's file and returns its path."""

    def write(text: str) -> Path:
        path = tmp_path / "survey.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_defaults_and_parts_are_read_back():
    """Without file and flags the defaults of the design hold; every table and the list of all effects parse."""
    found = load_settings()
    assert found == Settings()
    assert (found.scene, found.budget, found.policy, found.memory) == ("farm", None, "gain", 4 * 2**30)
    assert parse_settings(found.to_dict()) == found
    every = ",".join(effect.name for effect in EFFECTS)
    assert parse_settings({"effects": every}).effects == every


def test_flags_and_files_give_the_same_settings(toml):
    """Flags override the file, commas make lists, and relative paths of a file start at its folder."""
    path = toml('budget = 0.4\npolicy = "sobel"\n[camera]\nexposure_ms = 50\nbits = 10\n')
    found = load_settings(path, {"budget": "0.3", "camera.exposure_ms": 20, "seed": None})
    assert (found.budget, found.policy, found.seed) == (0.3, "sobel", 0)
    assert (found.camera.exposure_ms, found.camera.bits) == (20.0, 10)
    path = toml('scene = "field.npy"\nlabels = "/data/labels.png"\nsource = "sim"\n')
    found = load_settings(path, {"out": "here"})
    assert found.scene == str(path.parent / "field.npy")
    assert (found.labels, found.source, found.out) == ("/data/labels.png", "sim", "here")
    assert load_settings(toml('scene = "farm"')).scene == "farm"
    one = load_settings(flags={"bands": "0, 2", "wavelengths": "660,800.5", "size": "300x20", "effects": "shot,slit"})
    two = parse_settings({"bands": [0, 2], "wavelengths": [660, 800.5], "size": [300, 20], "effects": ["slit", "shot"]})
    assert one == two
    assert (one.shape, one.effects) == ((20, 300), "slit,shot")


def test_the_example_file_has_every_default():
    """It is valid and equals the output of `python -m spectralzoom.flows.settings.documents > survey.example.toml`."""
    assert load_settings(EXAMPLE).but(out="archive") == Settings()
    assert [load_settings(EXAMPLE, one).plain for one in ({"seconds": "5"}, {"policy": "sobel"})] == [True, False]
    assert EXAMPLE.read_text(encoding="utf-8") == example_toml()
    lines = [line.removeprefix("# ") for line in EXAMPLE.read_text(encoding="utf-8").splitlines()]
    named = {line.partition("=")[0].strip() for line in lines if "=" in line}
    for name, keys in declared(Settings).items():
        assert not name or f"[{name}]" in lines
        assert set(keys) <= named, name


def test_documents_have_every_setting_with_its_default():
    """Each has one row of help with equal cells, and a default within its own range."""
    rows = [line.split(" | ") for line in settings_table().splitlines() if line.startswith("| `")]
    keys = [(name, key, one) for name, table in declared(Settings).items() for key, one in table.items()]
    assert [row[0].strip("| `") for row in rows] == [key for _, key, _ in keys]
    assert {len(row) for row in rows} == {4}
    assert ["| `samples`", "`640`", "a whole number from 16 to 65536", "Pixels of a line [px] |"] in rows
    of_others = {"mask", "max_age", "plots_name", "interest", "scan_exposure_ms", "pointing", "dark", "white", "sweeps"}
    for name, key, one in keys:
        assert one["about"], key
        value = one.get("usual") if one["example"] is None else one["example"]
        if not name and key not in of_others:
            assert parse_settings({"scene": "farm", key: value}) is not None


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("budgt = 0.5", "did you mean 'budget'"),
        ("[camera]\nexposure = 100", "did you mean 'camera.exposure_ms'"),
        ("exposure_ms = 100", "did you mean 'camera.exposure_ms'"),
    ],
)
def test_unknown_key_is_refused_with_the_nearest(toml, line, hint):
    """A misspelt key is reported with the file."""
    with pytest.raises(SettingsError, match=rf"unknown setting.*survey\.toml; {hint}"):
        load_settings(toml(line))


@pytest.mark.parametrize("budget", ["abc", 0, "0", -1, 1.5, float("nan"), True, float("inf"), [0.5]])
def test_budget_out_of_range_is_refused(budget):
    """A budget is a fraction above 0 and at most 1; the error says so and exits with 2."""
    with pytest.raises(BudgetError, match="above 0 and at most 1, got") as caught:
        load_settings(flags={"budget": budget})
    assert caught.value.exit_code == 2
    assert str(caught.value).startswith("--budget")


def test_amounts_have_units():
    """50% of a scan is 0.5, and 1 is all of it; binary and decimal units of bytes differ."""
    found = parse_settings({"budget": "50%", "memory": "1.5gib", "workers": None})
    assert (found.budget, found.memory) == (0.5, 3 * 2**29)
    found = parse_settings({"budget": 1, "memory": "500 MB"})
    assert (found.budget, found.memory) == (1.0, 500_000_000)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"memory": "4"}, "at least 256MiB"),
        (
            {"scheduler": "dask"},
            "'scheduler' must be threads, processes, or the address of a dask scheduler such as tcp:",
        ),
        ({"workers": 0}, "a whole number from 1 to 1024, got 0$"),
        ({"scheduler": ""}, "^'scheduler' must be text that is not empty"),
        ({"seed": -1}, "whole number from 0"),
        ({"policy": "entropi"}, "one of gain, entropy, sobel, random, mask"),
        ({"policy": "mask"}, "needs a mask file"),
        ({"mask": "m.png"}, "policy 'mask' only"),
        ({"effects": "smear,turbulance"}, "did you mean 'turbulence'"),
        ({"effects": "auto,slit"}, "'auto' stands alone, got 'auto,slit'"),
        ({"effects": []}, "no effect is named"),
        ({"tol": -0.1}, "'tol' must be 0 or more, in sigmas of the noise such as 0.1, or in DN .* got -0.1"),
        ({"optics": {"aperture_mm": 0.015}}, "from 0.1 to 1000 mm, got 0.015$"),
        ({"optics": {"focus_m": 0}}, "of at least 0.01 m or inf, got 0"),
        ({"rig": {"with_crc": "maybe"}}, "true or false"),
        ({"air": {"relief": "hills"}}, "one of flat, step, plane; got 'hills'"),
        ({"air": {"nearest_m": 20}}, "'air.nearest_m' and air.farthest_m lie around air.distance_m: give it too"),
        ({"air": {"distance_m": 30, "nearest_m": 40, "farthest_m": 20}}, "lies between its nearest and its farthest"),
        ({"air": {"distance_m": 30, "relief": "step"}}, "'air.relief' = 'step' needs air.nearest_m or air.farthest_m"),
        ({"sky": {"started": "noon"}}, "must be a date and time with its zone, such as .* got noon"),
        ({"sky": {"started": datetime(2026, 6, 1, 12)}}, "needs a time zone: write 2026-06-01T12:00:00Z for UTC"),
        ({"bands": [0, 0]}, "names a band twice"),
        ({"bands": "0;1"}, "counted from 0"),
        ({"bands": [0, 1], "wavelengths": [660]}, "each of the 2 bands, got 1"),
        ({"scene": "field.png", "hour": 9.5}, "'hour' = 9.5 is for built-in scenes, whose crops grow; field.png"),
        ({"scene": "farm", "day": 0}, "'day' must be a whole number from 1 to 366, got 0"),
        ({"scene": "farm", "hour": 25}, "'hour' must be a number from 0 to 24 h"),
        ({"size": "1280"}, "WIDTHxHEIGHT"),
        ({"size": "64x64", "scene": "a.png"}, "has its own"),
        (
            {"scene": "farm@3"},
            "no scene farm@3: give one of farm, farm@2, scouting, .*, or a file; --seed has the seed",
        ),
        ({"camera": 3}, "must be a table"),
        ({"camera": {"dark_dn": 5000}}, "leaves no room"),
        ({"out": " "}, "text that is not empty"),
        ({"device": "gpu"}, "'device' must be one of auto, cpu, cuda, mps; got 'gpu'"),
        ({"out": "a\0b"}, "text without a null character"),
        ({"pose": {"lat_deg": 52.1, "tilt_deg": 40}}, r"\[pose\] lacks lon_deg, heading_deg; give every one"),
        ({"pose": POSE | {"range_m": 20}}, r"\[pose\]: .* height_m or range_m, one of the two; got height_m = 12"),
    ],
)
def test_wrong_values_are_refused(table, words):
    """The message for each wrong value gives the allowed values."""
    with pytest.raises(SettingsError, match=words):
        parse_settings(table)


NUMBERS = [
    (f"{table}.{key}".lstrip("."), one)
    for table, keys in declared(Settings).items()
    for key, one in keys.items()
    if one.get("type") in ("number", "integer")
]


@pytest.mark.parametrize(("key", "about"), NUMBERS, ids=lambda one: one if isinstance(one, str) else "")
def test_numbers_are_finite_and_no_truth_values(key, about):
    """Infinity is allowed only where it is the default; NaN and true are never allowed."""
    pose = {f"pose.{name}": value for name, value in POSE.items()} if key.startswith("pose.") else {}
    for value in (True, math.nan, -math.inf, math.inf, "nan"):
        if str(value) == about.get("usual"):
            assert load_settings(flags={key: value}) == Settings()
            continue
        with pytest.raises(SettingsError, match=rf"^--{key.replace('_', '-')} must be a (whole )?number"):
            load_settings(flags=pose | {key: value})


def test_a_pose_is_read(toml):
    """Without the table there is no pose; that of the example file is valid once uncommented."""
    found = load_settings(toml("[pose]\nlon_deg = -3.25\nlat_deg = 57\nheading_deg = 350\ntilt_deg = 20\nrange_m = 40"))
    assert found.pose == RigPose(lon_deg=-3.25, lat_deg=57.0, heading_deg=350.0, tilt_deg=20.0, range_m=40.0)
    assert Settings().pose is None
    text = EXAMPLE.read_text(encoding="utf-8")
    lines = [line.removeprefix("# ") for line in text[text.index("# [pose]") :].splitlines()]
    table = tomllib.loads(
        "\n".join(line for line in lines if line.startswith("[") or (" = " in line and not line.startswith("range_m")))
    )
    found = parse_settings(table)
    assert found.pose.height_m == 493.0
    assert set(table["pose"]) | {"range_m"} == {item.name for item in fields(RigPose)}


def test_the_sun_of_a_simulation_stands_over_the_pose():
    """Without a pose it stands over the usual place."""
    posed = parse_settings({"pose": POSE}).simulated_rig.sky
    assert (posed.latitude_deg, posed.longitude_deg) == (POSE["lat_deg"], POSE["lon_deg"])
    assert Settings().simulated_rig.sky == Sky()


def test_a_rig_is_read_from_its_tables(toml):
    """Every table sets its part of the rig; without tables it is the rig at rest in calm, clear air."""
    assert Settings().simulated_rig == Rig()
    found = load_settings(
        toml(
            "tol = 0.5\n[optics]\nfocus_m = inf\nfwhm_nm = 4\n[mirror]\nnatural_hz = 30\n"
            "[detector]\ndead_fraction = 0.1\n"
            '[air]\ndistance_m = 30\nrelief = "step"\nnearest_m = 20\n[sky]\nstarted = 2026-06-01T12:00:00+02:00\n'
        )
    )
    rig = found.simulated_rig
    assert (rig.optics, rig.mirror.natural_hz) == (Optics(fwhm_nm=4), 30.0)
    assert rig.detector == Detector(dead_fraction=0.1)
    assert rig.air == Air(distance_m=30.0, relief="step", nearest_m=20.0)
    assert rig.sky.started == datetime(2026, 6, 1, 10, tzinfo=UTC)
    assert rig.camera == found.camera


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ("0.1", Tolerance()),
        (0, Tolerance(0.0)),
        ("0.5dn", Tolerance(0.5, "dn")),
        ("2 sigma", Tolerance(2.0)),
        ("inf", Tolerance(float("inf"))),
        ("1e-3dn", Tolerance(1e-3, "dn")),
    ],
)
def test_a_tolerance_has_a_unit(given, wanted):
    """The unit is sigmas of the noise, or DN; the text of a tolerance parses to the same value."""
    found = parse_settings({"tol": given}).tol
    assert found == wanted
    assert parse_settings({"tol": str(found)}).tol == wanted


def test_an_unreadable_file_is_refused(toml, tmp_path):
    """A missing file, a folder and broken TOML are settings errors with the path."""
    with pytest.raises(SettingsError, match=r"no settings file .*nowhere\.toml"):
        load_settings(tmp_path / "nowhere.toml")
    with pytest.raises(SettingsError, match="cannot read the settings file"):
        load_settings(tmp_path)
    with pytest.raises(SettingsError, match=r"cannot read the settings file .*line 1.*expected TOML"):
        load_settings(toml("budget 0.5"))


@given(
    budget=st.floats(0, 1, exclude_min=True),
    seed=st.integers(0, 2**63 - 1),
    bands=st.none() | st.sets(st.integers(0, 900), min_size=1),
    memory=st.integers(2**28, 2**40),
    exposure=st.floats(0.5, 10_000),
    slew=st.floats(0, 10),
    posed=st.booleans(),
    tolerance=st.builds(Tolerance, st.floats(0), st.sampled_from(["sigma", "dn"])),
)
def test_receipt_settings_read_back_the_same(budget, seed, bands, memory, exposure, slew, posed, tolerance):
    """`parse_settings` inverts `to_dict`, so that the settings of a receipt can be used again."""
    settings = Settings(
        budget=budget,
        seed=seed,
        bands=None if bands is None else tuple(bands),
        memory=memory,
        camera=LineCamera(exposure_ms=exposure),
        cost=CostModel(slew_s=slew),
        pose=RigPose(**POSE) if posed else None,
        pointing_px=slew,
        tol=tolerance,
        sky=Sky(started=datetime(2026, 6, 1, 10, tzinfo=UTC) if posed else None, cloud_fraction=budget),
        air=Air(distance_m=exposure if posed else None),
        detector=Detector(hot_fraction=budget / 2),
    )
    assert parse_settings(settings.to_dict()) == settings
    assert parse_settings(json.loads(to_json(settings.to_dict()))) == settings


@pytest.mark.parametrize(
    ("more", "extent"),
    [
        ({}, "part"),
        ({"extent": "whole"}, "whole"),
        ({"macs": "40%"}, "whole"),
        ({"zoom": "always"}, "whole"),
        ({"prior": "none"}, "whole"),
        ({"prior": "auto"}, "whole"),  # the default
    ],
)
def test_a_prior_map_and_seconds_select_a_partial_scan(more: dict[str, str], extent: str) -> None:
    """Without prior map, or with another choice of lines, the whole field is captured."""
    assert load_settings(None, {"scene": "farm", "seconds": "8", "prior": "latest", **more}).extent == extent


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.dates()
    | st.datetimes()
    | st.sampled_from(["auto", "farm", "field", "a.png", "50%", "1,2", "0:1-2", "inf", "1e400", "~nobody", "\0"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=4,
)


@given(st.dictionaries(st.sampled_from(KEYS), VALUES, min_size=1, max_size=4), st.booleans())
def test_any_values_give_settings_or_one_sentence(values, stored):
    """Values of any type are read back from the receipt as they are, or refused in one line that names a setting."""
    try:
        settings = parse_settings(nested(values)) if stored else load_settings(flags=values)
    except (SettingsError, BudgetError) as error:
        sentence = str(error)
    else:
        sentence = ""
        assert parse_settings(settings.to_dict()) == settings
    assert "\n" not in sentence


@pytest.mark.parametrize(
    "asked",
    [
        {"scene": "x.tif", "source": "sim", "scan_step": 2},
        {"prior": "latest", "seconds": 5, "extent": "whole"},
        {"rig.mirror_axes": "-x,-y", "rig.white_at_rest": False, "source": "rig", "scene": "field"},
        {"scene": "-x.tif", "accuracy": False, "bands": "0-2", "size": None},
        {
            "policy": "sobel",
            "pose.lon_deg": -3,
            **{f"pose.{key}": one for key, one in POSE.items() if key != "lon_deg"},
        },
        {"size": "64x32", "tol": "0.5dn", "wavelengths": "660.5", "bands": "3", "visit": "first of June"},
    ],
)
def test_settings_are_stated_on_a_command_line_and_to_a_server(asked, monkeypatch, tmp_path):
    """The command of a receipt and the parameters of a run give the same settings again."""
    monkeypatch.chdir(tmp_path)
    settings = load_settings(flags=asked)
    words = shlex.split(command(json.loads(to_json(settings.to_dict())), "archive"))[1:]
    _, bound, _ = build_app(listed=False).parse_args(words, exit_on_error=False, print_error=False)
    assert load_settings(flags=by_setting(bound.arguments["flags"])) == settings
    again = Settings(**json.loads(settings.model_dump_json()))
    paths = {name: str(tmp_path / getattr(settings, name)) for name in ("out", "scene") if name in settings.to_dict()}
    assert again == settings.but(out=paths["out"], scene=again.scene)


def test_parameters_win_over_their_file_unless_they_are_null(toml):
    """An error names the file only for what the file has; emptied fields of a form do not count."""
    file = str(toml("seconds = 30\n[camera]\nexposure_ms = 50\n"))
    found = Settings(settings_file=file, seconds=None, camera={"exposure_ms": None, "samples": 320})
    assert (found.seconds, found.camera.exposure_ms, found.camera.samples) == (30, 50, 320)
    assert Settings(settings_file="", seconds=4).seconds == 4
    with pytest.raises(ValidationError, match=r"'seconds' must be a number .* got 'abc'"):
        Settings(settings_file=file, seconds="abc")
    with pytest.raises(ValidationError, match="settings_file must be the path of a TOML file, got 5"):
        Settings(settings_file=5)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"policy": "mask", "mask": "m.png", "scan_step": 2}, "--scan-step asks for one uniform scan .* --policy is"),
        ({"seconds": 9, "scan_exposure_ms": 25}, "--seconds leaves the choice of the scan .* --scan-exposure-ms makes"),
        ({"scan_exposure_ms": 25}, "--scan-exposure-ms is for lines that you choose: give --scan-step too"),
        ({"scene": "a.png", "scan_exposure_ms": 25}, "--scan-exposure-ms is of a camera"),
        ({"camera": Optics()}, r"\[camera\]: must be a table"),
        ({"": 5}, "unknown setting --"),
    ],
)
def test_contradictions_name_what_was_stated(flags, words):
    """And not what follows from it."""
    with pytest.raises(SettingsError, match=words):
        load_settings(flags=flags)

"""Cubes, white and dark frames of different exposures, gains and binnings give the true reflectance, or are refused."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.exposures import Taken, taken_with
from spectralzoom.pipeline.signal.calibrate import calibrate
from spectralzoom.storage.readers.envi_files import load_envi_header
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.recordings import Recording, open_recording
from spectralzoom.storage.readers.scene_files import load_scene_file
from tests.storage.readers.test_envi_cubes import write_envi

LINES, SAMPLES, BANDS, BIAS = 12, 8, 3, 60
TRUTH = np.random.default_rng(0).uniform(0.05, 0.6, (LINES, SAMPLES, BANDS))
LIGHT = 150.0  # DN of white in a millisecond
NM = {"wavelength_units": "nm", "wavelength": "{500, 600, 700}"}
Header = Mapping[str, object]
MS = "exposure (ms)"
write: Any = write_envi


def numbers(values: NDArray[np.floating], ms: float | NDArray[np.floating], gain: float = 1) -> NDArray[np.uint16]:
    """Return what a camera without dark current gives."""
    return np.rint(BIAS + gain * LIGHT * values * np.reshape(ms, (-1, 1, 1))).astype(np.uint16)


def write_taken(
    folder: Path, cube: tuple[float, Header], white: tuple[float, Header], dark: Header | None = None, gain: float = 1
) -> Path:
    """Write a cube and frames of these exposures [ms] and headers; ``gain`` is that of the white frame."""
    folder.mkdir(exist_ok=True)
    frame = np.ones((1, SAMPLES, BANDS))
    write(folder / "scan.img", numbers(TRUTH, cube[0]), **NM, **dict(cube[1]))
    write(folder / "scan.white.img", numbers(frame, white[0], gain), **dict(white[1]))
    write(folder / "scan.dark.img", numbers(frame, 0), **dict(dark or {}))
    return folder


def assert_true(recording: Recording, truth: Sequence[NDArray[np.floating]] = (TRUTH,)) -> None:
    """Check the calibrated lines of each sweep against the reflectance."""
    for sweep, expected in zip(recording.sweeps, truth, strict=True):
        raw = sweep.read_lines(np.arange(len(expected)))
        values, valid = calibrate(
            raw, sweep.references, saturated_dn=recording.camera.full_scale_dn, exposure_ms=sweep.exposure_ms
        )
        assert valid.all()
        np.testing.assert_allclose(values, expected, atol=2e-3)


@pytest.mark.parametrize(
    ("cube", "white"),
    [
        ({MS: 10}, {MS: 5}),
        ({";Exposure (ms)": 10}, {";Exposure (ms)": 5}),
        ({"tint": "10.000000"}, {"tint": "5.000000"}),
        ({"tint1": 10, "tint2": 4}, {"tint1": 5, "tint2": 2}),
        ({"shutter": 10}, {"shutter": 5}),
        ({"integration times": "10 ms"}, {"integration time": "5000 us"}),
        ({"exposure time, us": 10_000}, {"exposure_time": "0.005 s"}),
        ({"IntegrationTime": 10_000}, {"IntegrationTime": 5000}),
        ({"description": "{\n Exposure time [µs] = 10000\n}"}, {"camera_exposure_ms": "5,0"}),
        ({"exposure ms": 10, "integration time (s)": 0.01}, {"t_int (milliseconds)": 5}),
        ({"description": "{Camera, Integration time = 10 ms}"}, {"description": "{Exposure: 5,0 ms, Gain: high}"}),
        ({"shutter speed": "1/100 s"}, {"shutter speed": "1/200"}),
        ({MS: 10}, {"exposure": 5000, "exposure units": "us"}),
        ({"integration_time": 0.01, "integration_time_unit": "s"}, {"exposure time": 5, "units of exposure": "[ms]"}),
        ({"tint": 10_000, "tint units": "microseconds"}, {"tint": 5}),
        ({"Camera.Exposure": 10, "camera exposure unit": "ms"}, {"exposure_time": 0.005, "exposure unit": "sec"}),
    ],
)
def test_values_are_scaled_by_the_stated_exposures(tmp_path: Path, cube: Header, white: Header) -> None:
    """Names and units of several makes give the same ratio, and a note states it."""
    recording = open_recording(write_taken(tmp_path / "a", (10, cube), (5, white), white))
    assert_true(recording)
    (note,) = [note for note in recording.notes if "values are scaled by the ratio" in note]
    assert note.startswith("the white frame scan.white.hdr was taken with ")
    assert "(no unit)" in note or re.search("with 5 ms.*, the lines with 10 ms", note)


@pytest.mark.parametrize(
    ("cube", "white", "gain"),
    [
        ({"gain": "3 dB"}, {"gain": "0 dB"}, 10 ** (-3 / 20)),
        ({"gain (x)": 1}, {"gain": "2x"}, 2),
        ({"analog gain": 13.9, "digital gain": 0}, {"analog gain": 13.9, "digital gain": 0}, 1),
        ({"gain": "high"}, {"gain": "high"}, 1),
        ({"gain": 3, "gain units": "dB"}, {"analog gain": 1, "gain": 0, "gain unit": "dB"}, 10 ** (-3 / 20)),
    ],
)
def test_values_are_scaled_by_the_stated_gains(tmp_path: Path, cube: Header, white: Header, gain: float) -> None:
    """Gains are in dB or factors; equal ones need no unit."""
    files = write_taken(tmp_path / "a", (10, {MS: 10, **cube}), (8, {MS: 8, **white}), {MS: 10}, gain)
    assert_true(open_recording(files))


def test_each_cube_and_each_line_has_its_own_ratio(tmp_path: Path) -> None:
    """Cubes of 10 and 20 ms, and lines of 5 to 20 ms by a pointing table, are below one white frame of 8 ms."""
    frame = np.ones((1, SAMPLES, BANDS))
    lines_ms = np.linspace(5, 20, LINES)
    for name, ms in (("a", 10.0), ("b", 20.0), ("c", lines_ms)):
        write(tmp_path / f"{name}.img", numbers(TRUTH, ms), **NM, **({MS: ms} if name != "c" else {MS: 7}))
        every = np.broadcast_to(ms, LINES).tolist()
        rows = [f"0,{line / 100},{one!r}" for line, one in enumerate(every)]
        head = "angle_x_deg,angle_y_deg,exposure_ms"
        (tmp_path / f"{name}.pointing.csv").write_text("\n".join([head, *rows]))
    write(tmp_path / "white.img", numbers(frame, 8.0), **{MS: 8})
    write(tmp_path / "dark.img", numbers(frame, 0.0), **{MS: 8})
    recording = open_recording(tmp_path)
    assert_true(recording, [TRUTH] * 3)
    assert recording.sweeps[0].references.same_as(recording.sweeps[1].references)  # they serve one request together
    assert "c: the exposures of c.pointing.csv, 5 to 20 ms, count; the files state 7 ms" in recording.notes
    for header in tmp_path.glob("[wd]*.hdr"):
        header.write_text(header.read_text().replace("exposure (ms) = 8\n", ""))
    recording = open_recording(tmp_path)  # white is assumed to have one exposure, so that sweeps fit each other
    assert_true(recording, [TRUTH * 10 / 8] * 3)
    for path in tmp_path.glob("white.*"):
        path.unlink()
    recording = open_recording(tmp_path)  # relative values are relative to one exposure
    light = LIGHT * recording.camera.exposure_ms / (recording.camera.full_scale_dn - BIAS)
    assert_true(recording, [TRUTH * light] * 3)


def write_folder(folder: Path, white: Header, exposures: Sequence[float] = (10, 10)) -> Path:
    """Write two parts of a Headwall camera's cube, and its references."""
    folder.mkdir()
    frame = np.ones((1, SAMPLES, BANDS))
    for start, ms in zip((0, 6), exposures, strict=True):
        write(folder / f"raw_{start}", numbers(TRUTH[start : start + 6], ms), **NM, **{";Exposure (ms)": ms})
    write(folder / "whiteReference", numbers(frame, 5), **dict(white))
    write(folder / "darkReference", numbers(frame, 0), **{";Exposure (ms)": 10})
    return folder


@pytest.mark.parametrize("exposures", [(10, 10), (10, 20), (5, 5)])
def test_a_camera_folder_is_scaled_as_a_scene_and_as_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exposures: Sequence[float]
) -> None:
    """The white frame has 5 ms; the parts have one exposure, or each its own."""
    monkeypatch.chdir(write_folder(tmp_path / "a", {";Exposure (ms)": 5}, exposures))
    folder = Path()
    scene = load_scene_file(folder)
    np.testing.assert_allclose(scene.values, TRUTH, atol=2e-3)
    recording = open_recording(folder)
    assert_true(recording)
    for notes in (scene.provenance, recording.notes):
        assert any("values are scaled by the ratio" in note for note in notes) == (exposures != (5, 5))


def test_numbers_without_frames_are_not_scaled(tmp_path: Path) -> None:
    """Notes say so where the parts of a folder have different exposures, and which frame is not used."""
    folder = write_folder(tmp_path / "a", {}, (10, 20))
    for path in folder.glob("whiteReference*"):
        path.unlink()
    dark = "dark frame from darkReference.hdr is not used: values over white need a dark and a white frame"
    assert open_cube_source(folder).notes == (dark, "numbers of 10 to 20 ms are not scaled to one exposure")


@pytest.mark.parametrize(
    ("white", "note"),
    [
        ({}, "white.hdr was taken with an exposure that is not stated, the lines with 10 ms: the same exposure is"),
        ({MS: -10}, "the white frame scan.white.hdr: exposure (ms) = -10 is no exposure that can be read, and is left"),
        ({MS: "nan"}, "exposure (ms) = nan is no exposure that can be read"),
        ({MS: 0}, "exposure (ms) = 0 is no exposure that can be read"),
        ({"exposure (frames)": 3}, "exposure (frames) = 3 is no exposure that can be read"),
        ({"exposure (ms)": "5 us"}, "exposure (ms) = 5 us is no exposure that can be read"),
        ({"tint": "{5, 8}"}, "tint = 5, 8 is no exposure that can be read"),
        ({"integration time": 10}, "with integration time = 10 (no unit), the lines with 10 ms: the same exposure is"),
        (
            {"gain": "2 x", "binning": 2},
            "scan.white.hdr states gain = 2 x, binning = 2, scan.hdr does not: the same is",
        ),
        ({"shutter": "open"}, "an exposure that is not stated"),
    ],
)
def test_an_exposure_that_is_not_stated_is_assumed(tmp_path: Path, white: Header, note: str) -> None:
    """It is that of the lines, with a note."""
    recording = open_recording(write_taken(tmp_path / "a", (10, {MS: 10}), (10, white), {MS: 10}))
    assert_true(recording)
    assert any(note in one for one in recording.notes), recording.notes


def test_a_frame_without_a_header_has_the_exposure_of_the_lines(tmp_path: Path) -> None:
    """A ``.npy`` states nothing, which a note says; so does a cube that states nothing below a frame that does."""
    write_taken(tmp_path, (10, {MS: 10}), (10, {MS: 10}), {MS: 10})
    np.save(tmp_path / "w.npy", numbers(np.ones((1, SAMPLES, BANDS)), 10)[0])
    recording = open_recording(tmp_path, white=tmp_path / "w.npy")
    assert_true(recording)
    expected = "the white frame w.npy was taken with an exposure that is not stated, the lines with 10 ms: the same"
    assert any(note.startswith(expected) for note in recording.notes)
    recording = open_recording(write_taken(tmp_path, (10, {}), (10, {MS: 10}), {MS: 10}))
    assert_true(recording)
    assert any("with 10 ms, the lines with an exposure that is not stated" in note for note in recording.notes)


REFUSED: dict[str, tuple[Header, Header, str]] = {
    "two keys": ({MS: 10, "tint": 5}, {MS: 5}, "scan.hdr states exposure (ms) of 10 ms and tint of 5 ms; correct"),
    "key and comment": ({MS: 10, ";Exposure (ms)": 5}, {}, "states exposure (ms) of 10 ms and exposure (ms) of 5 ms"),
    "gain without a unit": ({"gain": 1}, {"gain": 2}, "with gain = 2 (no unit), scan.hdr with 1 (no unit)"),
    "gain of two units": ({"gain": "1 dB"}, {"gain": "2 x"}, "with gain = 2 x, scan.hdr with 1 dB; give a frame"),
    "gain in words": ({"gain": "low"}, {"gain": "high"}, "was taken with gain = high, scan.hdr with low; give a frame"),
    "binning": ({"binning": "{2, 2}"}, {"binning": "{1, 1}"}, "with binning = 1, 1, scan.hdr with 2, 2; give a frame"),
    "spectral binning": ({";Spectral binning": 2}, {";Spectral binning": 1}, "with spectral binning = 1, scan.hdr"),
    "gain twice": (
        {"gain": "1 x", ";gain": "2 x"},
        {},
        "scan.hdr states gain of (1.0, 'x') and of (2.0, 'x'); correct",
    ),
    "gain mode": ({"gain mode": "mode 1"}, {"gain_mode": "mode 2"}, "with gain mode = mode 2, scan.hdr with mode 1"),
    "gain in words and numbers": ({"gain": "low"}, {"gain": "2 x"}, "with gain = 2 x, scan.hdr with low; give"),
    "ISO": ({"ISO": 100}, {"iso": 200}, "was taken with iso = 200, scan.hdr with 100; give a frame"),
    "binning of several words": (
        {"binning factor spectral": 2},
        {"binning factor spectral": 1},
        "binning factor spectral = 1, scan.hdr with 2",
    ),
    "exposures in a list": ({MS: "{10, 20}"}, {MS: "{5, 10}"}, "with exposure (ms) = 5, 10, scan.hdr with 10, 20"),
    "speed without a unit": ({"shutter speed": 100}, {"shutter speed": 200}, "shutter speed = 200, scan.hdr with 100"),
    "one unit": ({"exposure": 10}, {"exposure": "5 ms"}, "with exposure = 5 ms, scan.hdr with 10 (no unit); give a"),
    "area": ({";AOI left": 0}, {";AOI left": 480}, "with aoi left = 480, scan.hdr with 0; give a frame taken"),
    "raw gain": ({"raw gain": 120}, {"raw_gain": 240}, "with raw gain = 240, scan.hdr with 120; give a frame taken"),
    "hardware binning": ({"HW_Bin": "2x2"}, {"hw bin": "1x1"}, "with hw bin = 1, 1, scan.hdr with 2, 2; give a frame"),
    "accumulations": ({"accumulations": 4}, {"accumulations": 1}, "with accumulations = 1, scan.hdr with 4; give"),
    "columns": ({"himg": "{1, 8}"}, {"himg": "{9, 16}"}, "with himg = 9, 16, scan.hdr with 1, 8; give a frame"),
    "unit of its own": (
        {"exposure": 10, "exposure units": "ticks"},
        {"exposure": 5, "exposure units": "ticks"},
        "ticks",
    ),
    "a thousand times": ({MS: 10}, {MS: 5000}, "they differ more than 100 times; correct the number or its unit"),
    "a thousand times without a unit": ({"exposure": 10}, {"exposure": 8000}, "they differ more than 100 times"),
    "detectors": (
        {"tint1": 10, "tint2": 4},
        {"tint1": 5, "tint2": 4},
        "with exposures = 5 and 4 ms, scan.hdr with 10 and 4 ms; give",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_contradictions_are_refused_by_name(tmp_path: Path, case: str) -> None:
    """The message names both files, the key and both values."""
    cube, white, message = REFUSED[case]
    with pytest.raises(SceneError) as caught:
        open_recording(write_taken(tmp_path / "a", (10, cube), (10, white)))
    assert message in str(caught.value)


def test_a_cube_without_an_exposure_has_that_of_the_others(tmp_path: Path) -> None:
    """They are of one camera; a note says so."""
    for name, header in (("a", {MS: 10}), ("b", {})):
        write(tmp_path / f"{name}.img", numbers(TRUTH, 10), **NM, **header)
        rows = [f"0,{line / 100}" for line in range(LINES)]
        (tmp_path / f"{name}.pointing.csv").write_text("\n".join(["angle_x_deg,angle_y_deg", *rows]))
    write(tmp_path / "white.img", numbers(np.ones((1, SAMPLES, BANDS)), 5), **{MS: 5})
    write(tmp_path / "dark.img", numbers(np.ones((1, SAMPLES, BANDS)), 0))
    recording = open_recording(tmp_path)
    assert_true(recording, [TRUTH] * 2)
    assert "b: nothing says the exposure: 10 ms is assumed" in recording.notes


def test_a_scene_without_frames_may_contradict_itself(tmp_path: Path) -> None:
    """Its values do not depend on exposures."""
    write(tmp_path / "a.img", TRUTH.astype("<f4"), **NM, **{MS: 10, "tint": 5})
    np.testing.assert_array_equal(load_scene_file(tmp_path / "a.hdr").values, TRUTH.astype(np.float32))


def test_attributes_of_arrays_state_exposures(tmp_path: Path) -> None:
    """A Zarr cube of 10 ms is below a white frame of 5 ms."""
    group = zarr.create_group(tmp_path / "scan.zarr", attributes={"integration_time": "10 ms"})
    group.create_array("counts", data=numbers(TRUTH, 10), dimension_names=("y", "x", "band"))
    group.create_array("wavelength", data=np.array([500.0, 600, 700]), attributes={"units": "nm"})
    for name, ms in (("white", 5), ("dark", 0)):
        write(tmp_path / f"scan.{name}.img", numbers(np.ones((1, SAMPLES, BANDS)), ms), **{MS: 5})
    assert_true(open_recording(tmp_path / "scan.zarr"))


def test_parts_of_another_gain_are_refused(tmp_path: Path) -> None:
    """They are one cube, which has one gain."""
    folder = write_folder(tmp_path / "a", {})
    header = folder / "raw_6.hdr"
    header.write_text(header.read_text() + ";analog gain = 2 x\n")
    first = folder / "raw_0.hdr"
    first.write_text(first.read_text() + ";analog gain = 1 x\n")
    with pytest.raises(SceneError, match=r"raw_6\.hdr was taken with analog gain = \(2\.0, 'x'\), raw_0\.hdr with"):
        open_cube_source(folder)


def test_a_dark_frame_of_another_exposure_is_used_or_refused(tmp_path: Path) -> None:
    """It is not scaled, as its bias is not known: a note bounds the error, which may be at most 5 % of white."""
    recording = open_recording(write_taken(tmp_path / "a", (10, {MS: 10}), (10, {MS: 10}), {MS: 5}))
    assert_true(recording)
    expected = "it is used as it is, since its bias does not depend on the exposure; values may be off by up to 0.04"
    assert any(expected in note for note in recording.notes), recording.notes
    with pytest.raises(SceneError, match=r"dark frame scan\.dark\.hdr was taken with 1 ms, .* up to 0\.36 of white"):
        open_recording(write_taken(tmp_path / "a", (10, {MS: 10}), (10, {MS: 10}), {MS: 1}))
    recording = open_recording(write_taken(tmp_path / "a", (10, {MS: 10}), (4, {MS: 4}), {MS: 10}))
    assert any("and the white frame scan.white.hdr with 4 ms: it is used as it is" in note for note in recording.notes)


def test_an_overexposed_white_frame_is_still_named(tmp_path: Path) -> None:
    """Saturation is judged by the numbers as they are, not by scaled ones."""
    folder = write_taken(tmp_path / "a", (5, {MS: 5}), (20, {MS: 20}), {MS: 5})
    values = np.minimum(numbers(np.ones((1, SAMPLES, BANDS)) * 2, 20), 4095)
    write(folder / "scan.white.img", values, **{MS: 20})
    assert any("at full scale (4095 DN) in 100 % of the elements" in note for note in open_recording(folder).notes)


def test_real_headers_are_read(real_data: Path) -> None:
    """Headers of two makes state exposures, gains, binning and areas."""

    def taken(name: str) -> Taken:
        header = load_envi_header(real_data / "envi_headers" / name)
        return taken_with(name, header.fields, header.settings)

    fenix = taken("specim_fenix_cal__Radiometric_8x2_1x1.hdr")
    assert fenix.exposures == {"1": 28.0, "2": 7.9992}
    assert {key: fenix.frame[key] for key in ("binning", "binning2", "vimg1")} == {
        "binning": "8, 2",
        "binning2": "1, 1",
        "vimg1": "1, 87",
    }
    assert set(fenix.others) >= {"trigger mode1", "sensorid", "pixelmatching left"}
    assert not [key for key in fenix.others if re.search("path|date|sensor type|interleave|samples", key)]
    headwall = taken("headwall_mvx__darkReference.hdr")
    assert headwall.exposures == {"": 100.0033437}
    assert headwall.gains == {"analog gain": (13.8999996, ""), "digital gain": (0.0, "")}


@pytest.mark.parametrize(
    ("key", "of_cube", "of_white"),
    [
        ("trigger mode", "Internal", "External"),
        ("HDR", "on", "off"),
        ("frame averaging", 4, 1),
        ("nd filter", 0.3, 0.6),
        ("Serial Number", "G4-426", "G4-427"),
        ("bit depth", 12, 16),
        ("sensor exposure register", 120, 240),
        ("lens", "8 mm", "23 mm"),
        ("readout speed", "fast", "slow"),
        ("sensorid", 3500015, 3500016),
        ("filter position", 2, 3),
        ("lamp current", "2.1 A", "1.9 A"),
        ("line rate", 100, 50),
        ("swir temperature", 147, 168),
        ("calibration state", "factory", "field"),
    ],
)
def test_an_unknown_setting_that_differs_is_named(tmp_path: Path, key: str, of_cube: object, of_white: object) -> None:
    """A note has its key and both values; the same value, or a header without the key, has no note."""
    for white, count in ((of_white, 1), (of_cube, 0), (None, 0)):
        folder = write_taken(tmp_path / f"{white}", (10, {MS: 10, key: of_cube}), (10, {MS: 10, key: white}), {MS: 10})
        notes = [note for note in open_recording(folder).notes if "differ in" in note]
        assert len(notes) == count
        assert all(f"{key.lower()} " in note and "scan.white.hdr" in note for note in notes)


ORDINARY = {  # keys of ordinary headers, by format or value no settings: values of a cube and of its frames
    "acquisition date": ("2024-05-01", "2024-05-02"),
    "start time": ("UTC TIME: 15:41:28", "UTC TIME: 15:40:00"),
    "description": ("{field 3}", "{File [Imported into ENVI]}"),
    "file name": ("scan_1.raw", "white_1.raw"),
    "calibration pack": ("C:/a.scp", "C:/b.scp"),
    "y start": (100, 0),
    "default bands": ("{3, 2, 1}", "{1, 2, 3}"),
    "sensor type": ("FX10", "Unknown"),
    "exposure units": ("ms", "milliseconds"),
}


def test_ordinary_headers_are_not_noted(tmp_path: Path) -> None:
    """Layout, dates, texts and paths may differ; so may the light of a dark frame."""
    cube, frame = ({key: values[place] for key, values in ORDINARY.items()} for place in (0, 1))
    dark = {**frame, "lamp": "off", "shutter": "closed", "shutter state": "closed", MS: 10}
    lit = {"lamp": "on", "shutter": "open", "shutter state": "open", MS: 10}
    recording = open_recording(write_taken(tmp_path / "a", (10, {**cube, **lit}), (10, {**frame, **lit}), dark))
    assert_true(recording)
    assert not [note for note in recording.notes if re.search("differ in|does not|scaled", note)]


def test_parts_with_their_bands_in_another_order_are_refused(tmp_path: Path) -> None:
    """Bands of one cube have one order."""
    folder = write_folder(tmp_path / "a", {})
    header = folder / "raw_6.hdr"
    header.write_text(header.read_text().replace("{500, 600, 700}", "{700, 600, 500}"))
    with pytest.raises(SceneError, match=r"raw_6\.hdr has the bands of raw_0\.hdr in another order; name these parts"):
        open_cube_source(folder)


LEVELS = np.array([1.0, 2.0, 3.0, 4.0, 5.0])  # of white, by band
FRAMES: dict[str, tuple[list[int], list[float], str]] = {  # bands of the frames, their wavelengths, and a note
    "same": ([0, 1, 2], [500, 600, 700], ""),
    "rounded": ([0, 1, 2], [500.4, 599.8, 700.02], ""),
    "reversed": (
        [2, 1, 0],
        [700, 600, 500],
        "has 3 bands from 700 to 500 nm, the cube 3 bands from 500 to 700 nm: its",
    ),
    "shuffled": ([1, 2, 0], [600, 700, 500], "its bands are read in the order of the cube's wavelengths"),
    "window of a larger frame": (
        [3, 0, 1, 2, 4],
        [400, 500, 600, 700, 800],
        "has 5 bands from 400 to 800 nm, the cube",
    ),
    "larger and reversed": ([4, 2, 1, 0, 3], [800, 700, 600, 500, 400], "its bands are read in the order"),
    "another calibration": (
        [0, 1, 2],
        [515, 615, 715],
        "has wavelengths up to 15 nm off those of the cube: the nearest",
    ),
}


@pytest.mark.parametrize("case", FRAMES)
@pytest.mark.parametrize("unit", ["nm", "Micrometers"])
def test_bands_of_frames_are_those_of_the_cube(tmp_path: Path, case: str, unit: str) -> None:
    """Frames with the cube's bands in another order, or with more bands, are read by wavelength, with a note."""
    bands, nm, note = FRAMES[case]
    scale = 1 if unit == "nm" else 1e-3
    stated = {"wavelength units": unit, "wavelength": "{" + ", ".join(f"{scale * one:g}" for one in nm) + "}", MS: 10}
    raw = numbers(TRUTH * LEVELS[:3], 10)
    write(tmp_path / "scan.img", raw, **NM, **{MS: 10})
    white = np.broadcast_to(LEVELS[bands], (1, SAMPLES, len(bands)))
    listed = "{" + ", ".join(f"{1 + band}" for band in bands) + "}"
    write(tmp_path / "scan.white.img", numbers(white, 10), **stated, white_reference=listed)
    header = tmp_path / "scan.white.hdr"
    header.write_text(header.read_text().replace("white reference", "white_reference"))
    write(tmp_path / "scan.dark.img", numbers(white, 0), **stated)
    recording = open_recording(tmp_path)
    assert_true(recording, [TRUTH * np.array([1, 2, 3])])
    notes = [one for one in recording.notes if "bands" in one]
    assert (len(notes) == 2 and all(note in one for one in notes)) if note else not notes


@pytest.mark.parametrize(
    ("wavelengths", "more", "message"),
    [
        ([600, 700, 800], {}, "has 3 bands from 600 to 800 nm, the cube 3 bands from 500 to 700 nm; give a frame with"),
        ([500, 600], {}, "has 2 bands from 500 to 600 nm, the cube 3 bands"),
        ([550, 555, 560, 565], {}, "has 4 bands from 550 to 565 nm"),
        ([500, 600, 700], {"fwhm": "{10, 10, 10}"}, "has bands 2 times as wide (fwhm) as the cube"),
    ],
)
@pytest.mark.parametrize("scene", [False, True])
def test_frames_of_other_bands_are_refused(
    tmp_path: Path, wavelengths: list[float], more: Header, message: str, scene: bool
) -> None:
    """The message has the bands of both, for a recording and for a folder as a scene."""
    stated = {"wavelength units": "nm", "wavelength": "{" + ", ".join(map(str, wavelengths)) + "}", **more}
    names = ("raw_0", "whiteReference", "darkReference") if scene else ("scan.img", "scan.white.img", "scan.dark.img")
    write(tmp_path / names[0], numbers(TRUTH, 10), **NM, fwhm="{5, 5, 5}")
    frame = np.ones((1, SAMPLES, len(wavelengths)))
    for name, ms in zip(names[1:], (10, 0), strict=True):
        write(tmp_path / name, numbers(frame, ms), **stated)
    with pytest.raises(SceneError, match=re.escape(message)):
        (open_cube_source if scene else open_recording)(tmp_path)


def test_a_scene_folder_names_saturated_and_exchanged_frames(tmp_path: Path) -> None:
    """The same check as that of recordings."""
    folder = write_folder(tmp_path / "a", {";Exposure (ms)": 10})
    write(folder / "whiteReference", np.full((1, SAMPLES, BANDS), 4095, np.uint16), **{";Exposure (ms)": 10})
    assert any("white frame is at full scale (4095 DN)" in note for note in open_cube_source(folder).notes)
    write(folder / "whiteReference", numbers(np.ones((1, SAMPLES, BANDS)), 0), **{";Exposure (ms)": 10})
    write(folder / "darkReference", numbers(np.ones((1, SAMPLES, BANDS)), 10), **{";Exposure (ms)": 10})
    with pytest.raises(SceneError, match="the white frame is not brighter than the dark one"):
        open_cube_source(folder)


@pytest.mark.parametrize("lost", [1, 2])
def test_lines_of_a_scene_folder_below_dark_are_left_out(tmp_path: Path, lost: int) -> None:
    """A dropped frame of 0 has no value; more than a tenth of them are refused."""
    folder = write_folder(tmp_path / "a", {";Exposure (ms)": 5})
    raw = numbers(TRUTH[6:], 10)
    raw[2 : 2 + lost] = 0
    write(folder / "raw_6", raw, **NM, **{";Exposure (ms)": 10})
    if lost == 2:
        with pytest.raises(
            SceneError, match=r"2 of 12 lines cannot be used, .*: 2 darker than the dark frame \(the first"
        ):
            load_scene_file(folder)
        return
    scene = load_scene_file(folder)
    assert np.isnan(scene.values[8]).all()
    assert np.isfinite(np.delete(scene.values, 8, axis=0)).all()
    assert any(
        "1 of 12 lines are left out: 1 darker than the dark frame (the first is line 8)" in n for n in scene.provenance
    )


def test_settings_of_the_frames_alone_are_compared(tmp_path: Path) -> None:
    """A cube that states none says nothing on them."""
    white = {MS: 10, "accumulations": 4, "trigger mode": "external"}
    folder = write_taken(tmp_path / "a", (10, {MS: 10}), (10, white), {**white, "trigger mode": "internal"})
    notes = open_recording(folder).notes
    assert any("white frame scan.white.hdr differ in trigger mode internal and external" in note for note in notes)
    folder = write_taken(tmp_path / "b", (10, {MS: 10}), (10, white), {**white, "accumulations": 1})
    with pytest.raises(
        SceneError, match=r"scan\.white\.hdr was taken with accumulations = 4, the dark frame .* with 1"
    ):
        open_recording(folder)

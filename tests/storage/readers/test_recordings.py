"""Recordings from archives and files: what is read, found beside the cubes, assumed and refused."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray

from spectralzoom.pipeline.capture.straight_scans import covered_field
from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, SceneError, SettingsError, WavelengthError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import direction_to_scene, position_to_direction
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.storage.arrays.cubes import RawCube, RawCubeWriter, SweepHeader, open_raw_cube
from spectralzoom.storage.readers.recordings import _middle_s, open_recording
from spectralzoom.storage.store import Archive, stage_key
from tests.envi_files import write_recorded_files
from tests.pipeline.capture.recordings import CAMERA, FULL, simulated
from tests.storage.readers.test_envi_cubes import write_envi
from tests.storage.small_archive import flip, publish_receipt

COARSE = Sweep("coarse-0", "coarse", "x", 0.0, -39.5, 20, step=4)


def write_raw(folder: Path, source: SimulatedSource, sweep: Sweep) -> RawCube:
    """Write a sweep of the simulated rig as a raw cube whose fifth line is lost."""
    header = SweepHeader(sweep, source.references(sweep), source.wavelength_nm, np.full(3, 5.0), "sim")
    with RawCubeWriter(folder / f"{sweep.name}.zarr", header) as cube:
        cube.write([replace(line, valid=line.number != 4) for line in source.lines(sweep)])
    return open_raw_cube(folder / f"{sweep.name}.zarr")


def assert_is_recording_of(found: Any, cube: RawCube) -> None:
    """Check a recorded sweep's numbers, positions, times, exposures, flags and references against a raw cube."""
    assert replace(found.sweep, name=cube.sweep.name) == cube.sweep
    np.testing.assert_array_equal(found.read_lines(np.arange(cube.shape[0])), cube.read())
    for name in ("position", "time_s", "exposure_ms", "valid_line"):
        np.testing.assert_array_equal(getattr(found, name), getattr(cube, name))
    for name, value in asdict(cube.references).items():
        np.testing.assert_array_equal(getattr(found.references, name), value, err_msg=name)


def test_raw_cubes_written_as_files_round_trip(tmp_path: Path) -> None:
    """Numbers, pointing and references of two sweeps are read bit by bit from ENVI and CSV."""
    source = simulated()
    cubes = [write_raw(tmp_path / "raw", source, sweep) for sweep in (COARSE, FULL)]
    for cube in cubes:
        write_recorded_files(cube, tmp_path / "files")
    recording = open_recording(tmp_path / "files", CAMERA)
    assert [one.sweep.name for one in recording.sweeps] == ["coarse-0", "scan-0"]
    for found, cube in zip(recording.sweeps, cubes, strict=True):
        assert_is_recording_of(found, cube)
    np.testing.assert_array_equal(recording.wavelength_nm, source.wavelength_nm)
    np.testing.assert_array_equal(recording.fwhm_nm, np.full(3, 5.0))
    assert recording.camera == CAMERA


def test_recordings_open_from_folders_runs_and_archives(tmp_path: Path, archive: Archive) -> None:
    """A capture's folder, a single cube, a run, and an archive's newest run give raw cubes, also single lines."""
    source = simulated()
    runs, cubes = [], []
    for number, sweep in enumerate((FULL, COARSE)):
        build = partial(write_raw, source=source, sweep=sweep)
        ref, _ = archive.produce("capture", build, version=1, params={"n": number})
        runs.append(publish_receipt(archive, {"products": {"raw_coarse": ref.uri}}))
        cubes.append(open_raw_cube(ref.path / f"{sweep.name}.zarr"))
    full, coarse = cubes
    store = Path(str(full.group.store_path).removeprefix("file://")).parent
    places = ((store, full), (store / "scan-0.zarr", full), (runs[0], full), (runs[1], coarse), (archive.root, coarse))
    for address, cube in places:
        recording = open_recording(address, CAMERA)
        assert_is_recording_of(recording.sweeps[0], cube)
        assert recording.notes == ()
        numbers = np.array([0, 3, 17])
        np.testing.assert_array_equal(recording.sweeps[0].read_lines(numbers), cube.read()[numbers])
    longer = replace(CAMERA, exposure_ms=2 * CAMERA.exposure_ms)
    assert open_recording(store, longer).camera.exposure_ms == full.exposure_ms[0]  # plans use the recorded exposure
    with pytest.raises(SettingsError, match=r"--dark is for files, and .* holds raw cubes"):
        open_recording(store, CAMERA, dark=store)
    with pytest.raises(ArchiveError, match=f"has no run 'x'; its latest are {runs[0].name}, {runs[1].name}"):
        open_recording(archive.root / "runs" / "x", CAMERA)
    archive.clear(archive.ref("capture", store.name))
    with pytest.raises(IncompleteStoreError, match="were cleared away"):
        open_recording(runs[0], CAMERA)


def write_changed(folder: Path, changed: dict[int, dict[str, float]]) -> Path:
    """Write a raw cube of 80 lines, some of which have other facts."""
    source = simulated()
    header = SweepHeader(FULL, source.references(FULL), source.wavelength_nm, np.full(3, 5.0), "sim")
    with RawCubeWriter(folder / "scan-0.zarr", header) as cube:
        cube.write([replace(line, **changed.get(line.number, {})) for line in source.lines(FULL)])
    return folder / "scan-0.zarr"


@pytest.mark.parametrize(
    "fault", [{"exposure_ms": 0.0}, {"exposure_ms": np.nan}, {"exposure_ms": -5.0}, {"mirror_y": 1.5}]
)
def test_lines_of_a_raw_cube_that_cannot_be_are_left_out(tmp_path: Path, fault: dict[str, float]) -> None:
    """Up to a tenth of the lines, with a note; their exposures are the usual one."""
    recording = open_recording(write_changed(tmp_path / "a", {line: dict(fault) for line in (3, 70)}), CAMERA)
    (sweep,) = recording.sweeps
    assert np.flatnonzero(~sweep.valid_line).tolist() == [3, 70]
    assert (sweep.exposure_ms == CAMERA.exposure_ms).all()
    (note,) = recording.notes
    assert note.startswith("scan-0.zarr: 2 of 80 lines are left out: 2 ")
    assert "(the first is line 3)" in note
    with pytest.raises(SceneError, match="80 of 80 lines cannot be used, more than a tenth"):
        open_recording(write_changed(tmp_path / "b", {line: dict(fault) for line in range(80)}), CAMERA)


def test_lines_of_a_raw_cube_with_other_exposures_are_scaled(tmp_path: Path) -> None:
    """White without an exposure of its own has the usual one, and notes say so."""
    recording = open_recording(write_changed(tmp_path / "a", {7: {"exposure_ms": CAMERA.exposure_ms / 10}}), CAMERA)
    assert recording.sweeps[0].references.exposure_ms == CAMERA.exposure_ms
    assert recording.notes == (
        "scan-0.zarr: white is taken to have 100 ms",
        "scan-0.zarr: lines of 10 to 100 ms are scaled to the exposure of white",
    )


@pytest.mark.parametrize("copied", [False, True])
def test_a_lost_chunk_of_a_raw_cube_is_reported(tmp_path: Path, archive: Archive, copied: bool) -> None:
    """In a store and in a folder without a manifest, zarr would read zeros in its place."""
    build = partial(write_raw, source=simulated(), sweep=FULL)
    folder = archive.produce("capture", build, version=1, params={})[0].path
    if copied:
        folder = Path(shutil.copytree(folder, tmp_path / "copy", ignore=shutil.ignore_patterns("manifest.json")))
        (folder / "scan-0.zarr" / "dn" / "c" / "._0").write_text("of the system that copied it")
        assert open_recording(folder, CAMERA).sweeps
    parts = (folder / "scan-0.zarr" / "dn" / "c").rglob("*")
    next(path for path in parts if path.name.isdigit() and path.is_file()).unlink()
    with pytest.raises(IncompleteStoreError, match=r"dn lacks 1 of its chunks" if copied else "is missing"):
        open_recording(folder, CAMERA)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """Return a folder with one cube of 80 lines as ENVI, with pointing and reference frames."""
    write_recorded_files(write_raw(tmp_path / "raw", simulated(), FULL), tmp_path / "files")
    return tmp_path / "files"


def test_missing_reference_frames_are_assumed(files: Path) -> None:
    """The dark level is 0 and white is full scale; notes say so."""
    for kind in ("dark", "white", "bad"):
        (files / f"scan-0.{kind}.hdr").unlink()
    recording = open_recording(files, CAMERA)
    known = recording.sweeps[0].references
    levels = (known.dark.max(), known.white.min(), known.white.max(), known.white_reference.tolist())
    assert levels == (0, 4095, 4095, [1, 1, 1])
    assert any("has no dark frame: a dark level of 0 is assumed" in note for note in recording.notes)
    said = "full scale (4095 DN) is assumed to be white, and values are relative"
    assert any(said in note for note in recording.notes)


def test_a_cube_without_pointing_is_an_even_straight_scan(files: Path) -> None:
    """Lines are parallel, one pixel apart and centred; notes state what was assumed."""
    (files / "scan-0.pointing.csv").unlink()
    recording = open_recording(files, CAMERA)
    sweep = recording.sweeps[0]
    assert replace(sweep.sweep, name="") == Sweep("", "fine", "x", 0.0, -39.5, 80)
    seen = direction_to_scene(position_to_direction(sweep.position)) / recording.camera.ifov_rad
    np.testing.assert_allclose(seen, np.stack([np.zeros(80), np.arange(80) - 39.5], axis=-1), atol=1e-6)
    assert "scan-0 has no pointing: taken as an even straight scan along y with one pixel a line" in recording.notes
    assert any("nothing says when lines were taken: one every 100 ms is assumed" in note for note in recording.notes)
    assert covered_field([sweep.sweep], [sweep.tangents], recording.camera)[0] == (80, 64)


@pytest.mark.parametrize(
    ("column", "values", "distance"),
    [("position_px", np.arange(80) * 2.0 + 7, 2.0), ("position_m", np.arange(80) * -0.05, 1.0)],
)
def test_a_scan_without_a_mirror_uses_its_positions(
    files: Path, tmp_path: Path, column: str, values: NDArray[np.float64], distance: float
) -> None:
    """For a stage, conveyor or drone, pixels are used as given, and metres are divided by the lines' distance."""
    table = tmp_path / "stage.csv"
    table.write_text(column + "\n" + "".join(f"{value!r}\n" for value in values.tolist()))
    recording = open_recording(files, CAMERA, pointing=table)
    sweep = recording.sweeps[0]
    seen = direction_to_scene(position_to_direction(sweep.position)) / recording.camera.ifov_rad
    expected = (np.arange(80) - 39.5) * distance * (1 if values[1] > values[0] else -1)
    np.testing.assert_allclose(seen[:, 1], expected, atol=1e-6)
    assert sweep.sweep.step == max(round(distance), 1)
    said = any("a pixel is taken to be as long as lines are apart, 0.05 m" in note for note in recording.notes)
    assert said == (column == "position_m")


def test_a_table_cuts_one_cube_into_sweeps(files: Path, tmp_path: Path) -> None:
    """Forward and backward motion become two sweeps; lines of neither are left out."""
    cube = open_raw_cube(tmp_path / "raw" / "scan-0.zarr")
    rows = ["mirror_x,mirror_y,sweep"]
    for number in range(80):
        x, y = cube.position[number if number < 42 else 80 - number].tolist()
        rows.append(f"{x!r},{y!r},{'there' if number < 40 else '' if number < 42 else 'back'}")
    (tmp_path / "turns.csv").write_text("\n".join(rows))
    there, back = open_recording(files, CAMERA, pointing=tmp_path / "turns.csv").sweeps
    assert (there.sweep.name, there.sweep.lines, there.sweep.start_px) == ("there", 40, pytest.approx(-39.5, abs=1e-5))
    assert (back.sweep.name, back.sweep.lines, back.sweep.start_px) == ("back", 38, -38.5)
    np.testing.assert_array_equal(back.read_lines(np.arange(38)), cube.read(42, 80))


write_envi_cube = partial(write_envi, wavelength_units="nm", wavelength="{500, 600, 700}")


VALUES = np.random.default_rng(0).integers(100, 4000, (6, 16, 3)).astype("<u2")
SCALED = {"reflectance_scale_factor": 10_000}
NO_WAVELENGTHS = "has 3 bands and nothing says their wavelengths; give --wavelengths in nm"


@pytest.mark.parametrize(
    ("values", "fields", "error", "message"),
    [
        (VALUES, {"interleave": None}, SceneError, "no interleave, expected one of bil"),
        (VALUES, {"interleave": "bpl"}, SceneError, "interleave = 'bpl', expected one"),
        (VALUES, {"wavelength": None}, WavelengthError, NO_WAVELENGTHS),
        (VALUES.astype("<f4"), {}, SceneError, "holds float32, expected a camera's own numbers"),
        (VALUES, SCALED, SceneError, "holds float32 by the scale or offset in its header, expected a camera's own"),
        (VALUES.astype("<i2") - np.int16(2000), {}, SceneError, "expected a camera's own numbers from 0"),
    ],
)
def test_unusable_cubes_are_refused(
    tmp_path: Path, values: NDArray[Any], fields: dict[str, Any], error: type[Exception], message: str
) -> None:
    """Each fault of interleave, wavelengths and number type has its own message."""
    write_envi_cube(tmp_path / "cube", values, **fields)
    with pytest.raises(error) as caught:
        open_recording(tmp_path / "cube.hdr").sweeps[0].read_lines(np.arange(6))
    assert message in str(caught.value)


def test_several_cubes_need_pointing_and_the_same_bands(tmp_path: Path) -> None:
    """Without pointing the cubes' relative position is unknown; cubes of other bands are not one recording."""
    write_envi_cube(tmp_path / "a", VALUES)
    write_envi_cube(tmp_path / "b", VALUES)
    with pytest.raises(
        SceneError, match=r"a\.hdr has no pointing of a mirror, and how 2 cubes lie beside each other is not"
    ):
        open_recording(tmp_path)
    write_envi_cube(tmp_path / "b", VALUES, wavelength="{400, 500, 600}")
    with pytest.raises(SceneError, match=r"b\.hdr has other wavelengths than .*a\.hdr"):
        open_recording(tmp_path)
    write_envi_cube(tmp_path / "b", VALUES)
    for name in ("c.pointing.csv", "c.img"):
        (tmp_path / name).touch()
    with pytest.raises(SceneError, match=r"c\.img has no header c\.hdr; copy the header, or move c\.img elsewhere"):
        open_recording(tmp_path)
    (tmp_path / "c.img").unlink()  # a table alone may be another recording's
    (tmp_path / "tables").mkdir()
    with pytest.raises(SceneError, match=r"has no pointing for a; add a\.csv, or name one for all"):
        open_recording(tmp_path, pointing=tmp_path / "tables")


def test_missing_wavelengths_of_npy_suggest_the_option(tmp_path: Path) -> None:
    """An array in .npy has no header that could hold them."""
    np.save(tmp_path / "a.npy", VALUES)
    with pytest.raises(WavelengthError, match=r"give --wavelengths in nm$"):
        open_recording(tmp_path / "a.npy")


def test_cubes_of_two_formats_are_refused(tmp_path: Path) -> None:
    """Neither format is left out without an error."""
    write_envi_cube(tmp_path / "a", VALUES)
    zarr.create_array(tmp_path / "b.zarr", data=VALUES)
    with pytest.raises(SceneError, match=r"holds ENVI cubes and the Zarr store b\.zarr; name one, or move"):
        open_recording(tmp_path)


@pytest.mark.parametrize("version", [2, 3])
def test_a_zarr_cube_of_other_programs_is_a_recording(tmp_path: Path, version: Any) -> None:
    """An array with wavelengths is read line by line, in both format versions; missing chunks are noted."""
    group = zarr.create_group(tmp_path / "cube.zarr", zarr_format=version)
    group.create_array("counts", shape=VALUES.shape, dtype="uint16")[...] = VALUES
    group.create_array("wavelength", shape=(3,), dtype="float64", attributes={"units": "nm"})[...] = [500, 600, 700]
    recording = open_recording(tmp_path / "cube.zarr")
    assert recording.wavelength_nm.tolist() == [500, 600, 700]
    np.testing.assert_array_equal(recording.sweeps[0].read_lines(np.array([1, 4])), VALUES[[1, 4]])
    next(path for path in (tmp_path / "cube.zarr" / "counts").rglob("*0") if path.is_file()).unlink()
    assert "counts: 1 of 1 chunks have no file, and are read as 0" in open_recording(tmp_path / "cube.zarr").notes


def test_a_headwall_folder_is_a_recording(tmp_path: Path) -> None:
    """Parts are joined; timestamps, exposures and references of the folder are used."""
    for first, last in ((0, 4), (4, 6)):
        write_envi_cube(tmp_path / f"raw_{first}", VALUES[first:last], **{";Exposure (ms)": 4.0})
        rows = [f"{frame}\t{5000 + 10000 * frame}" for frame in range(first, last)]
        (tmp_path / f"frameIndex_{first}.txt").write_text("\n".join(["Frame#\tTimestamp", *rows]))
    write_envi_cube(tmp_path / "darkReference", np.full((2, 16, 3), 60, "<u2"))
    write_envi_cube(tmp_path / "whiteReference", np.full((2, 16, 3), 3000, "<u2"))
    recording = open_recording(tmp_path)
    (sweep,) = recording.sweeps
    np.testing.assert_array_equal(sweep.read_lines(np.arange(2, 6)), VALUES[2:])
    np.testing.assert_allclose(sweep.time_s, 0.002 + 0.01 * np.arange(6), atol=1e-12)
    assert (sweep.exposure_ms.tolist(), recording.camera.exposure_ms) == ([4.0] * 6, 4.0)
    assert recording.camera.frame_ms == pytest.approx(10.0)
    assert (sweep.references.dark.min(), sweep.references.white.max()) == (60, 3000)
    assert "frames are taken to be stamped as their exposure begins" in recording.notes
    for header in tmp_path.glob("raw_*.hdr"):
        header.write_text(header.read_text().replace(";Exposure (ms) = 4.0\n", ""))
    camera = open_recording(tmp_path).camera  # no exposure is longer than the period
    assert (camera.exposure_ms, camera.frame_ms) == pytest.approx((10.0, 10.0))
    (tmp_path / "raw_4.hdr").unlink()
    with pytest.raises(SceneError, match=r"raw_4.* has no header raw_4\.hdr; copy the header, or move"):
        open_recording(tmp_path)


def test_the_key_of_a_recording_depends_on_its_content(files: Path, tmp_path: Path) -> None:
    """The key is the same at another address; other numbers, bits, pointing or frames change it."""

    def key_of(path: Path, camera: LineCamera, **more: Path) -> str:
        return stage_key("capture", 1, open_recording(path, camera, **more).key)

    key = key_of(files, CAMERA)
    moved = files.rename(tmp_path / "moved")
    assert key_of(moved, CAMERA) == key_of(moved / "scan-0.hdr", CAMERA) == key
    np.save(tmp_path / "dark.npy", np.full((64, 3), 7.0))
    keys = [key, key_of(moved, CAMERA, dark=tmp_path / "dark.npy")]
    text = (moved / "scan-0.pointing.csv").read_text()
    (moved / "scan-0.pointing.csv").write_text(text.replace("0.05,", "0.06,", 1))
    keys.append(key_of(moved, CAMERA))
    (moved / "scan-0.pointing.csv").write_text(text)
    flip(moved / "scan-0.bil", 100)
    keys += [key_of(moved, camera) for camera in (CAMERA, replace(CAMERA, bits=14))]
    assert all(one != other for at, one in enumerate(keys) for other in keys[:at])
    stored = [key_of(path, CAMERA) for path in (tmp_path / "raw", tmp_path / "raw" / "scan-0.zarr")]
    assert stored[0] == stored[1]


def test_the_white_frame_gives_the_bit_depth(tmp_path: Path) -> None:
    """Lines over dark ground reach 2000 only; the white frame's 12000 needs 14 bits."""
    write_envi(tmp_path / "a.raw", np.full((40, 8, 2), 2000, np.uint16))
    np.save(tmp_path / "a.white.npy", np.full((8, 2), 12_000, np.float32))
    recording = open_recording(tmp_path / "a.hdr", wavelengths=(500.0, 600.0))
    assert recording.camera.bits == 14
    assert any("numbers reach 12000, so 14 bits" in note for note in recording.notes)


def test_cubes_of_bytes_are_of_8_bits(tmp_path: Path) -> None:
    """Full scale is 255, and a dark level of 12 bits is scaled to 8; with a 16-bit cube beside it, 12 bits stay."""
    write_envi_cube(tmp_path / "a", np.full((6, 16, 3), 200, "u1"))
    recording = open_recording(tmp_path / "a.hdr", LineCamera(dark_dn=819.0))
    assert (recording.camera.bits, recording.camera.dark_dn) == (8, 51.0)
    assert recording.sweeps[0].references.white.max() == 255
    assert "the files hold bytes, so 8 bits are taken for camera.bits" in recording.notes
    write_envi_cube(tmp_path / "b", VALUES)
    for name in "ab":
        rows = "".join(f"0,{line / 100}\n" for line in range(6))
        (tmp_path / f"{name}.pointing.csv").write_text("angle_x_deg,angle_y_deg\n" + rows)
    assert open_recording(tmp_path).camera.bits == 12


def test_bands_marked_as_bad_are_left_out(tmp_path: Path) -> None:
    """Bad bands do not raise the bit depth, and a note names them. A file that marks all bands marks none."""
    values = VALUES.copy()
    values[..., 1] = 60_000
    write_envi_cube(tmp_path / "a", values, bbl="{1, 0, 1}")
    recording = open_recording(tmp_path / "a.hdr")
    bad = recording.sweeps[0].references.bad
    assert bad is not None
    assert (bad.all(axis=0).tolist(), bad.sum(), recording.camera.bits) == ([False, True, False], 16, 12)
    assert "a: bands 1 are left out: the file marks them as bad" in recording.notes
    write_envi_cube(tmp_path / "a", values, bbl="{0, 0, 0}")
    assert open_recording(tmp_path / "a.hdr").sweeps[0].references.bad is None


@pytest.mark.parametrize(("kind", "void"), [("<u2", 0), ("<u2", 65535), ("<i2", -9999)])
def test_nodata_values_are_invalid(tmp_path: Path, kind: str, void: int) -> None:
    """No-data is read as saturated and does not raise the bit depth; a line of it alone is invalid."""
    values = VALUES.astype(kind)
    values[2] = values[4, 3] = void
    write_envi_cube(tmp_path / "a", values, data_ignore_value=void)
    recording = open_recording(tmp_path / "a.hdr")
    (sweep,) = recording.sweeps
    np.testing.assert_array_equal(sweep.read_lines(np.arange(6)), np.where(values == void, np.int32(65535), values))
    assert [line.valid for line in recording.lines(sweep.sweep)] == [True, True, False, True, True, True]
    assert recording.camera.bits == 12
    assert f"a: the number {void} is no data, as the file says" in recording.notes


def test_missing_line_times_follow_the_period() -> None:
    """Times before the first and after the last follow it too: lines at one time would count as repeated."""
    source: Any = SimpleNamespace(shape=(6,))
    times = _middle_s(source, np.array([np.nan, 1.0, np.nan, 3.0, np.nan, np.nan]), CAMERA)[0]
    assert times.tolist() == [0, 1, 2, 3, 4, 5]

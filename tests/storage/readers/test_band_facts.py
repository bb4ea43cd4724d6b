"""Wavelengths, widths, colours and bad bands: of texts, and of files that rasterio and SPy read as well."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import rasterio
import scipy.io
import spectral
import xarray as xr
import zarr
from hypothesis import given
from hypothesis import strategies as st
from rasterio.enums import ColorInterp
from rich.console import Console

from spectralzoom.flows.training.init_command import run_init
from spectralzoom.pipeline.errors import SceneError, WavelengthError
from spectralzoom.pipeline.setting_fields import numbers_of
from spectralzoom.storage.readers.band_facts import (
    Bands,
    bad_bands,
    bands_of_fields,
    bands_of_names,
    bands_of_numbers,
    bands_text,
    numbers_of_list,
)
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.recorded_files import open_file_cube
from spectralzoom.storage.readers.scene_files import empty_bands, load_scene_file
from spectralzoom.storage.readers.scene_toml import SceneSettings
from tests.storage.readers.test_envi_cubes import write_envi
from tests.storage.readers.test_raster_tags import VALUES, write

NM = [450.0, 550.0, 660.5, 800.0]
COLOURS = ("blue", "green", "red", "nir")


def centres(bands: Bands) -> list[float] | None:
    return None if bands.wavelength_nm is None else bands.wavelength_nm.tolist()


@pytest.mark.parametrize(
    ("name", "nm"),
    [
        ("660.5 Nanometers", 660.5),
        ("Band 12 (660,5 nm)", 660.5),
        ("0.665 um", 665),
        ("6605 Ångström", 660.5),
        ("Band 7 - 455 nm", 455),
        ("Band 300 (900 nm)", 900),
        ("B4, central wavelength 665 nm", 665),
        ("reflectance at 0.7um", 700),
    ],
)
def test_a_band_name_gives_one_length(name: str, nm: float) -> None:
    """The number of a band is no length; a length has its unit."""
    assert centres(bands_of_names([name], "a.tif")) == pytest.approx([nm])


@pytest.mark.parametrize(
    "name",
    [
        *("20 nm at 450 nm", "450, 550 nm", "560/20 nm", "560±10 nm", "450,550 nm", "NDVI 842nm/660nm", "455_515nm"),
        *("490 nm (455-515 nm)", "Band 300 - 455 nm", "B2 (490 nm, 65 nm)", "Green 560 (27 nm)", "FWHM 20, 450 nm"),
        *("S2A_B04_665", "Band 560", "2019", "short wave infrared", "red minus nir"),
        *("Blue: 455 - 515 nm", "450 nm (0.45 um)", "455:515 nm", "min 455 max 515 nm"),
        *("0.455 < 0.515 um", "Blue 455-515", "R_550", "X350.5", "nir 842.5", "450", "232", "1050.0"),
        *(
            "Red Edge 4",
            "rededge 20m",
            "SWIR 20m",
            "B5 red edge",
            "minus red",
            "redness",
            "vegetation red edge",
            "red2",
        ),
        *("bandwidth 300 nm", "FWHM: 250 nm", ">450 nm", "450 nm ±", "NIR (infrared)", "blue aerosol", "infrared"),
    ],
)
def test_a_doubtful_band_name_is_named(name: str) -> None:
    """Ranges, several lengths, widths, numbers without a unit and words that are not in the table are not guessed."""
    bands = bands_of_names([name], "a.tif")
    assert centres(bands) is None
    assert repr(name) in bands.notes[0]


@pytest.mark.parametrize(
    ("names", "nm"),
    [
        (["blue", "green", "red", "nir"], [460, 550, 640, 800]),
        (["Band 1 Blue", "b2_GREEN", "R", "near-infrared"], [460, 550, 640, 800]),
        (["coastal", "Red edge 1", "RedEdge 3", "swir22"], [443, 705, 783, 2200]),
        (["Blue band", "2: Green", "channel 3 (red)", "Near Infrared"], [460, 550, 640, 800]),
        (["rededge071", "nir08", "nir09", "cirrus"], [705, 865, 945, 1375]),
        (["X350.5", "X360.2"], None),
        (["red", "green", "red edge 20m"], None),
        (["450 nm", "mask", "660 nm"], [450, np.nan, 660]),
        (["B04", "Band 8"], None),
        (["350", "351", "352"], None),
        (["red", "red edge", "red"], None),
        (["blue", "green", "ndvi"], None),
        (["VNIR 400-1000 nm band 1", "VNIR 400-1000 nm band 2"], None),
    ],
)
def test_band_names_agree_on_one_way(names: list[str], nm: list[float] | None) -> None:
    """Lengths, numbers or colours count where every band has its own; a band may lack a length among others."""
    assert centres(bands_of_names(names, "a.tif")) == (None if nm is None else pytest.approx(nm, nan_ok=True))


RGB = ("red", "green", "blue")


@pytest.mark.parametrize(
    ("names", "flags", "nm"),
    [
        (COLOURS, (*RGB, "undefined"), [460, 550, 640, 800]),
        (COLOURS, ("gray", "undefined", "undefined", "undefined"), [460, 550, 640, 800]),
        (("nir", "red", "green"), RGB, [800, 640, 550]),
        (("", "", "", ""), (*RGB, "undefined"), [640, 550, 460, 800]),
        ((None,) * 4, COLOURS, [460, 550, 640, 800]),
        (("a", "b", "c", "thermal"), (*RGB, "undefined"), "'thermal' do not give each band"),
        (("blue", "green", "red"), ("blue", "red", "green"), "'green' contradicts its colour in the file, red"),
        (COLOURS, (*RGB, "nir"), "'blue' contradicts its colour in the file, red"),
        (("nir", "red", "foo"), RGB, "'foo' do not give each band"),
        (("B02", "B03", "B04", "B08"), (*RGB, "undefined"), "'B08' do not give each band"),
        (("SR_B2", "SR_B3", "SR_B4"), RGB, "'SR_B4' do not give each band"),
        (("Band 1", "Band 2", "Band 3"), RGB, [640, 550, 460]),
    ],
)
def test_names_of_colours_win_over_flags(names: Any, flags: tuple[str, ...], nm: Any) -> None:
    """Red, green and blue are flags that GDAL writes by itself; a band with another name is not read by them.

    Other flags that contradict the names are refused.
    """
    bands = bands_of_names(names, "a.tif", flags)
    if isinstance(nm, str):
        assert centres(bands) is None
        assert nm in bands.notes[0]
    else:
        assert centres(bands) == nm
        assert "assumed" in bands.origin


@pytest.mark.parametrize(
    ("unit", "values", "found"),
    [
        ("Nanometers", [400, 500], [400, 500]),
        ("µm", [0.4, 2.5], [400, 2500]),
        ("Angstroms", [4000, 5000], [400, 500]),
        ("[Å]", [4000, 5000], [400, 500]),
        ("m", [4e-7, 5e-7], [400, 500]),
        ("", [400, 500], [400, 500]),
        ("Unknown", [0.4, 0.5], [400, 500]),
        (None, [4e-7, 5e-7], [400, 500]),
        ("nm", [400, np.nan, 500, -9999], [400, np.nan, 500, np.nan]),
        ("Wavenumber", [400, 500], "unit 'Wavenumber' is no length"),
        ("GHz", [400, 500], "unit 'GHz' is no length"),
        ("", [4000, 5000], "4000 to 5000 fit no unit"),
        ("", [1, 2, 3], "may count the bands"),
        ("", [1, 500], "fit no unit"),
        ("nm", [400, 0, 0], "1 of 3 bands have one"),
    ],
)
def test_wavelengths_are_converted_to_nm(unit: str | None, values: list[float], found: Any) -> None:
    """Without a unit they are read by their size, with a note; other units leave them out, with the reason."""
    bands = bands_of_numbers(np.array(values), unit, "a test")
    if isinstance(found, str):
        assert centres(bands) is None
        assert "left out" in bands.notes[0]
        assert found in bands.notes[0]
    else:
        assert centres(bands) == pytest.approx(found, nan_ok=True)
        assert bool(bands.notes) == (unit in ("", "Unknown", None) or np.isnan(values).any())


@pytest.mark.parametrize(
    ("text", "count", "found"),
    [
        ("450, 550\n650", 3, [450, 550, 650]),
        ("{450,5; 550,5}", 2, [450.5, 550.5]),
        ("450,,650", 3, [450, np.nan, 650]),
        ("450 nan 650", 3, [450, np.nan, 650]),
        ("450, 550,", 2, [450, 550]),
        ("(np.float64(450.0), np.float64(550.0))", 2, [450, 550]),
        ("450,550 650,750", 2, None),
        ("450,550", 1, None),
        ("450,5 550,5", 2, None),
        ("450, x", 2, None),
    ],
)
def test_lists_are_split_in_one_way(text: str, count: int, found: list[float] | None) -> None:
    """Commas separate, or are decimal between semicolons; what may be both is no list."""
    numbers = numbers_of_list(text, count)
    assert numbers is None if found is None else numbers == pytest.approx(found, nan_ok=True)


@pytest.mark.parametrize(
    "fields",
    [
        {"Wavelengths": "450, 550"},
        {"center wavelength": "0.45 0.55", "Center Wavelength Units": "um"},
        {"centre_wavelength": "4500; 5500", "wavelength units": "Angstrom", "centre_wavelength_unit": "Angstrom"},
        {"band centers (um)": "[0.45, 0.55]"},
        {"wavelengths_nm": ["450", "550"], "fwhm": "10 10"},
        {"wavelength": "450", "CentralWavelength": "450,0; 550,0"},
        {"long_name": "('450 nm', '550 nm')"},
    ],
)
def test_fields_have_several_names(fields: dict[str, Any]) -> None:
    """Singular and plural, both spellings, a unit in the name or beside it."""
    bands = bands_of_fields(fields, ["", ""], "a.hdr")
    assert centres(bands) == pytest.approx([450, 550])
    assert (bands.fwhm_nm is not None) == ("fwhm" in fields)


def say_in_bands(file: Any) -> None:
    for band, centre in enumerate(NM):
        file.update_tags(band + 1, WAVELENGTH=f"{centre / 1000}", WAVELENGTH_UNITS="Micrometers")


def say_in_imagery(file: Any) -> None:
    for band, centre in enumerate(NM):
        file.update_tags(band + 1, ns="IMAGERY", CENTRAL_WAVELENGTH_UM=str(centre / 1000), FWHM_UM="0.006")


def say_in_a_list(file: Any) -> None:
    file.update_tags(wavelength="{" + ", ".join(map(str, NM)) + "}", wavelength_units="nm", fwhm="6 6 6 6")


def say_in_names(file: Any) -> None:
    file.descriptions = [f"Band {number} ({centre} Nanometers)" for number, centre in enumerate(NM)]


@pytest.mark.parametrize("photometric", ["MINISBLACK", None])
@pytest.mark.parametrize("say", [say_in_bands, say_in_imagery, say_in_a_list, say_in_names])
def test_a_geotiff_states_wavelengths_in_several_ways(tmp_path: Path, say: Any, photometric: str | None) -> None:
    """A fourth band of bytes, which GDAL calls alpha by itself, is a band if it has a wavelength."""
    with write(tmp_path / "a.tif", photometric=photometric) as file:
        say(file)
    scene = load_scene_file(tmp_path / "a.tif")
    assert scene.wavelength_nm.tolist() == pytest.approx(NM)
    assert (scene.fwhm_nm is not None) == (say in (say_in_imagery, say_in_a_list))
    with rasterio.open(tmp_path / "a.tif") as second:
        np.testing.assert_array_equal(np.moveaxis(scene.values, -1, 0), second.read())


@pytest.mark.parametrize("photometric", ["MINISBLACK", "RGB", None])
def test_a_geotiff_named_by_colours_is_read_by_its_names(tmp_path: Path, photometric: str | None) -> None:
    """Whatever colour flags GDAL wrote; flags of a user that contradict the names are named in the refusal."""
    with write(tmp_path / "a.tif", photometric=photometric) as file:
        file.descriptions = COLOURS
    assert load_scene_file(tmp_path / "a.tif").wavelength_nm.tolist() == [460, 550, 640, 800]
    with rasterio.open(tmp_path / "a.tif", "r+") as file:
        file.colorinterp = [ColorInterp.blue, ColorInterp.red, ColorInterp.green, ColorInterp.undefined]
    with pytest.raises(WavelengthError, match=r"'green' contradicts its colour in the file, red\); write"):
        load_scene_file(tmp_path / "a.tif")
    assert load_scene_file(tmp_path / "a.tif", wavelengths=NM).wavelength_nm.tolist() == NM


@pytest.mark.parametrize(("name", "count"), [("B08", 4), ("Alpha", 3), ("Band 4", 3)])
def test_a_fourth_band_with_a_name_is_no_alpha(tmp_path: Path, name: str, count: int) -> None:
    """GDAL calls the fourth band of bytes alpha by itself."""
    with write(tmp_path / "a.tif", photometric=None) as file:
        file.descriptions = ("B02", "B03", "B04", name)
    assert load_scene_file(tmp_path / "a.tif", wavelengths=NM[:count]).wavelength_nm.tolist() == NM[:count]


@pytest.mark.parametrize(
    ("of_file", "of_bands"),
    [
        ({"bbl": "{1, 0, 1, 1}"}, []),
        ({}, [{"bbl": "1"}, {"BBL": "0"}, {}, {"bbl": "1.0"}]),
        ({"good bands": "1 0 1 1"}, [{"good": "1"}]),
    ],
)
def test_bands_marked_as_bad_are_left_out(tmp_path: Path, of_file: dict[str, str], of_bands: list[Any]) -> None:
    """Marks of the file and of a band's own tags count; a note names them, and `--bands` can still select them."""
    with write(tmp_path / "a.tif") as file:
        say_in_a_list(file)
        file.update_tags(**of_file)
        for band, tags in enumerate(of_bands):
            file.update_tags(band + 1, **tags)
    scene = load_scene_file(tmp_path / "a.tif")
    assert scene.wavelength_nm.tolist() == [450.0, 660.5, 800.0]
    assert any("bands 1 are left out: the file marks them as bad; --bands 0-3 takes" in one for one in scene.provenance)
    assert load_scene_file(tmp_path / "a.tif", bands=[1]).wavelength_nm.tolist() == [550.0]


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_bad_bands_round_trip_as_text(good: list[bool]) -> None:
    """The zeros of a list are the bad bands, and their text is read as the same bands, also in scene.toml."""
    bad, _ = bad_bands({"bbl": ", ".join(str(int(one)) for one in good)}, len(good))
    assert (
        list(bad) == [band for band, one in enumerate(good) if not one] == list(bad_bands({"bbl": good}, len(good))[0])
    )
    if bad:
        assert [int(str(one)) for part in bands_text(bad).split(",") for one in numbers_of(part)] == list(bad)
        assert SceneSettings.model_validate({"bands": bands_text(bad)}).bands == bad


def test_marks_that_do_not_fit_are_noted() -> None:
    """A list of another length marks no band, and flags whose meaning is not known are not read."""
    assert bad_bands({"bbl": "1, 0"}, 3) == ((), ("bbl is left out: 2 flags for 3 bands",))
    assert "1 may mean good or bad" in bad_bands({"bad bands": "1, 0"}, 2)[1][0]


def test_wavelengths_and_bad_bands_are_those_of_spy(tmp_path: Path) -> None:
    """A file that SPy writes is read alike by both."""
    marks = {"wavelength": NM, "wavelength units": "nm", "fwhm": [6.0] * 4, "bbl": [1, 0, 1, 1]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        spectral.envi.save_image(str(tmp_path / "a.hdr"), VALUES.transpose(1, 2, 0), metadata=marks, ext="img")
        second = spectral.open_image(str(tmp_path / "a.hdr"))
    source = open_cube_source(tmp_path / "a.hdr")
    assert source.bands.wavelength_nm.tolist() == second.bands.centers
    assert source.bands.fwhm_nm.tolist() == second.bands.bandwidths
    assert source.bad_bands == (1,)


REASONS = {
    "wavelength": ("{450, 550, x}", "wavelength is left out: 'x' is no number"),
    "center wavelength": ("{450}", "center wavelength is left out: 1 for 2 bands"),
    "band names": ("{20 nm at 450 nm, 550 nm}", "'20 nm at 450 nm' may give several lengths"),
}


@pytest.mark.parametrize("opened", [load_scene_file, lambda path: open_file_cube(path, None, {})])
def test_a_refusal_repeats_every_reason(tmp_path: Path, opened: Any) -> None:
    """Of a scene and of a recording."""
    fields = {key.replace(" ", "_"): value for key, (value, _) in REASONS.items()}
    path = write_envi(tmp_path / "a.img", np.ones((2, 3, 2), np.uint16), **fields)
    with pytest.raises(WavelengthError) as refused:
        opened(path.with_suffix(".hdr"))
    assert all(words in str(refused.value) for _, words in REASONS.values())


def test_an_unknown_band_is_refused_where_it_is_needed(tmp_path: Path) -> None:
    """The message names the band that was asked for; a recording needs all of them."""
    path = write_envi(tmp_path / "a.img", np.ones((2, 3, 3), np.uint16), wavelength="{450, nan, 650}")
    with pytest.raises(WavelengthError, match=r"gives no wavelength of bands 1 \(from 0\); write"):
        load_scene_file(path, bands=[0, 1])
    with pytest.raises(WavelengthError, match=r"gives no wavelength of bands 1 \(from 0\); give"):
        open_file_cube(path, None, {})
    (tmp_path / "scene.toml").write_text("wavelengths_nm = [450, 550, 650]")
    assert load_scene_file(path).wavelength_nm.tolist() == [450, 550, 650]


@pytest.mark.parametrize("stated", ['"0-1,3"', "[0, 1, 3]", '["0-1", 3]', '" 0 , 1,3"'])
def test_scene_toml_takes_ranges_of_bands(tmp_path: Path, stated: str) -> None:
    """The message on bands without values advises them in this form, and they are found before training."""
    values = np.moveaxis(VALUES, 0, -1).astype(np.float32)
    values[..., 2] = np.nan
    np.save(tmp_path / "a.npy", values)
    advice = re.escape('bands 2 (from 0); take the others: bands = "0-1,3" in a scene.toml')
    with pytest.raises(SceneError, match=advice):
        load_scene_file(tmp_path / "a.npy", wavelengths=NM)
    assert empty_bands(open_cube_source(tmp_path / "a.npy"), SceneSettings()) == (2,)
    (tmp_path / "scene.toml").write_text(f"wavelengths_nm = {NM}\nbands = {stated}")
    assert load_scene_file(tmp_path / "a.npy").wavelength_nm.tolist() == [450, 550, 800]


def test_a_table_of_wavelengths_may_have_decimal_commas(tmp_path: Path) -> None:
    """Where semicolons, tabs or spaces separate its columns; commas alone separate them."""
    np.save(tmp_path / "a.npy", np.moveaxis(VALUES, 0, -1))
    (tmp_path / "scene.toml").write_text('wavelengths_file = "w.txt"')
    (tmp_path / "w.txt").write_text("nm fwhm\n450,5;6,5\n550,5\t6,5\n660,5 6,5\n800,6\n")
    scene = load_scene_file(tmp_path / "a.npy")
    assert (scene.wavelength_nm.tolist(), scene.fwhm_nm.tolist()) == ([450.5, 550.5, 660.5, 800], [6.5, 6.5, 6.5, 6])


def test_init_leaves_out_bands_without_values(tmp_path: Path) -> None:
    """Its next command does not end in an error on them; bands that the file marks as bad are not named again."""
    values = VALUES.astype(np.float32)
    values[1], values[2] = np.nan, -9999
    with write(tmp_path / "a.tif", values) as file:
        say_in_names(file)
        file.update_tags(2, bbl="0")
    run_init(str(tmp_path / "a.tif"), Console(quiet=True))
    assert 'bands = "0,3"   # the others' in (tmp_path / "scene.toml").read_text()
    assert load_scene_file(tmp_path / "a.tif").wavelength_nm.tolist() == [450, 800]


COORDINATES: dict[str, Any] = {
    "Angstrom": {"wavelength": ("band", [4500.0, 5500], {"units": "Angstrom"})},
    "a name with a unit": {"center_wavelength_um": ("band", [0.45, 0.55])},
    "the axis": {"band": ("band", [450.0, 550.0], {"units": "nm"})},
    **{f"the axis with {key}": {"band": ("band", [0.45, 0.55], {key: "um"})} for key in ("unit", "Units", "UNIT")},
    "names": {"band": ("band", ["450 nm", "550 nm"])},
}


@pytest.mark.parametrize("case", COORDINATES)
def test_arrays_follow_the_same_rules(tmp_path: Path, case: str) -> None:
    """Coordinates and names of bands, as xarray writes them."""
    cube = xr.Dataset({"r": (("y", "x", "band"), np.ones((3, 4, 2)))}, COORDINATES[case])
    cube.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    assert load_scene_file(tmp_path / "a.nc").wavelength_nm.tolist() == pytest.approx([450, 550])


def test_an_axis_without_a_unit_is_asked_for(tmp_path: Path) -> None:
    """Its numbers may be years or days; the message names it. Numbers that count the bands are not named."""
    for numbers, words in (([2018, 2022], "coordinate band has no unit of a length"), ([1, 2], "nothing says")):
        cube = xr.Dataset({"r": (("y", "x", "band"), np.ones((3, 4, 2)))}, {"band": ("band", numbers)})
        cube.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
        with pytest.raises(WavelengthError, match=words):
            load_scene_file(tmp_path / "a.nc")


def units_of(cases: dict[str, Any]) -> list[Any]:
    return [pytest.param(*case, id=name) for name, case in cases.items()]


@pytest.mark.parametrize(
    ("fields", "names", "words"),
    units_of(
        {
            "a colour": ({"wavelength": "450, 850"}, ["blue", "red"], "band 1 is 850 nm by wavelength, .* 'red'"),
            "a length": ({"wavelength": "450, 850"}, ["450 nm", "Band 2 (800 nm)"], r"'Band 2 \(800 nm\)'"),
            "listed names": ({"wavelength": "450, 850", "band names": "nir, blue"}, [None, None], "so in 2 bands"),
            "another list": (
                {"wavelength": "450, 850", "centre wavelengths": "450 950"},
                ["", ""],
                "centre wavelengths",
            ),
            "rounded": ({"wavelength": "447.6, 853"}, ["0.45 um", "Band 2 (850 nm)"], None),
            "fitting": ({"wavelength": "492, 704"}, ["Blue", "red edge 1"], None),
            "unknown": ({"wavelength": "492, 704"}, ["B02", "thermal"], None),
        }
    ),
)
def test_a_stated_length_wins_over_a_name_with_a_note(fields: dict[str, str], names: Any, words: str | None) -> None:
    """The note names band, number and name; names that only round the number, or say nothing, give none."""
    bands = bands_of_fields({**fields, "wavelength units": "nm"}, names, "a.tif")
    assert centres(bands) == [float(one) for one in fields["wavelength"].split(",")]
    assert len(bands.notes) == (words is not None)
    assert words is None or re.search(words, bands.notes[0])


@pytest.mark.parametrize(
    ("units", "nm"),
    [
        (["nm", "nm", ""], [450, 550, 650]),
        (["nm", "Nanometers", "nm"], [450, 550, 650]),
        (["", "", ""], [450, 550, 650]),
        (["nm", "um", "nm"], None),
    ],
)
def test_bands_that_state_a_unit_decide(units: list[str], nm: list[float] | None) -> None:
    """A band without a tag beside others has their unit; different units are asked for."""
    bands = bands_of_fields({"wavelength": ["450", "550", "650"], "wavelength_units": units}, [None] * 3, "a.tif")
    assert centres(bands) == nm
    assert (nm is None) == ("wavelength is left out: it has several units" in bands.notes)


def test_a_band_without_tags_is_left_out_beside_others(tmp_path: Path) -> None:
    """The three that state a wavelength keep theirs."""
    with write(tmp_path / "a.tif") as file:
        for band, centre in enumerate(NM[:3]):
            file.update_tags(band + 1, wavelength=f"{centre}", wavelength_units="nm")
    assert load_scene_file(tmp_path / "a.tif").wavelength_nm.tolist() == NM[:3]


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((5, 6, 4), r"axis 0 \(from 0\) of \(5, 6, 4\) has 5.*numpy.moveaxis\(cube, 0, -1\)"),
        ((6, 5, 4), r"axis 1 .*permute \[1 3 2\] or numpy.moveaxis\(cube, 1, -1\)"),
        ((5, 5, 4), None),
        ((6, 7, 4), None),
    ],
)
@pytest.mark.parametrize("kind", ["mat", "7.3", "h5", "zarr", "flag"])
def test_the_axis_that_fits_the_wavelengths_is_named(tmp_path: Path, kind: str, shape: Any, words: str | None) -> None:
    """Of every format without names of axes; two axes of this size, or none, are not named."""
    cube, nm, path, flag = np.ones(shape), np.linspace(450, 650, 5), tmp_path / f"a.{kind}", None
    if kind == "mat":
        scipy.io.savemat(path, {"cube": cube, "wavelength": nm})
    elif kind == "zarr":
        group = zarr.open_group(path, mode="w")
        group.create_array("cube", data=cube)
        group.create_array("wavelength", data=nm)
    elif kind == "flag":
        path, flag = tmp_path / "a.npy", nm.tolist()
        np.save(path, cube)
    else:
        path = tmp_path / ("a.mat" if kind == "7.3" else "a.h5")
        with h5py.File(path, "w") as file:
            file["cube"], file["wavelength"] = (cube.T, nm[None].T) if kind == "7.3" else (cube, nm)
    with pytest.raises(WavelengthError) as refused:
        load_scene_file(path, wavelengths=flag)
    assert re.search(words or "5", str(refused.value))
    assert ("so if these are the bands" in str(refused.value)) == (words is not None)


def test_vectors_of_matlab_are_wavelengths_widths_and_bad_bands(tmp_path: Path) -> None:
    """They have two axes there."""
    beside = {"Wavelengths": [[450.0, 550, 660]], "FWHM": [[6.0], [6], [6]], "bbl": [[True, False, True]]}
    scipy.io.savemat(tmp_path / "a.mat", {"cube": np.ones((4, 5, 3)), **beside})
    scene = load_scene_file(tmp_path / "a.mat")
    assert (scene.wavelength_nm.tolist(), scene.fwhm_nm.tolist()) == ([450, 660], [6, 6])


def test_attributes_of_an_array_list_wavelengths_and_bad_bands(tmp_path: Path) -> None:
    """As lists or as text; an array that does not fit is among the reasons of a refusal."""
    about: dict[str, Any] = {"wavelength": [0.45, 0.55], "wavelength_units": "um", "bbl": "1, 0"}
    axes = ("y", "x", "band"), np.ones((3, 4, 2))
    xr.Dataset({"r": (*axes, about)}).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    assert load_scene_file(tmp_path / "a.nc").wavelength_nm.tolist() == pytest.approx([450])
    xr.Dataset({"r": axes, "wavelength": ("all", [1.0, 2, 3])}).to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    with pytest.raises(
        WavelengthError, match=r"array wavelength is left out: it has float64 of shape \(3,\) for 2 bands"
    ):
        load_scene_file(tmp_path / "b.nc")


@pytest.mark.parametrize("stated", ['"0-x"', '"3-1"', '["a"]', '""'])
def test_wrong_ranges_of_bands_are_named(tmp_path: Path, stated: str) -> None:
    """The error shows how ranges are written."""
    np.save(tmp_path / "a.npy", np.moveaxis(VALUES, 0, -1))
    (tmp_path / "scene.toml").write_text(f"wavelengths_nm = {NM}\nbands = {stated}")
    with pytest.raises(SceneError, match="is no band; write numbers and ranges such as"):
        load_scene_file(tmp_path / "a.npy")

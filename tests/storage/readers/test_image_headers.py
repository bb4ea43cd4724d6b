"""ENVI headers beside images, and the logs of image libraries."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from PIL import Image

from spectralzoom.pipeline.errors import SceneError, WavelengthError
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.scene_files import load_scene_file
from tests.storage.readers.test_raster_tags import NM, VALUES, write


def header(path: Path, lines: int = 6, bands: int = 4, more: str = "") -> None:
    """Write a header of an image with 7 samples, as ENVI writes it beside a TIFF."""
    nm = ", ".join(map(str, [*NM, 900, 950][:bands]))
    sizes = f"samples = 7\nlines = {lines}\nbands = {bands}\nfile type = TIFF\n"
    path.write_text(f"ENVI\n{sizes}wavelength units = nm\nwavelength = {{{nm}}}\n{more}")


@pytest.mark.parametrize("name", ["a.hdr", "a.tif.hdr", "a.HDR"])
@pytest.mark.parametrize("photometric", ["MINISBLACK", "RGB", None])
def test_a_header_of_the_size_of_an_image_states_its_bands(tmp_path: Path, name: str, photometric: Any) -> None:
    """Also of a fourth band that GDAL calls alpha; the origin and the hash have the header."""
    write(tmp_path / "a.tif", photometric=photometric).close()
    header(tmp_path / name, more="bbl = {1, 0, 1, 1}\nreflectance scale factor = 100\n")
    scene = load_scene_file(tmp_path / "a.tif")
    assert scene.wavelength_nm.tolist() == [NM[0], *NM[2:]]
    assert f"wavelengths from the list wavelength of {tmp_path}/a.tif and {name}" in scene.provenance
    left = (
        f"of {name} beside it, facts of bands are read, and not reflectance scale factor; state these in a scene.toml"
    )
    assert left in scene.provenance
    assert tmp_path / name in open_cube_source(tmp_path / "a.tif").files


@pytest.mark.parametrize(("lines", "bands"), [(6, 5), (5, 4)])
def test_a_header_of_another_size_is_named(tmp_path: Path, lines: int, bands: int) -> None:
    """It may belong to other data; an image that states its own bands does not need it."""
    write(tmp_path / "a.tif").close()
    header(tmp_path / "a.hdr", lines, bands)
    with pytest.raises(
        WavelengthError, match=rf"a.hdr beside it is not read: it describes {lines} x 7 px .* {bands} b"
    ):
        load_scene_file(tmp_path / "a.tif")
    Image.fromarray(np.moveaxis(VALUES[:3], 0, -1)).save(tmp_path / "a.png")
    assert not any("a.hdr" in note for note in load_scene_file(tmp_path / "a.png").provenance)


@pytest.mark.parametrize("text", ["ncols 7\nnrows 6\n", "ENVI\nsamples = 7\n", ""])
def test_other_headers_are_not_named(tmp_path: Path, text: str) -> None:
    """Of ArcGIS, without wavelengths, and empty."""
    write(tmp_path / "a.tif").close()
    (tmp_path / "a.hdr").write_text(text)
    assert load_scene_file(tmp_path / "a.tif", wavelengths=NM).provenance[0].startswith("wavelengths stated")


def test_tags_of_an_image_win_over_a_header(tmp_path: Path) -> None:
    """The header is then no part of the scene."""
    with write(tmp_path / "a.tif") as file:
        file.update_tags(wavelength="{500, 600, 700, 800}", wavelength_units="nm")
    header(tmp_path / "a.hdr")
    source = open_cube_source(tmp_path / "a.tif")
    assert source.bands.wavelength_nm is not None
    assert source.bands.wavelength_nm.tolist() == [500, 600, 700, 800]
    assert source.files == (tmp_path / "a.tif",)


def tiff_of(path: Path, **more: Any) -> None:
    """Write a TIFF of seven bands."""
    values = np.random.default_rng(5).integers(1, 99, (20, 30, 7)).astype(np.uint16)
    tifffile.imwrite(path, values, photometric="minisblack", planarconfig="contig", **more)


def with_overview(path: Path) -> None:
    tiff_of(path)
    with warnings.catch_warnings(), rasterio.Env(TIFF_USE_OVR=True):
        warnings.simplefilter("ignore")
        with rasterio.open(path, "r+") as file:
            file.build_overviews([2])


def with_broken_sidecar(path: Path) -> None:
    tiff_of(path)
    path.with_name(f"{path.name}.aux.xml").write_text("<PAMDataset><broken")


def cut_off(path: Path) -> None:
    tiff_of(path)
    path.write_bytes(path.read_bytes()[:5000])


NOISY: dict[str, Callable[[Path], None]] = {
    "seven bands": tiff_of,
    "wrong tag": lambda path: tiff_of(path, extratags=[(320, "H", 2, (1, 2), True)]),
    "overview": with_overview,
    "sidecar": with_broken_sidecar,
    "cut off": cut_off,
    "nine bands, big": lambda path: tiff_of(path, bigtiff=True, extratags=[(65000, "s", 0, "x", True)]),
}


@pytest.fixture
def heard() -> Iterator[list[str]]:
    """Give what reaches the handlers of the root, as a terminal has one; pytest's own also hang on other loggers."""
    messages: list[str] = []
    root = logging.Handler()
    root.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger().addHandler(root)
    yield messages
    logging.getLogger().removeHandler(root)


@pytest.mark.parametrize("case", NOISY)
def test_image_libraries_are_silent(tmp_path: Path, case: str, heard: list[str], capfd: Any) -> None:
    """Their logs, and their warnings, which would fail this test, do not reach the terminal."""
    NOISY[case](tmp_path / "a.tif")
    heard.clear()
    capfd.readouterr()
    try:
        source = open_cube_source(tmp_path / "a.tif")
        source.read(0, source.shape[0])
    except SceneError:
        assert case == "cut off"
    assert not heard
    assert capfd.readouterr() == ("", "")


def test_a_warning_of_gdal_is_a_note(tmp_path: Path) -> None:
    """Once, without the name of the file."""
    NOISY["wrong tag"](tmp_path / "a.tif")
    notes = open_cube_source(tmp_path / "a.tif").notes
    assert notes == ('GDAL warns: TIFFReadDirectory:Incorrect count for "ColorMap"; tag ignored',)


def test_logs_of_a_user_are_passed_on(heard: list[str]) -> None:
    """Only what is said while a reader works is kept."""
    logging.getLogger("rasterio._env").warning("of a user")
    logging.getLogger("PIL.Image").error("of a user")
    assert heard == ["of a user"] * 2

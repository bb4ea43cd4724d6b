"""ENVI against other readers and writers: Spectral Python (SPy) and, where it is installed, GDAL through rasterio."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.export.envi_writer import EnviFile, write_envi
from storage.readers.envi_cubes import DATA_TYPES, INTERLEAVES, EnviCube, open_envi_cube
from storage.readers.scan_files import open_cube_source

pytest.importorskip("spectral", reason="SPy is the oracle: pip install spectral")
envi = pytest.importorskip("spectral.io.envi", reason="SPy is the oracle: pip install spectral")

pytestmark = [
    pytest.mark.filterwarnings("ignore:Parameters with non-lowercase names"),  # SPy says so of keys as ENVI has them
    pytest.mark.filterwarnings("ignore:Dataset has no geotransform"),  # GDAL of a cube that lies on no map
]
ORDERS = {"little": "<", "big": ">"}
CODES = sorted(DATA_TYPES)
SHAPE = (6, 7, 5)
NM = [401.25, 402.5, 550.0, 800.125, 999.875]
WIDTHS = [5.5, 5.25, 6.0, 7.125, 8.0]
NAMES = ["blue 1", "blue 2", "green", "edge", "last"]


def numbers(code: int, seed: int = 0) -> NDArray[Any]:
    """Random numbers over the whole range of an ENVI type, (line, sample, band); none that float are NaN."""
    kind = np.dtype(DATA_TYPES[code])
    rng = np.random.default_rng(100 * code + seed)
    if kind.kind in "ui":
        return np.frombuffer(rng.bytes(int(np.prod(SHAPE)) * kind.itemsize), kind).reshape(SHAPE).copy()
    values = rng.normal(0, 1e6, SHAPE) + (1j * rng.normal(0, 1, SHAPE) if kind.kind == "c" else 0)
    return values.astype(kind)


def written_by_spy(folder: Path, code: int, interleave: str, order: str, **about: Any) -> tuple[Path, NDArray[Any]]:
    """A header by SPy with a random cube beside it, and the cube."""
    values = numbers(code)
    header = folder / "a.hdr"
    envi.save_image(str(header), values, interleave=interleave, byteorder=order, ext=".img", metadata=about, force=True)
    return header, values


def as_spy_reads(header: Path) -> NDArray[Any]:
    """The numbers, (line, sample, band), without any factor that the header states."""
    return np.asarray(envi.open(str(header)).open_memmap(interleave="bip"))


def assert_same(found: EnviCube, values: NDArray[Any], code: int, order: str) -> None:
    """Equal bit by bit, of the type and byte order asked for, and whole."""
    assert found.header.dtype == np.dtype(ORDERS[order] + DATA_TYPES[code])
    assert np.ascontiguousarray(found.values, values.dtype).tobytes() == values.tobytes()
    assert found.lost_lines == 0


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("interleave", INTERLEAVES)
@pytest.mark.parametrize("code", CODES)
def test_what_spy_writes_is_read(tmp_path: Path, code: int, interleave: str, order: str) -> None:
    """Every type, interleave and byte order: the numbers that SPy was given, with and without a header offset."""
    header, values = written_by_spy(tmp_path, code, interleave, order)
    assert_same(open_envi_cube(header), values, code, order)
    shifted(header, 37)
    assert_same(open_envi_cube(header), values, code, order)
    np.testing.assert_array_equal(as_spy_reads(header), values)


def shifted(header: Path, offset: int) -> None:
    """Put bytes before the numbers, and say so in the header."""
    data = header.with_suffix(".img")
    data.write_bytes(random.Random(1).randbytes(offset) + data.read_bytes())
    header.write_text(header.read_text().replace("header offset = 0", f"header offset = {offset}"))
    assert f"header offset = {offset}" in header.read_text()


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("interleave", INTERLEAVES)
@pytest.mark.parametrize("code", CODES)
def test_what_is_written_spy_reads(tmp_path: Path, code: int, interleave: str, order: str) -> None:
    """Every type, interleave and byte order: SPy reads the numbers, bands and no-data value that were written."""
    values, kind = numbers(code), np.dtype(ORDERS[order] + DATA_TYPES[code])
    file = EnviFile(SHAPE, kind.str, interleave, np.array(NM), np.array(WIDTHS), "two words", nodata=7.0)
    write_envi(tmp_path / "a.hdr", file, in_blocks(values))
    np.testing.assert_array_equal(as_spy_reads(tmp_path / "a.hdr"), values)
    found = envi.open(str(tmp_path / "a.hdr"))
    assert (found.bands.centers, found.bands.bandwidths) == (NM, WIDTHS)
    assert float(found.metadata["data ignore value"]) == 7.0
    assert found.metadata["description"] == "two words"


def in_blocks(values: NDArray[Any]) -> Iterator[tuple[int, NDArray[Any]]]:
    """Four lines, then the rest."""
    yield 0, values[:4]
    yield 4, values[4:]


def test_what_headers_say_of_bands(tmp_path: Path) -> None:
    """Wavelengths, widths, names and the no-data value are the same to both."""
    about = {"wavelength": NM, "fwhm": WIDTHS, "wavelength units": "nm", "band names": NAMES, "data ignore value": -7.5}
    header, _ = written_by_spy(tmp_path, 4, "bil", "little", **about)
    ours, theirs = open_envi_cube(header).header, envi.open(str(header))
    assert ours.wavelength_nm is not None
    assert ours.fwhm_nm is not None
    assert ours.wavelength_nm.tolist() == theirs.bands.centers == NM
    assert ours.fwhm_nm.tolist() == theirs.bands.bandwidths == WIDTHS
    assert list(ours.band_names) == theirs.metadata["band names"] == NAMES
    assert ours.nodata == float(theirs.metadata["data ignore value"]) == -7.5


def odd(text: str, rng: random.Random) -> str:
    """The same header as others may write it: capitals, spaces, comments, lists over lines, nothing optional."""
    lines = ["ENVI", "; a comment = of no account"]
    for line in text.splitlines()[1:]:
        key, _, value = (part.strip() for part in line.partition("="))
        if not key or key in ("header offset", "file type", "description"):
            continue
        if rng.random() < 0.5:
            key = key.title() if rng.random() < 0.5 else key.upper()
        if key.lower() == "interleave" and rng.random() < 0.5:
            value = value.upper()
        if value.startswith("{"):
            words = [word.strip() for word in value.strip("{}").split(",")]
            value = "{\n " + " ,\n   ".join(words) + rng.choice(("}", "\n}"))
        lines.append(f"{key}{rng.choice(('=', ' = ', '   =  '))}{value}{rng.choice(('', '  '))}")
        if rng.random() < 0.3:
            lines.append(rng.choice(("", "; between", ";key = value")))
    return "\n".join(lines) + rng.choice(("", "\n", "\n\n"))


@pytest.mark.parametrize("seed", range(12))
def test_odd_headers(tmp_path: Path, seed: int) -> None:
    """However a legal header is laid out, both readers find the same cube and bands in it."""
    rng = random.Random(seed)
    code, interleave, order = rng.choice(CODES), rng.choice(INTERLEAVES), rng.choice(sorted(ORDERS))
    header, values = written_by_spy(tmp_path, code, interleave, order, wavelength=NM, fwhm=WIDTHS)
    header.write_text(odd(header.read_text(), rng))
    found = open_envi_cube(header)
    assert_same(found, values, code, order)
    np.testing.assert_array_equal(as_spy_reads(header), values)
    assert found.header.wavelength_nm is not None
    assert found.header.wavelength_nm.tolist() == envi.open(str(header)).bands.centers == NM


@pytest.mark.parametrize("code", [6, 9])
def test_complex_numbers_are_no_light(tmp_path: Path, code: int) -> None:
    """Complex cubes open value by value; as something to ingest or look at they are refused with the reason."""
    header, values = written_by_spy(tmp_path, code, "bil", "little")
    np.testing.assert_array_equal(open_envi_cube(header).values, values)
    with pytest.raises(SceneError, match="holds complex numbers; store their magnitude"):
        open_cube_source(header)


@pytest.mark.parametrize(
    ("says", "words"),
    [("major frame offsets = {4, 0}", "major frame offsets"), ("minor frame offsets = {0, 2}", "minor frame offsets")],
)
def test_bytes_between_frames_are_refused_by_both(tmp_path: Path, says: str, words: str) -> None:
    """Bytes around each frame would shift every number after the first: neither reads on."""
    header, _ = written_by_spy(tmp_path, 12, "bil", "little")
    header.write_text(header.read_text() + says + "\n")
    with pytest.raises(envi.EnviFeatureNotSupported):
        envi.open(str(header))
    with pytest.raises(SceneError, match=words):
        open_envi_cube(header)
    header.write_text(header.read_text().replace("4, 0", "0, 0").replace("0, 2", "0, 0"))
    assert open_envi_cube(header).lost_lines == 0


@pytest.mark.parametrize("interleave", INTERLEAVES)
def test_cut_off_files_differ_on_purpose(tmp_path: Path, interleave: str) -> None:
    """SPy does not open a file that is cut off; here the lines that are whole in all bands are kept and flagged."""
    header, values = written_by_spy(tmp_path, 12, interleave, "little")
    data = header.with_suffix(".img")
    row = SHAPE[1] * 2
    data.write_bytes(data.read_bytes()[: -row * (1 if interleave == "bsq" else SHAPE[2])])
    with pytest.raises((EOFError, ValueError, IndexError)):  # which of them depends on the interleave
        as_spy_reads(header)[-1]
    found = open_envi_cube(header)
    assert found.lost_lines == 1
    np.testing.assert_array_equal(found.values, values[:5])
    assert "a.img is cut off: 5 of 6 lines are whole" in found.notes


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("interleave", INTERLEAVES)
@pytest.mark.parametrize("code", [1, 2, 3, 4, 5, 6, 9, 12, 13])
def test_gdal_reads_the_same(tmp_path: Path, code: int, interleave: str, order: str) -> None:
    """GDAL agrees on what SPy and this project write (of 64-bit whole numbers older releases know nothing)."""
    rasterio = pytest.importorskip("rasterio", reason="GDAL comes with rasterio: pip install 'spectralzoom[geo]'")
    header, values = written_by_spy(tmp_path, code, interleave, order)
    shifted(header, 16)
    ours = tmp_path / "b.hdr"
    kind = np.dtype(ORDERS[order] + DATA_TYPES[code])
    write_envi(ours, EnviFile(SHAPE, kind.str, interleave), in_blocks(values))
    for data in (header.with_suffix(".img"), ours.with_suffix(".img")):
        with rasterio.open(data, driver="ENVI") as found:
            np.testing.assert_array_equal(np.moveaxis(found.read(), 0, -1), values)
        np.testing.assert_array_equal(open_envi_cube(data).values, values)

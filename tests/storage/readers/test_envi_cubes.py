"""ENVI cubes and headers: interleaves, truncated files, braces, comments, wavelengths and refused claims."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.pipeline.envi_headers import parse_envi_header
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.band_facts import bands_of_fields
from spectralzoom.storage.readers.envi_files import load_envi_header, open_envi_cube
from spectralzoom.storage.readers.open_cubes import open_cube_source

CODES = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "u2": 12}
AXES = {"bil": (0, 2, 1), "bip": (0, 1, 2), "bsq": (2, 0, 1)}


def write_envi(path: Path, values: NDArray[Any], order: str = "bil", *, offset: int = 0, **fields: object) -> Path:
    """Write (line, sample, band) values and their header, with these fields (None: without); return the data's path."""
    sizes = dict(zip(("lines", "samples", "bands"), values.shape, strict=True))
    kind = {"header offset": offset, "data type": CODES[values.dtype.str[1:]], "interleave": order, "byte order": 0}
    said = sizes | kind | {key.replace("_", " "): value for key, value in fields.items()}
    text = "".join(f"{key} = {value}\n" for key, value in said.items() if value is not None)
    path.with_suffix(".hdr").write_text("ENVI\n" + text)
    path.write_bytes(b"x" * offset + values.transpose(AXES[order]).tobytes())
    return path


@pytest.mark.parametrize("interleave", sorted(AXES))
def test_truncated_cubes_keep_their_whole_lines(tmp_path: Path, interleave: str) -> None:
    """Cut at any byte, in the offset or in a line: lines that are whole in all bands are kept, others are 0."""
    values = np.random.default_rng(0).integers(0, 4096, (5, 3, 2), dtype=np.uint16)
    path = write_envi(tmp_path / "a.img", values, interleave, offset=10)
    whole = path.read_bytes()
    for size in range(len(whole) + 1):
        path.write_bytes(whole[:size])
        there = max(size - 10, 0)
        held = max(there - 30, 0) // 6 if interleave == "bsq" else there // 12
        if held == 0:
            with pytest.raises(SceneError, match=f"holds {there} bytes after an offset of 10, no whole line"):
                open_envi_cube(path)
            continue
        cube, source = open_envi_cube(path), open_cube_source(path)
        assert (cube.lost_lines, (~source.valid).sum(), source.shape) == (5 - held, 5 - held, (5, 3, 2))
        assert cube.notes == ((f"a.img is cut off: {held} of 5 lines are whole",) if held < 5 else ())
        np.testing.assert_array_equal(cube.values[...], values[:held])
        np.testing.assert_array_equal(source.read(0, held), values[:held])
        assert not source.read(held, 5).any()


@pytest.mark.parametrize("interleave", sorted(AXES))
def test_lines_are_counted_from_the_file_size(tmp_path: Path, interleave: str) -> None:
    """The header does not state the number of lines."""
    values = np.arange(60, dtype="f4").reshape(5, 4, 3)
    header = write_envi(tmp_path / "a.bin", values, interleave).with_suffix(".hdr")
    header.write_text(header.read_text().replace("lines = 5\n", ""))
    cube = open_envi_cube(header)
    np.testing.assert_array_equal(cube.values[...], values)
    assert "the file holds 5" in cube.notes[0]


def test_header_and_data_file_find_each_other(tmp_path: Path) -> None:
    """Either file may be given, and the header's name may contain the ending of the data file."""
    path = write_envi(tmp_path / "scene.bip", np.ones((2, 2, 2), "u1"), "bip")
    (tmp_path / "scene.hdr").rename(tmp_path / "scene.bip.hdr")
    assert open_envi_cube(path).path == path
    assert open_envi_cube(tmp_path / "scene.bip.hdr").path == path
    with pytest.raises(SceneError, match=r"there is no file .*none\.dat"):
        open_envi_cube(tmp_path / "none.dat")


PLAIN = "ENVI\nsamples = 4\nlines = 3\nbands = 2\ndata type = 12\ninterleave = bil\nbyte order = 0\n"

REFUSED = {
    "plantcv__arcgis.hdr": "begins with 'BYTEORDER I', expected ENVI",
    "plantcv__darkReference_arcgis.hdr": "begins with 'BYTEORDER I', expected ENVI",
    "plantcv__darkReference4.hdr": "interleave = 'bup', expected one of bil, bip, bsq",
    "emit_l1b__EMIT_Linearity_20210111.hdr": "bands = '0', expected a whole number from 1",
}


def test_values_in_braces_are_parsed() -> None:
    """Values may span lines, nest and hold equal signs; escaped braces and braces within a line do not count."""
    text = PLAIN + (
        'description = {\n first {nested}\n samples = 9\n}\nhistory = a -> b{c\nproj = {PROJCS["x"], {1, 2}}\n'
        "odd = {with \\{ escaped}\nband names = {red, near infrared}\n"
    )
    header = parse_envi_header(text)
    assert header.samples == 4
    assert header.fields["description"] == "first {nested}\n samples = 9"
    assert header.fields["history"] == "a -> b{c"
    assert header.fields["proj"] == 'PROJCS["x"], {1, 2}'
    assert header.fields["odd"] == "with \\{ escaped"


def test_unbalanced_braces_do_not_hide_fields() -> None:
    """A brace that is never closed, also by one too many that opens, is refused."""
    with pytest.raises(SceneError, match="description opens a brace that is never closed"):
        parse_envi_header(PLAIN.replace("samples", "description = {a {b}\nsamples"))
    with pytest.raises(SceneError, match=r"wavelength opens a brace that is never closed; is the header cut off"):
        parse_envi_header(PLAIN + "wavelength = {400,\n500")


def test_comment_lines_hold_settings() -> None:
    """Lines that begin with a semicolon are no fields, but settings in them are kept, also within braces."""
    text = "; free words\n;Exposure (ms) = 100.25\n ;POST AOI width : 1600\nwavelength = {\n400\n;x = 1\n,402\n}\n"
    header = parse_envi_header(PLAIN + text)
    assert header.settings == {"exposure (ms)": "100.25", "post aoi width": "1600", "x": "1"}
    assert header.fields["wavelength"].split() == ["400", ",402"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ENVI", "ENVY", "begins with 'ENVY', expected ENVI"),
        ("samples = 4", "samples = many", "samples = 'many', expected a whole number from 1"),
        ("samples = 4", "samples = 4.5", "samples = '4.5', expected a whole number"),
        ("bands = 2", "bands = -2", "bands = '-2', expected a whole number from 1"),
        ("data type = 12", "data type = 7", "data type = 7 is none of ENVI's"),
        ("byte order = 0", "byte order = 2", r"byte order = 2, expected 0 \(little endian\)"),
        ("bil", "xyz", "interleave = 'xyz'"),
    ],
)
def test_invalid_headers_are_refused(old: str, new: str, words: str) -> None:
    """The error says what was expected."""
    with pytest.raises(SceneError, match=words):
        parse_envi_header(PLAIN.replace(old, new), "a.hdr")


def test_missing_empty_and_binary_headers_are_refused(tmp_path: Path) -> None:
    """Latin letters in headers of old programs are read."""
    path = tmp_path / "a.hdr"
    with pytest.raises(SceneError, match=r"a\.hdr cannot be read"):
        load_envi_header(path)
    path.write_bytes(b"")
    with pytest.raises(SceneError, match="is empty, expected ENVI"):
        load_envi_header(path)
    path.write_bytes(b"\0\1\xff")
    with pytest.raises(SceneError, match="expected ENVI on its own line; name an ENVI header"):
        load_envi_header(path)
    path.write_bytes(PLAIN.encode() + "sensor = Kamera f\xfcr \xb5m".encode("latin-1"))
    assert load_envi_header(path).fields["sensor"] == "Kamera f\xfcr \xb5m"


def test_headers_of_real_instruments(real_data: Path) -> None:
    """All 42 headers are read or refused for the expected reason; the wavelength ranges of six are checked."""
    refused, read = {}, {}
    for path in sorted((real_data / "envi_headers").glob("*.hdr")):
        try:
            read[path.name] = load_envi_header(path)
        except SceneError as error:
            refused[path.name] = str(error)
    assert len(read) + len(refused) == 42
    assert set(refused) == set(REFUSED)
    assert all(words in refused[name] for name, words in REFUSED.items())
    spans = {
        "enmap_box__enmap_berlin.hdr": (177, 460, 2409),
        "enmap_box__gamsberg_field_library.hdr": (2151, 350, 2500),
        "headwall_mvx__darkReference.hdr": (301, 400, 1000),
        "specim_fenix_cal__Radiometric_2x2_1x1.hdr": (624, 377.35, 2503.73),
        "hdr_roijoy__RO_004_5_2025-04-17_01-08-18_.hdr": (110, 370, 806),
        "emit_l1b__reference.hdr": (288, 365.80463, 2504.28),
    }
    for name, (count, first, last) in spans.items():
        assert count == (read[name].samples if "library" in name else read[name].bands)
        found = bands_of_fields(read[name].fields, [None] * count, name).wavelength_nm
        assert found is not None
        assert (found[0], found[-1]) == pytest.approx((first, last))
    assert read["hdr_gdal__uint16_envi_bigendian.hdr"].dtype == np.dtype(">u2")
    assert read["headwall_mvx__darkReference.hdr"].settings["exposure (ms)"] == "100.0033437"
    short = read["plantcv__darkReference2.hdr"]
    notes = bands_of_fields(short.fields, [None] * short.bands, "").notes
    assert notes == ("wavelength is left out: 35 for 978 bands",)


@pytest.mark.parametrize(
    "text",
    [
        PLAIN.replace("samples = 4", "samples = 1000000000000"),
        PLAIN.replace("bands = 2", "bands = 1000000000000"),
        PLAIN.replace("data type = 12", "data type = 12\nheader offset = 10000000000000"),
        PLAIN.replace("samples = 4", "samples = 99999999999999999999999999999999"),
    ],
)
def test_huge_claims_are_refused_from_the_size_of_the_file(tmp_path: Path, text: str) -> None:
    """A header that claims more than its data file holds is refused before memory is allocated."""
    (tmp_path / "a.hdr").write_text(text)
    (tmp_path / "a.bin").write_bytes(bytes(48))
    tracemalloc.start()
    with pytest.raises(SceneError, match="no whole line"):
        open_cube_source(tmp_path / "a.hdr")
    assert tracemalloc.get_traced_memory()[1] < 1 << 18
    tracemalloc.stop()


def test_lines_beyond_the_file_are_flagged_or_left_out(tmp_path: Path) -> None:
    """A few missing lines are flagged; of 10^12 claimed lines the missing ones are left out with a note."""
    (tmp_path / "a.bin").write_bytes(bytes(48))
    (tmp_path / "a.hdr").write_text(PLAIN.replace("lines = 3", "lines = 5"))
    source = open_cube_source(tmp_path / "a.hdr")
    assert (source.shape[0], (~source.valid).sum()) == (5, 2)
    (tmp_path / "a.hdr").write_text(PLAIN.replace("lines = 3", "lines = 1000000000000"))
    source = open_cube_source(tmp_path / "a.hdr")
    assert (source.shape[0], (~source.valid).sum()) == (3, 0)
    assert any("999999999997 lines that a.bin lacks are not filled up" in note for note in source.notes)


@pytest.mark.parametrize(
    "made",
    [
        " " * 200_000 + "x\n",
        ";" + " " * 200_000 + "x\n",
        "a" + " " * 200_000 + "{=\n",
        "".join(f"k{number} = {{{{}}\n" for number in range(20_000)),
        "{" * 200_000 + "\n",
        "a = " + "{" * 100_000 + "}" * 100_000 + "\n",
    ],
    ids=["spaces", "comment", "brace in a key", "unbalanced values", "braces", "nested"],
)
def test_hostile_headers_do_not_stall_the_parser(made: str) -> None:
    """Text that invites repeated searches is read once or refused; a quadratic search would take hours."""
    try:
        parse_envi_header(PLAIN + made)
    except SceneError as error:
        assert "never closed" in str(error)  # noqa: PT017 - either end is well


def test_gains_and_offsets_of_bands_are_applied(tmp_path: Path) -> None:
    """The header lists one number per band; a list of another length is refused."""
    path = write_envi(tmp_path / "a.img", np.arange(6, dtype=np.uint16).reshape(1, 3, 2))
    header = path.with_suffix(".hdr")
    text = header.read_text()
    header.write_text(text + "data gain values = {0.5, 2}\ndata offset values = {1, 0}\n")
    assert open_cube_source(path).read(0, 1).tolist() == [[[1, 2], [2, 6], [3, 10]]]
    header.write_text(text + "data gain values = {0.5}\n")
    with pytest.raises(SceneError, match="expected 2 as numbers; correct it"):
        open_cube_source(path)

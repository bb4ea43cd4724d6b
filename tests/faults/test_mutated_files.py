"""A quick part of the runs over mutated files; in full ``python tests/faults headers files``."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from pipeline.errors import SceneError
from storage.readers.envi_cubes import LARGEST_HEADER, parse_envi_header
from storage.readers.scan_files import open_cube_source
from tests.faults.cube_files import FORMATS
from tests.faults.mutated_files import try_files
from tests.faults.mutated_headers import HAND_MADE, real_headers, try_headers

PLAIN = HAND_MADE[0]


@pytest.mark.parametrize("seed", [1, 2])
def test_mutated_headers_end_well(seed: int) -> None:
    """Each header gives a cube or one clear error, soon, in about the memory that the files take."""
    found = try_headers(300, real_headers(), seed)
    assert found.wrong == []
    assert found.read > 20  # else nothing but the first check was tried
    assert sum(found.refused.values()) > 20


@pytest.mark.parametrize(
    "text",
    [
        PLAIN.replace("samples = 4", "samples = 1000000000000"),
        PLAIN.replace("bands = 2", "bands = 1000000000000"),
        PLAIN.replace("header offset", "x").replace("data type = 12", "data type = 12\nheader offset = 10000000000000"),
        PLAIN.replace("samples = 4", "samples = 99999999999999999999999999999999"),
    ],
)
def test_huge_claims_are_refused_from_the_size_of_the_file(tmp_path: Path, text: str) -> None:
    """What a header claims beyond its data file is refused before anything of that size is asked for."""
    (tmp_path / "a.hdr").write_text(text)
    (tmp_path / "a.bin").write_bytes(bytes(48))
    tracemalloc.start()
    with pytest.raises(SceneError, match="no whole line"):
        open_cube_source(tmp_path / "a.hdr")
    assert tracemalloc.get_traced_memory()[1] < 1 << 18
    tracemalloc.stop()


def test_lines_beyond_the_file_are_not_made_up(tmp_path: Path) -> None:
    """Some missing lines are flagged; lines beyond all measure are told of, and not made."""
    (tmp_path / "a.bin").write_bytes(bytes(48))
    (tmp_path / "a.hdr").write_text(PLAIN.replace("lines = 3", "lines = 5"))
    source = open_cube_source(tmp_path / "a.hdr")
    assert (source.shape[0], source.lost_lines) == (5, 2)
    (tmp_path / "a.hdr").write_text(PLAIN.replace("lines = 3", "lines = 1000000000000"))
    source = open_cube_source(tmp_path / "a.hdr")
    assert (source.shape[0], source.lost_lines) == (3, 0)
    assert any("999999999997 lines that a.bin lacks are not filled up" in note for note in source.notes)


def test_one_band_with_any_number_of_lines(tmp_path: Path) -> None:
    """With one band the distance between bands counts for nothing, however many lines are promised."""
    text = PLAIN.replace("bil", "bsq").replace("bands = 2", "bands = 1").replace("lines = 3", f"lines = {10**26}")
    (tmp_path / "a.hdr").write_text(text)
    (tmp_path / "a.bin").write_bytes(bytes(48))
    assert open_cube_source(tmp_path / "a.hdr").shape == (6, 4, 1)


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
def test_texts_that_would_keep_a_reader_busy(made: str) -> None:
    """Text made to be searched again and again is read once or refused; a quadratic search would take hours."""
    try:
        parse_envi_header(PLAIN + made)
    except SceneError as error:
        assert "more braces than it closes" in str(error)  # noqa: PT017 - either end is well


def test_headers_that_are_too_long(tmp_path: Path) -> None:
    """A file far longer than any header is refused by its size."""
    (tmp_path / "a.hdr").write_bytes(b"ENVI\n" + b" " * LARGEST_HEADER)
    (tmp_path / "a.bin").write_bytes(bytes(48))
    with pytest.raises(SceneError, match="too many for a header"):
        open_cube_source(tmp_path / "a.hdr")


pytest.importorskip("tifffile")


@pytest.mark.filterwarnings("ignore::Warning")  # decoders may warn of what they then refuse
def test_mutated_files_end_well() -> None:
    """Each file gives a cube or one clear error, soon, in memory bounded by its size."""
    found = try_files(18 * len(FORMATS), seed=7)
    assert [line for tally in found.values() for line in tally.wrong] == []
    assert min(tally.read + tally.refused for tally in found.values()) == 18
    assert sum(tally.refused for tally in found.values()) > 40
    assert sum(tally.read for tally in found.values()) > 40

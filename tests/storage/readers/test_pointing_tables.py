"""Pointing tables of every kind give mirror positions; each fault of a table has its own message."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.mirror import REST_TANGENT, Mounting, direction_to_scene, position_to_direction
from spectralzoom.storage.readers.pointing_tables import find_pointing, load_pointing

MIRROR = "line,time,mirror_x,mirror_y\n0,0.05,0.1,0\n1,0.15,0.2,0\n2,0.25,0.3,0\n"


def _table(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_mirror_positions_are_read_from_any_layout(tmp_path: Path) -> None:
    """Delimiter, capitals, byte order mark, blank rows and order of rows do not matter."""
    rows = MIRROR.splitlines()
    swapped = "\ufeff" + "\n".join([rows[0].upper(), rows[3], "", rows[1], rows[2]]).replace(",", ";")
    for text in (MIRROR, swapped, MIRROR.replace(",", "\t")):
        found = load_pointing(_table(tmp_path, text), "c", 3)
        np.testing.assert_array_equal(found.position, [[0.1, 0], [0.2, 0], [0.3, 0]])
        np.testing.assert_array_equal(found.time_s, [0.05, 0.15, 0.25])
        assert (found.valid.all(), found.exposure_ms, found.part) == (True, None, None)


def test_positions_are_read_bit_by_bit(tmp_path: Path) -> None:
    """A float64 written by repr is read as the same float64."""
    values = np.random.default_rng(1).uniform(-0.5, 0.5, (200, 2))
    text = "mirror_x,mirror_y\n" + "".join(f"{x!r},{y!r}\n" for x, y in values.tolist())
    np.testing.assert_array_equal(load_pointing(_table(tmp_path, text), "c", 200).position, values)


def test_positions_of_a_device_are_those_of_its_mounting(tmp_path: Path) -> None:
    """A mirror whose X is the model's Y, turned by 2 degrees, gives the model's positions."""
    mounting = Mounting("y,-x", 2.0, 0.01, -0.02)
    given = np.array([[0.1, 0.2], [0.0, 0.3]])
    rows = "".join(f"{x!r},{y!r}\n" for x, y in mounting.to_device(given).tolist())
    table = _table(tmp_path, "mirror_x,mirror_y\n" + rows)
    np.testing.assert_allclose(load_pointing(table, "c", 2, mounting).position, given, atol=1e-12)


def test_angles_are_converted_to_positions(tmp_path: Path) -> None:
    """Two angles give that viewing direction; a single angle is along the scan."""
    two = load_pointing(_table(tmp_path, "angle_x_deg,angle_y_deg\n5,-10\n5,10\n"), "c", 2)
    seen = np.rad2deg(np.arctan(direction_to_scene(position_to_direction(two.position))))
    np.testing.assert_allclose(seen, [[5, -10], [5, 10]], atol=1e-10)
    one = load_pointing(_table(tmp_path, "angle_deg\n-10\n20\n"), "c", 2)
    expected = -np.tan(np.deg2rad([-10, 20])) / REST_TANGENT
    np.testing.assert_allclose(one.position, np.stack([expected, [0, 0]], axis=-1), atol=1e-12)


@pytest.mark.parametrize("line", [",,,0,", "99,-99,0,0,-1"])
def test_invalid_lines_need_no_numbers(tmp_path: Path, line: str) -> None:
    """Positions and exposures of invalid lines are interpolated from their neighbours; their times are NaN."""
    text = f"mirror_x,mirror_y,time,valid,exposure_ms\n0.1,0,0.1,1,5\n{line}\n0.3,0.2,0.3,1,7\n"
    found = load_pointing(_table(tmp_path, text), "c", 3)
    np.testing.assert_allclose(found.position, [[0.1, 0], [0.2, 0.1], [0.3, 0.2]])
    assert found.valid.tolist() == [True, False, True]
    np.testing.assert_array_equal(found.time_s, [0.1, np.nan, 0.3])
    np.testing.assert_array_equal(found.exposure_ms, [5, 6, 7])


def test_a_table_describes_several_cubes_or_sweeps(tmp_path: Path) -> None:
    """Rows belong to the cube that they name; for a single cube of another name they name its sweeps."""
    table = _table(tmp_path, "sweep,position_px,time\na,0,0\na,1,1\nb,5,0\nb,4,1\nb,3,2\n")
    assert load_pointing(table, "a", 2).position[:, 0].tolist() == [0, 1]
    assert load_pointing(table, "b", 3).position[:, 0].tolist() == [5, 4, 3]
    assert load_pointing(table, "whole", 5, alone=True).part == ("a", "a", "b", "b", "b")
    assert load_pointing(table, "a", 2, alone=True).part is None
    with pytest.raises(SceneError, match="has no row for the cube 'c'; its column 'sweep' names a, b"):
        load_pointing(table, "c", 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot be read as a pointing table: No columns to parse from file"),
        ("mirror_x,mirror_y\n", "has no row below its header"),
        (
            "mirror_x,mirror_y,roll\n0,0,0\n",
            "has the column 'roll', unknown or twice; give a row for each line, with columns of line, sweep",
        ),
        ("mirror_x,mirror_x\n0,0\n", "has the column 'mirror_x', unknown or twice"),
        ("mirror_x\n0\n", "one kind of pointing, but mirror_y is missing"),
        ("time\n0\n", "one kind of pointing, but it has none"),
        ("angle_deg,position_m\n0,0\n", "one kind of pointing, but it has 2 kinds"),
        ("angle_deg\n\nten\n", "row 3: angle_deg = 'ten' is no number"),
        ("angle_deg;time\n1,5;0\n", r"row 2: angle_deg = '1,5' is no number; write numbers with a decimal point"),
        ("angle_deg,time\n1\n2,3\n3,4\n", "row 2: time = nan, expected a number"),
        ("angle_deg\n0\n1,5\n", "cannot be read as a pointing table: expected 1 fields in line 3, saw 2; name"),
        ("angle_deg\n0\n1\n", "has 2 rows for cube, fewer than its 3 lines"),
        ("angle_deg\n0\n1\n2\n3\n", "has 4 rows for cube, more than its 3 lines"),
        (
            "mirror_x,mirror_y\n0,0\n0.9,0.9\n1,1\n",
            "row 3: mirror_x = 0.9, mirror_y = 0.9 (the first of 2 such rows), beyond the mirror, which reaches "
            "X^2 + Y^2 <= 1; correct the table",
        ),
        (
            "angle_deg\n0\n20\n51\n",
            "row 4: angle_deg = 51, beyond the mirror, which turns the view by up to 50 deg along the scan",
        ),
        (
            "angle_deg,time\n0,0\n1,0.2\n2,0.2\n",
            "row 4: time = 0.2, expected a time after that of the line before [s]; correct the table",
        ),
        (
            "angle_deg\n0\nnan\n2\n",
            "1 of 3 lines cannot be used, more than a tenth: row 3: angle_deg = nan, expected a",
        ),
        ("angle_deg,time\n0,0\n1,\n2,1\n", "row 3: time = nan, expected a number"),
        ("angle_deg,exposure_ms\n0,1\n1,0\n2,1\n", "row 3: exposure_ms = 0, expected a time above 0 ms"),
        ("angle_deg,valid\n0,1\n1,2\n2,1\n", "row 3: valid = 2, expected 0 or 1"),
        ("angle_deg,valid\n0,0\n1,0\n2,0\n", "calls no line of cube valid"),
        ("angle_deg,line\n0,0\n\n1,2\n2,2\n", "row 4: line = 2, expected each of 0 to 2 once"),
    ],
)
def test_unusable_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    """Columns, cells, numbers of rows, range, order and unknown values are checked; the first wrong row is named."""
    with pytest.raises(SceneError, match=re.escape(message)):
        load_pointing(_table(tmp_path, text), "cube", 3)


@pytest.mark.parametrize(
    ("header", "good", "bad", "why"),
    [
        (
            "angle_deg,exposure_ms",
            "0.1,10",
            "0.1,0",
            "row 9: exposure_ms = 0 (the first of 2 such rows), expected a time",
        ),
        ("angle_deg,exposure_ms", "0.1,10", "0.1,-3", "exposure_ms = -3"),
        ("angle_deg,exposure_ms", "0.1,10", "0.1,", "exposure_ms = nan"),
        ("angle_deg,exposure_ms", "0.1,10", "0.1,10000", "exposure_ms = 10000"),
        ("angle_deg,exposure_ms", "0.1,10", "0.1,inf", "exposure_ms = inf"),
        (
            "mirror_x,mirror_y",
            "0.5,0.1",
            "0.8,0.8",
            "row 9: mirror_x = 0.8, mirror_y = 0.8 (the first of 2 such rows), bey",
        ),
        (
            "mirror_x,mirror_y",
            "0.5,0.1",
            ",0.1",
            "mirror_x = nan, mirror_y = 0.1 (the first of 2 such rows), expected a num",
        ),
        ("angle_x_deg,angle_y_deg", "1,2", "1,88", "angle_y_deg = 88"),
        ("position_px", "7", "nan", "position_px = nan"),
    ],
)
def test_lines_that_cannot_be_are_left_out_up_to_a_tenth(
    tmp_path: Path, header: str, good: str, bad: str, why: str
) -> None:
    """They are named by their first row, and have the position and exposure of their neighbours."""
    rows = [good] * 30
    rows[7] = rows[20] = bad
    found = load_pointing(_table(tmp_path, "\n".join([header, *rows])), "c", 30)
    assert np.flatnonzero(~found.valid).tolist() == [7, 20]
    assert np.isfinite(found.position).all()
    np.testing.assert_allclose(found.position, found.position[:1].repeat(30, axis=0))
    assert found.exposure_ms is None or (found.exposure_ms == 10).all()
    (note,) = found.notes
    assert "2 of 30 lines are left out: row 9: " in note
    assert why in note
    rows[1] = rows[2] = bad
    with pytest.raises(
        SceneError, match=r"4 of 30 lines cannot be used, more than a tenth: row 3: .*; correct the table"
    ):
        load_pointing(_table(tmp_path, "\n".join([header, *rows])), "c", 30)


def test_exposures_of_lines_may_differ(tmp_path: Path) -> None:
    """Those of 1 ms among 10 ms are exposures."""
    rows = ["0.1,10"] * 30
    rows[7] = "0.1,1"
    found = load_pointing(_table(tmp_path, "\n".join(["angle_deg,exposure_ms", *rows])), "c", 30)
    assert found.valid.all()
    assert found.exposure_ms is not None
    assert found.exposure_ms[7] == 1


def test_pointing_is_found_by_the_cubes_name(tmp_path: Path) -> None:
    """Only ``NAME.pointing`` with one of the endings is used; other tables are ignored."""
    _table(tmp_path, "soil,wet\n1,2\n", "cube.csv")
    assert find_pointing(tmp_path, "cube") is None
    path = _table(tmp_path, MIRROR, "cube.pointing.csv")
    assert find_pointing(tmp_path, "cube") == path

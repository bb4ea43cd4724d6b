"""Ties: a grid's lookup within the bound that the table states, and nothing lost at the sweep's border."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.rectify.lookup import track_lookup
from pipeline.rectify.placed import tie_table
from pipeline.rectify.tracks import Track, make_tracks
from tests.pipeline.rectify.aiming import CAMERA, aim

GRID: dict[str, Any] = {"origin_px": (-20.0, 2250.0), "spacing_px": 1.0, "shape": (170, 700)}
EVERYTHING = (slice(None), slice(None))


def track_of(along_px: np.ndarray | float, scan_px: np.ndarray) -> Track:
    """The one track of lines that look at points given in px along the line and the scan."""
    (track,) = make_tracks(aim(along_px, scan_px), CAMERA)
    return track


def exact(track: Track, along: str = "x", **grid: Any) -> np.ndarray:
    """The grid's coordinates looked up one by one."""
    grid = GRID | grid
    y, x = (grid["origin_px"][axis] + grid["spacing_px"] * np.arange(grid["shape"][axis]) for axis in (0, 1))
    points = np.stack(np.broadcast_arrays(y[:, None], x[None, :]), axis=-1)
    return track_lookup(track, CAMERA, points, along=along)  # type: ignore[arg-type]


LINES = np.arange(130.0)
PATHS = {
    "even": (2600.0, LINES),
    "drifting": (2600 + 0.02 * LINES, 1.0007 * LINES),
    "faster and faster": (2600.0, LINES + 2e-4 * LINES**2),
    "curved": (2600 + 5 * np.sin(LINES / 60), LINES),
    "one line out of place": (2600.0, LINES + 0.01 * (LINES == 71)),
    "jittered": (2600 + np.sin(7 * LINES**2) / 4, LINES + np.sin(5 * LINES**2) / 4),
}


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("tie", [16, 7])
def test_error_is_within_the_bound(name: str, tie: int) -> None:
    """On every kind of path no pixel is farther from the exact lookup than the bound, nor that from the tolerance."""
    track = track_of(*PATHS[name])
    table = tie_table(track, CAMERA, along="x", tie=tie, **GRID)
    error = np.abs(table.coordinates(*EVERYTHING) - exact(track))
    assert np.nanmax(error) <= table.bound_px + 1e-12 <= 2e-3
    assert np.isfinite(error).mean() > 0.4


def test_spacing_follows_the_path() -> None:
    """Ties stay 16 px apart on even and drifting paths, and come down to every pixel where one line is out of place."""
    spacing = {name: tie_table(track_of(*path), CAMERA, along="x", **GRID).spacing for name, path in PATHS.items()}
    assert spacing["even"] == spacing["drifting"] == 16
    assert spacing["one line out of place"] == spacing["jittered"] == 1
    assert 1 < spacing["faster and faster"] < 16


@given(st.floats(-4500, 4500), st.floats(-4500, 4000), st.sampled_from(["x", "y"]), st.sampled_from([1.0, 3.0]))
@settings(max_examples=25, deadline=None)
def test_bound_holds_over_the_field(strip: float, start: float, along: str, spacing: float) -> None:
    """Anywhere in the field, in both orientations, the table keeps to its bound, and loses no pixel well inside."""
    track = track_of(strip, start + LINES)
    corner = (start - 9.3, strip - 330.7) if along == "x" else (strip - 330.7, start - 9.3)
    size = (int(150 / spacing), int(660 / spacing))
    grid = {"origin_px": corner, "spacing_px": spacing, "shape": size if along == "x" else size[::-1]}
    table = tie_table(track, CAMERA, along=along, **grid)  # type: ignore[arg-type]
    found, truth = table.coordinates(*EVERYTHING), exact(track, along, **grid)
    assert np.nanmax(np.abs(found - truth), initial=0) <= table.bound_px + 1e-12 <= 2e-3
    inside = (np.abs(truth - [64.5, 319.5]) < np.array([65, 320]) - 0.01).all(axis=-1)
    assert np.isfinite(found[inside]).all()


@pytest.mark.parametrize("tie", [16, 1])
def test_parts_are_those_of_the_whole(tie: int) -> None:
    """Any part of the grid is, bit by bit, what the whole grid gives there; empty parts are empty."""
    table = tie_table(track_of(*PATHS["even"]), CAMERA, along="x", tie=tie, **GRID)
    whole = table.coordinates(*EVERYTHING)
    for rows, columns in (
        (slice(0, 1), slice(0, 1)),
        (slice(31, 33), slice(15, 700)),
        (slice(169, 170), slice(64, 81)),
    ):
        np.testing.assert_array_equal(table.coordinates(rows, columns), whole[rows, columns])
    assert table.coordinates(slice(5, 5), slice(0, 9)).shape == (0, 9, 2)


def test_part_is_no_view_of_the_table() -> None:
    """Writing to coordinates leaves the table as it is."""
    table = tie_table(track_of(*PATHS["jittered"]), CAMERA, along="x", **GRID)
    before = table.ties.copy()
    table.coordinates(*EVERYTHING)[:] = 0
    np.testing.assert_array_equal(table.ties, before)


def test_knots_that_nothing_saw_are_left_out() -> None:
    """Around lost lines the table is NaN where the lookup is."""
    track = track_of(2600.0, LINES[(LINES < 40) | (LINES > 44)])
    table = tie_table(track, CAMERA, along="x", **GRID)
    assert table.spacing == 16
    differs = np.isnan(table.coordinates(*EVERYTHING)) != np.isnan(exact(track))
    assert differs.mean() < 1e-4


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (0, 5), (5, 0), (17, 16)])
def test_grids_of_any_size(shape: tuple[int, int]) -> None:
    """One pixel, one row, none at all: the table answers with the grid's shape."""
    track = track_of(*PATHS["even"])
    grid = GRID | {"origin_px": (30.0, 2600.0), "shape": shape}
    found = tie_table(track, CAMERA, along="x", **grid).coordinates(*EVERYTHING)
    np.testing.assert_allclose(found, exact(track, **grid), atol=2e-3)


def test_track_smaller_than_a_cell_is_not_lost() -> None:
    """A single line between two rows of ties is found, and its cells count for the bound."""
    track = track_of(2600.0, np.array([24.0]))
    table = tie_table(track, CAMERA, along="x", **GRID)
    found = table.coordinates(*EVERYTHING)
    assert np.isfinite(found[..., 0]).sum() > 450
    assert np.nanmax(np.abs(found - exact(track))) <= table.bound_px


@pytest.mark.parametrize("tie", [16, 1])
def test_only_what_the_track_can_have_seen_is_kept(tie: int) -> None:
    """Of a large grid the table keeps the part around the track, and answers for the rest with NaN."""
    track = track_of(*PATHS["even"])
    grid = GRID | {"origin_px": (-400.0, 1900.0), "shape": (1000, 1500)}
    table = tie_table(track, CAMERA, along="x", tie=tie, **grid)
    assert table.kept[0] * table.kept[1] < 0.25 * 1000 * 1500
    truth = exact(track, **grid)
    for rows, columns in (EVERYTHING, (slice(0, 90), slice(0, 80)), (slice(300, 320), slice(0, 1500))):
        np.testing.assert_allclose(table.coordinates(rows, columns), truth[rows, columns], atol=2e-3)


def test_settings_are_checked() -> None:
    """Ties less than a pixel apart and a tolerance below 0 are refused; at tolerance 0 every pixel is a tie."""
    track = track_of(*PATHS["even"])
    for wrong in ({"tie": 0}, {"tolerance_px": -1.0}, {"tolerance_px": np.nan}):
        with pytest.raises(SettingsError, match="ties at least 1 px apart and a tolerance from 0"):
            tie_table(track, CAMERA, along="x", **GRID, **wrong)
    table = tie_table(track, CAMERA, along="x", tolerance_px=0.0, **GRID)
    np.testing.assert_array_equal(table.coordinates(*EVERYTHING), exact(track))

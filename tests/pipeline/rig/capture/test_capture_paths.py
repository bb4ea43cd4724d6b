"""Names of captures, and lines of their frames: dropped frames and contradicted captures do not count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.frame_indices import LineTimes
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.rig import capture_paths
from spectralzoom.pipeline.rig.camera.camera_cubes import CapturedLines
from tests.pipeline.rig.small_rig import CAMERA, COARSE, FINE


def test_the_prefix_of_a_sweep_is_readable() -> None:
    """Short numbers appear unchanged, with p for the decimal point."""
    sweep = Sweep("coarse-0", "coarse", "y", -31.5, 0.5, 96, 16, 16)
    assert capture_paths.capture_prefix(sweep) == "coarse-0_coarse_y_-31p5_0p5_96_16_16_0_0"


def test_a_sweep_is_recovered_from_its_prefix() -> None:
    """The numbers are equal to the last bit, from any first line, and the name is valid for cameras."""
    rng = np.random.default_rng(0)
    for number in range(300):
        odd = rng.normal(size=2) * 10.0 ** rng.integers(-9, 9, 2)
        swath, start = (float(rng.choice([one, -0.5, -0.0, 7.0, 1e300])) for one in odd)
        turned = Sweep(f"fine-{number:03d}", "fine", "y", swath, start, int(rng.integers(1, 3000)), 4, 4)
        sweep = turned if number % 2 else replace(turned, kind="coarse", along="x")
        told = (sweep, int(rng.integers(sweep.lines)))
        prefix = capture_paths.capture_prefix(*told)
        assert capture_paths.announced(prefix) == told
        assert str(capture_paths.announced(prefix)) == str(told)  # the sign of zero


@pytest.mark.parametrize(
    "prefix",
    ["", "field", capture_paths.REFERENCES]
    + [f"a_coarse_{rest}" for rest in ("x_0_0_0_1_1_0_0", "x_0_0_5_1_1_0_5", "z_0_0_5_1_1_0_0", "x_0_0_5_1_0_0")],
)
def test_other_prefixes_announce_nothing(prefix: str) -> None:
    """Prefixes that others chose, and those of impossible sweeps, give no sweep."""
    assert capture_paths.announced(prefix) is None


@pytest.mark.parametrize("name", ["a b", "é", "x" * 120])
def test_names_invalid_for_a_folder_are_refused(name: str) -> None:
    """The error is raised before anything is sent."""
    with pytest.raises(SettingsError, match="letters, digits"):
        capture_paths.capture_prefix(Sweep(name, "fine", "x", 0.0, 0.0, 5))


PATH = capture_paths.next_path(FINE, 3, CAMERA, vector_pairs=6)  # lines 3 to 9
TAKEN = capture_paths.CaptureRecord(FINE, 3, 9, "/captured/x", (0.1, 0.2), (0.1, 0.2))


def frames(numbers: list[int], first: int = 0) -> CapturedLines:
    """Return a capture with these frame numbers of the index."""
    told = np.array(numbers, np.int64)
    times = LineTimes(told, np.where(told >= 0, 10**15 + told * 100_000, -1))
    return CapturedLines(np.zeros((len(told), 48, 3), np.uint16), first, times)


@pytest.mark.parametrize(
    ("seen", "row"),
    [
        (frames([0, 1, 3, 4, 5]), [0, 1, -1, 2, 3, 4]),
        (frames([70, 71, 72, 73, 74, 75], first=70), [0, 1, 2, 3, 4, 5]),
        (frames([0, 1, 2, 3]), [0, 1, 2, 3]),
    ],
    ids=["frame 2 dropped", "counted from 70", "two lost at the end"],
)
def test_rows_are_assigned_to_lines_by_frame_number(seen: CapturedLines, row: list[int]):
    """Numbers count from the capture's first frame. Lines that the cube lacks are left out."""
    located = capture_paths.locate_lines(seen, PATH, TAKEN, CAMERA)
    there = np.array(row) >= 0
    assert located.row.tolist() == row
    assert [located.is_valid(line) for line in range(len(row))] == there.tolist()
    np.testing.assert_array_equal(located.positions.position, PATH.middle[: len(row)][there].astype(np.float64))


def test_a_complete_capture_without_an_index_is_in_order():
    """As many rows as lines are unambiguous; fewer rows are refused."""
    assert capture_paths.locate_lines(frames([-1] * 6), PATH, TAKEN, CAMERA).row.tolist() == list(range(6))
    with pytest.raises(capture_paths.UnusableCaptureError, match="fetch frameIndex"):
        capture_paths.locate_lines(frames([-1] * 5), PATH, TAKEN, CAMERA)
    with pytest.raises(capture_paths.UnusableCaptureError, match="has no number of the 6 frames"):
        capture_paths.locate_lines(frames(list(range(1000, 1006))), PATH, TAKEN, CAMERA)


def test_paths_contain_whole_lines():
    """The held positions of a line stay together."""
    path = capture_paths.next_path(COARSE, 2, CAMERA, vector_pairs=11)
    assert (path.first, path.stop, path.cells.shape) == (2, 4, (8, 2))
    assert path.rate_hz == 40.0
    with pytest.raises(SettingsError, match=r"memory 3 pairs; give cost\.vector_pairs of at least 4"):
        capture_paths.next_path(COARSE, 2, CAMERA, vector_pairs=3)

"""The source that how-to/own-source.md builds resumes, and reports a program that does not run."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.geometry.scan import sweep_positions
from spectralzoom.pipeline.source import Source
from tests.docs.pages import DOCS, blocks_of
from tests.pipeline.rig.small_rig import CAMERA, COARSE


@pytest.fixture(scope="module")
def names() -> dict[str, Any]:
    """Return the names of the page's first block."""
    found: dict[str, Any] = {"__name__": "page"}
    block = next(one for one in blocks_of(DOCS / "how-to" / "own-source.md") if "class FolderSource" in one.text)
    exec(compile(block.text, "page", "exec", dont_inherit=True), found)
    return found


@pytest.fixture
def source(names: dict[str, Any], tmp_path: Path) -> Iterator[Source]:
    """Return the opened source of a folder with frames and the first five lines of a sweep, which waits for no file."""
    into = tmp_path / "visit" / COARSE.name
    into.mkdir(parents=True)
    for name, value in {"dark": 5.0, "white": 9.0, **{str(number): number for number in range(5)}}.items():
        np.save(into / f"{name}.npy", np.full((48, 3), value, np.float64 if name.isalpha() else np.uint16))
    with names["FolderSource"](tmp_path / "visit", CAMERA, within_s=0.0).opened(tmp_path) as opened:
        yield opened


def test_a_request_has_the_positions_that_each_line_holds(source: Source, tmp_path: Path) -> None:
    """Four rows a line, with the exposure; a second process leaves it as it is."""
    references = source.references(COARSE)
    assert (references.dark[0, 0], references.white[0, 0]) == (5, 9)
    request = tmp_path / "visit" / "coarse-0.csv"
    rows = np.loadtxt(request, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(rows[:, 0], np.repeat(np.arange(10), 4))
    np.testing.assert_allclose(rows[:, 1:3], sweep_positions(COARSE, CAMERA).reshape(-1, 2), atol=1e-8)
    assert set(rows[:, 3]) == {CAMERA.exposure_ms}
    request.write_text("taken")
    source.references(COARSE)
    assert request.read_text() == "taken"


def test_lines_that_do_not_come_end_in_one_message(source: Source) -> None:
    """Earlier lines are given, also to a process that resumes amid them; the message names the file that is missing."""
    lines = source.lines(COARSE, 2)
    assert [(line.number, line.data[0, 0]) for line in islice(lines, 3)] == [(2, 2), (3, 3), (4, 4)]
    with pytest.raises(RigError, match=r"coarse-0/5.npy did not come in 0 s; start the camera's program, then run"):
        next(lines)

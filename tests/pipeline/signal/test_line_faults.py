"""Lines that cannot be are found, and noise, shade and a drift of the dark level are not called so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.signal.line_faults import DarkLevel, LineJudge, wild_exposures
from spectralzoom.pipeline.source import Line, References

SHAPE = (40, 30)  # sample, band


def lines(level: float, sigma: float, count: int = 20) -> NDArray[np.uint16]:
    """Return raw lines of noise around a level."""
    return np.clip(np.rint(np.random.default_rng(1).normal(level, sigma, (count, *SHAPE))), 0, 65535).astype(np.uint16)


def darker_than_dark(raw: NDArray[np.uint16], dark: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return (line,) whether lines are darker than a dark frame, one element of which is not known."""
    dark[0, 0] = np.nan
    return np.array([DarkLevel(dark).is_above(line) for line in raw])


@pytest.mark.parametrize(
    ("dark", "level", "sigma"),
    [(64, 64, 5), (64, 56, 4), (25, 25, 2), (10, 10, 3), (0, 0.4, 1), (3, 3, 3), (1000, 800, 30), (64, 2000, 40)],
)
def test_dark_lines_are_lines(dark: float, level: float, sigma: float) -> None:
    """Without light, with noise or a dark level that has drifted, a line stays."""
    assert not darker_than_dark(lines(level, sigma), np.full(SHAPE, dark, np.float32)).any()


@pytest.mark.parametrize(("dark", "level"), [(64, 0), (64, 30), (20, 0), (9, 0), (3, 0), (0, 0), (1000, 600)])
def test_lines_below_dark_are_found(dark: float, level: float) -> None:
    """Dropped frames hold 0, or numbers far below the dark level."""
    raw = lines(dark + 500, 3)
    raw[[4, 11]] = level
    found = darker_than_dark(raw, np.full(SHAPE, dark, np.float32))
    assert np.flatnonzero(found).tolist() == [4, 11]


def test_a_line_that_ends_early_is_found() -> None:
    """A third of its samples hold 0. Unlit bands, below the dark level by a drift, are no fault."""
    raw = lines(900, 3)
    raw[:, :, :12] = 40
    raw[6, 26:] = 0
    assert np.flatnonzero(darker_than_dark(raw, np.full(SHAPE, 64, np.float32))).tolist() == [6]


def test_wild_exposures() -> None:
    """0, negative, unknown and a hundred times the median cannot be; a tenth of it can."""
    ms = np.array([10, 10, 10, 0, -1, np.nan, np.inf, 1000, 0.1, 1, 99.0])
    assert np.flatnonzero(wild_exposures(ms, np.ones(11, np.bool_))).tolist() == [3, 4, 5, 6, 7, 8]
    assert wild_exposures(np.zeros(3), np.ones(3, np.bool_)).all()


def test_lines_of_a_source_are_judged_as_they_arrive() -> None:
    """Faults are counted by kind; a fault leaves neither a wild exposure nor a position beyond the mirror."""
    frame = np.full(SHAPE, 64, np.float32)
    judge = LineJudge(References(frame, frame + 900, np.ones(SHAPE[1], np.float32)), 10.0)
    good = Line(0, lines(500, 3, 1)[0], 0.1, 0.2, 0.0, 10.0)
    bad = [replace(good, number=1, exposure_ms=np.nan), replace(good, number=2, mirror_x=0.99)]
    bad += [replace(good, number=3, data=good.data * 0), replace(good, number=4, exposure_ms=0.0)]
    assert judge.judged(good) is good
    assert judge.judged(replace(good, valid=False, exposure_ms=0.0)).valid is False  # not counted again
    found = [judge.judged(line) for line in bad]
    assert not any(line.valid for line in found)
    assert [line.exposure_ms for line in found] == [10.0] * 4
    assert np.isnan(found[1].mirror_x)
    (note,) = judge.notes("sweep a", 40)
    expected = (
        "2 without a possible exposure (the first is line 1); 1 beyond the mirror or without a position (the first"
    )
    assert f"sweep a: 4 of 40 lines are left out: {expected}" in note
    with pytest.raises(SceneError, match="sweep a: 4 of 39 lines cannot be used, more than a tenth: 2 without"):
        judge.notes("sweep a", 39)

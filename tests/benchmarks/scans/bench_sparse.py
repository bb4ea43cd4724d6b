"""Lands of which little is of interest: the plain scan that a survey takes, beside the best of those tried.

One block of a farm where its classes are mixed most, a sixteenth or an eighth of the land, and one field around it.
Scans that take much less than the seconds are not tried. What each map says of itself stands beside what it scores.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial

from bench_frontier import CAMERA, EXPOSURES_MS, SHAPE, SLACK, STEPS, chosen_scan, map_of, seconds_of
from measure import Row
from sparse_lands import sparse_land

from pipeline.planning.plain_scans import scan_words

LANDS, SECONDS = (21, 22, 23, 24, 25, 26), (5.0, 8.0)
BLOCKS = ((128, 160), (192, 208))  # px of a land's block: a sixteenth and an eighth of it
TRIED = 0.4  # of the seconds: scans that take less are not tried


def rows() -> list[Row]:
    """A row for each land and budget, and the worst of them."""
    return list(_rows())


def _rows() -> Iterator[Row]:
    """The scan that a survey takes of each land, beside the best of those tried."""
    worst = 0.0
    for number, seed in enumerate(LANDS):
        scene, _ = sparse_land(seed, SHAPE, BLOCKS[number % 2], CAMERA)
        drawn = cache(partial(map_of, scene, seed))
        for seconds in SECONDS:
            scan = chosen_scan(SHAPE, seconds)
            tried = {
                scan_words(step, exposure_ms): drawn(step, exposure_ms).miou
                for step in STEPS
                for exposure_ms in EXPOSURES_MS
                if TRIED * seconds <= seconds_of(step, exposure_ms) <= seconds
            }
            best, by = max((accuracy, said) for said, accuracy in tried.items())
            own = drawn(scan.step, scan.exposure_ms)
            worst = max(worst, best - own.miou)
            told = f"{own.miou:.1f} mIoU, expected {own.expected:.1f} ± {own.error:.1f}"
            goal = f">= {best - SLACK:.1f}, {by}, best of {len(tried)}, less {SLACK:g}"
            yield Row(f"land {seed}, --seconds {seconds:g}: {scan.words}", told, goal, own.miou >= best - SLACK)
    yield Row(
        "most that a survey's scan lies below the best one tried", f"{worst:.2f}", f"<= {SLACK:g}", worst <= SLACK
    )

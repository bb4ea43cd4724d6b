"""What was left out, measured on chips: right bounds pass, wrong ones are named; what arithmetic alone may change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.errors import BoundError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, sweep_to_scene
from pipeline.simulator.effects.blurs import ABERRATION, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.effect import Effect, Radiance, SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR
from pipeline.simulator.optics.kernel_fit import NEGLIGIBLE
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.selection.choice import TOTAL, Decision, decide
from pipeline.simulator.selection.verification import (
    KERNELS,
    MOST_CANDIDATES,
    Floats,
    candidate_blocks,
    misplaced_fraction,
    verify,
    worst_blocks,
)
from pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.made_up_effects import RIG, SWEEP, Brightening, MadeUp, even_probe
from tests.pipeline.simulator.small_scenes import image_scene

BLOCK = SweepBlock(RIG, SWEEP, range(20, 28), np.array([500.0, 600.0]), (200, 700))
CHIPS = {"steepest": BLOCK, "brightest": replace(BLOCK, lines=range(40, 44))}


def render(block: SweepBlock, chosen: Mapping[Effect, str]) -> Radiance:
    """Light of 100 e-, brighter from line 40 on, times all gains."""
    light = np.full((len(block.lines), block.rig.camera.samples, 2), 100.0, np.float32)
    light[block.numbers >= 40] += 20
    for effect, variant in chosen.items():
        if hasattr(effect, "gain"):
            light = light * effect.gain(block, variant)
    return light


def units(light: Radiance, binning: int) -> Floats:
    """100 e- are one unit."""
    return np.full(light.shape, 100.0)


def decided(*effects: MadeUp, tolerance: float = 1.0, asked: str = "auto") -> Decision:
    """Off where the tolerance lets it be."""
    return decide(even_probe(level=np.full(1, 1.2)), RIG, effects, tolerance, asked)


def test_measured_changes_are_those_of_each_effect_and_of_all():
    """Gains of 1 % and 2 % on light of 1.2 units; what is on or of the readout is not measured."""
    effects = Brightening("drift", 0.01, fraction=0.01), Brightening("cloud", 0.02, fraction=0.02)
    on, read = Brightening("vignetting", 3.0, fraction=0.5), MadeUp("read", 0.1)
    measured = verify(decided(*effects, on, read), render, CHIPS, units, 0.0)
    assert measured == pytest.approx(
        {"drift": 1.2 * 1.02 * 1.5 * 0.01, "cloud": 1.2 * 1.01 * 1.5 * 0.02, TOTAL: 1.2 * 1.5 * (1.01 * 1.02 - 1)},
        rel=1e-4,
    )


def test_nothing_on_is_measured_as_a_whole():
    """Where everything is left out by hand, no effect is measured beside the others; together they are."""
    effects = Brightening("drift", 0.01, fraction=0.01), Brightening("cloud", 0.02, fraction=0.02)
    measured = verify(decided(*effects, asked="none"), render, CHIPS, units, 0.0)
    assert measured == pytest.approx({TOTAL: 1.2 * (1.01 * 1.02 - 1)}, rel=1e-4)


def test_broken_bound_is_named_with_its_place():
    """Effect, change, bound, place and what to do."""
    decision = decided(Brightening("drift", 0.01, fraction=0.1))
    said = (
        r"drift: .* changes light by 0\.12 sigma of the noise at sweep fine-0, line 40, sample 0, band 0 of the "
        r"brightest lines, above its bound of 0\.0145.*--tol 0 or"
    )
    with pytest.raises(BoundError, match=said):
        verify(decision, render, CHIPS, units, 0.0)


def test_light_that_is_no_number_breaks_every_bound():
    """NaN is not less than a bound."""

    def broken(block: SweepBlock, chosen: Mapping[Effect, str]) -> Radiance:
        shape = len(block.lines), block.rig.camera.samples, 2
        return render(block, chosen) if chosen else np.full(shape, np.nan, np.float32)

    with pytest.raises(BoundError, match="changes light by nan"):
        verify(decided(Brightening("drift", 0.01, fraction=0.01)), broken, CHIPS, units, 0.0)


def test_what_hardly_changes_anything_is_measured_with_the_others_alone():
    """An effect bounded by less than a thousandth of a unit has no figure of its own, and counts in that of all."""
    effects = Brightening("drift", 1e-4, fraction=1e-4), Brightening("cloud", 0.02, fraction=0.02)
    measured = verify(decided(*effects), render, CHIPS, units, 0.0)
    assert measured.keys() == {"cloud", TOTAL}
    assert measured[TOTAL] == pytest.approx(1.2 * (1.0001 * 1.02 - 1), rel=1e-3)


def test_sums_are_held_against_the_bound_as_they_are_stored():
    """An error that 4 samples share is twice as many sigmas of their sum: one that a sample alone would hide."""
    coarse = replace(BLOCK, sweep=replace(SWEEP, binning=4))
    shared = Brightening("drift", 0.01, fraction=0.01)

    def noise(light: Radiance, binning: int) -> Floats:
        return np.full(light.shape, 100.0 / np.sqrt(binning))

    assert verify(decided(shared), render, {"steepest": BLOCK}, noise, 0.0)["drift"] == pytest.approx(0.01, rel=1e-3)
    said = r"light by 0\.02 sigma .* sample 0 \(of 4 summed\), band 0 of the steepest lines"
    with pytest.raises(BoundError, match=said):
        verify(decided(shared), render, {"steepest": coarse}, noise, 0.0)


FAR = Sweep("far", "fine", "y", -400.0, -900.0, 50)
WHOLE = SweepBlock(RIG, FAR, range(50), np.array([500.0]), (1000, 2000))


def ones(light: Radiance, binning: int) -> Radiance:
    """Electrons are the unit."""
    return np.ones_like(light)


def test_worst_chips_are_about_the_worst_places():
    """A bright spot, a dark one, an edge, and the line that meets the mirror most obliquely, each its own chip."""

    def light(chip: SweepBlock) -> Radiance:
        seen = np.full((50, 640, 1), 50.0, np.float32)
        seen[10, 100], seen[45, 630], seen[20, 200:400] = 60.0, 41.0, 58.0
        seen[20, 300:] = 43.0
        return seen[chip.lines.start : chip.lines.stop]

    chips = [replace(WHOLE, lines=range(first, first + 5)) for first in range(0, 50, 5)]
    found = worst_blocks(chips, light, ones)
    assert {name: chip.lines.start for name, chip in found.items() if name != "most oblique"} == {
        "steepest": 20,
        "brightest": 10,
        "darkest": 45,
    }
    assert found["most oblique"].normals[:, 2].max() == WHOLE.normals[:, 2].max()


def test_each_binning_has_worst_chips_of_its_own():
    """Sums by sums: what is brightest as a sample need not be so in a sum of 4."""

    def light(chip: SweepBlock) -> Radiance:
        seen = np.full((50, 640, 1), 50.0, np.float32)
        seen[10, 100], seen[30, 100:108] = 60.0, 58.0
        return seen[chip.lines.start : chip.lines.stop]

    coarse = replace(WHOLE, sweep=replace(FAR, binning=4))
    chips = [replace(whole, lines=range(at, at + 5)) for whole in (WHOLE, coarse) for at in range(0, 50, 5)]
    found = worst_blocks(chips, light, ones)
    assert found["brightest"].lines.start == 10
    assert found["brightest in sums of 4"].lines.start == 30
    assert found["brightest in sums of 4"].sweep.binning == 4


def test_candidates_are_about_places_that_the_sweep_sees():
    """And about its ends and middle; places beside it or out of the mirror's reach add none."""
    along, scan = sweep_to_scene(FAR, RIG.camera)
    here = np.array([along[30, 12], scan[30, 12]]) + (np.array(WHOLE.shape) - 1) / 2
    places = np.array([here, here + np.array([0, 300]), [0, 1e6]])
    assert [chip.lines for chip in candidate_blocks([WHOLE], places)] == [
        range(3),
        range(24, 27),
        range(29, 32),
        range(47, 50),
    ]


def test_candidates_stay_few_and_within_short_sweeps():
    """Of many sweeps evenly; a sweep of one line has one chip, of none none."""
    sweeps = [Sweep(f"s{number}", "fine", "x", 0.0, 0.0, number % 2 + 1) for number in range(99)]
    chips = candidate_blocks([replace(WHOLE, sweep=sweep) for sweep in sweeps], np.zeros((0, 2)))
    assert len(chips) == MOST_CANDIDATES
    assert all(chip.lines == range(chip.sweep.lines) for chip in chips)
    assert candidate_blocks([replace(WHOLE, sweep=replace(FAR, lines=0))], np.zeros((1, 2))) == []


def test_nothing_to_choose_from_is_refused():
    """Rather than verified on nothing."""
    with pytest.raises(ShapeError, match="no lines to verify effects on: 0 candidates hold no sample"):
        worst_blocks([], lambda chip: np.zeros((0, 640, 1), np.float32), ones)


EXACT: dict[Any, str] = {
    ROTATION: "rays",
    SLIT: "9x3",
    SMEAR: "positions",
    DIFFRACTION: "airy",
    ABERRATION: "gaussian",
    KEYSTONE: "linear",
}


def test_kernels_that_differ_misplace_more() -> None:
    """Another blur, or held positions folded; not the parts of a slit nor an effect without a kernel."""
    same = misplaced_fraction(EXACT, {**EXACT, SLIT: "3x1"})
    assert same == misplaced_fraction(EXACT, EXACT) < NEGLIGIBLE
    for effect in (KEYSTONE, SLIT):
        without = {one: way for one, way in EXACT.items() if one is not effect}
        assert misplaced_fraction(EXACT, without) == same + KERNELS
    assert misplaced_fraction(EXACT, {**EXACT, SMEAR: "folded"}) == same + KERNELS


@pytest.mark.parametrize("nm", [(450.0, 640.0, 980.0), (300.0, 1200.0, 2500.0)], ids=["near", "far apart"])
@pytest.mark.parametrize("pattern", ["rows", "columns", "point"])
def test_two_ways_to_fold_the_same_light_differ_by_no_more(pattern: str, nm: tuple[float, ...]) -> None:
    """Light of 60 full wells that no keystone changes (rows), or no held position (columns), and tails of a point."""
    rig = Rig(camera=LineCamera(samples=64, exposure_ms=10_000.0))
    y, x = np.mgrid[:48, :64]
    planes = {"rows": y // 2 % 2, "columns": x // 2 % 2, "point": (y == 23) & (x == 30)}
    scene = image_scene(planes[pattern][..., None] * np.array([1.0, 0.7, 0.9]), rig.camera, np.array(nm))
    sweep = Sweep("s", "coarse", "x", 0.0, -24.0, 12, 4, 4)
    block = sweep_block(scene, rig, sweep, range(2) if pattern == "point" else range(12))
    unshifted = {effect: way for effect, way in EXACT.items() if effect is not KEYSTONE}
    other = unshifted if pattern == "rows" else {**EXACT, SMEAR: "folded"}
    light, full = (expected_light(scene, block, one).astype(np.float64) for one in (other, EXACT))
    range_e = 100.0 * np.ptp(scene.planes * scene.electrons)
    assert np.abs(light - full).max() <= range_e * misplaced_fraction(EXACT, other)

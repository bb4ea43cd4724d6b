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
from pipeline.simulator.render import expected_light, tails_apart
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.selection.choice import TOTAL, Decision, decide
from pipeline.simulator.selection.verification import (
    MOST_CANDIDATES,
    ROUNDING,
    Floats,
    candidate_blocks,
    contrast_about,
    misplaced_electrons,
    misplaced_fraction,
    misplaced_in_tails,
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
    measured = verify(decided(*effects, on, read), render, CHIPS, units)
    assert measured == pytest.approx(
        {"drift": 1.2 * 1.02 * 1.5 * 0.01, "cloud": 1.2 * 1.01 * 1.5 * 0.02, TOTAL: 1.2 * 1.5 * (1.01 * 1.02 - 1)},
        rel=1e-4,
    )


def test_nothing_left_out_measures_nothing():
    """Exact on, all together changes by 0."""
    assert verify(decided(Brightening("drift", 0.1, fraction=0.1), tolerance=0.0), render, CHIPS, units) == {TOTAL: 0.0}


def test_nothing_on_is_measured_as_a_whole():
    """Where everything is left out by hand, no effect is measured beside the others; together they are."""
    effects = Brightening("drift", 0.01, fraction=0.01), Brightening("cloud", 0.02, fraction=0.02)
    measured = verify(decided(*effects, asked="none"), render, CHIPS, units)
    assert measured == pytest.approx({TOTAL: 1.2 * (1.01 * 1.02 - 1)}, rel=1e-4)


def test_broken_bound_is_named_with_its_place():
    """Effect, change, bound, place and what to do."""
    decision = decided(Brightening("drift", 0.01, fraction=0.1))
    said = (
        r"drift: .* changes light by 0\.12 sigma of the noise at sweep fine-0, line 40, sample 0, band 0 of the "
        r"brightest lines, above its bound of 0\.0145.*--tol 0 or"
    )
    with pytest.raises(BoundError, match=said):
        verify(decision, render, CHIPS, units)


def test_light_that_is_no_number_breaks_every_bound():
    """NaN is not less than a bound."""

    def broken(block: SweepBlock, chosen: Mapping[Effect, str]) -> Radiance:
        shape = len(block.lines), block.rig.camera.samples, 2
        return render(block, chosen) if chosen else np.full(shape, np.nan, np.float32)

    with pytest.raises(BoundError, match="changes light by nan"):
        verify(decided(Brightening("drift", 0.01, fraction=0.01)), broken, CHIPS, units)


def test_rounding_alone_breaks_no_bound():
    """Sums of float32 in another order differ by some millionths."""
    decision = decided(Brightening("drift", 1e-9, fraction=2e-6))
    assert verify(decision, render, CHIPS, units)[TOTAL] == pytest.approx(2.4e-6, rel=0.1)


def test_what_hardly_changes_anything_is_measured_with_the_others_alone():
    """An effect bounded by less than a thousandth of a unit has no figure of its own, and counts in that of all."""
    effects = Brightening("drift", 1e-4, fraction=1e-4), Brightening("cloud", 0.02, fraction=0.02)
    measured = verify(decided(*effects), render, CHIPS, units)
    assert measured.keys() == {"cloud", TOTAL}
    assert measured[TOTAL] == pytest.approx(1.2 * (1.0001 * 1.02 - 1), rel=1e-3)


def test_sums_are_held_against_the_bound_as_they_are_stored():
    """An error that 4 samples share is twice as many sigmas of their sum: one that a sample alone would hide."""
    coarse = replace(BLOCK, sweep=replace(SWEEP, binning=4))
    shared = Brightening("drift", 0.01, fraction=0.01)

    def noise(light: Radiance, binning: int) -> Floats:
        return np.full(light.shape, 100.0 / np.sqrt(binning))

    assert verify(decided(shared), render, {"steepest": BLOCK}, noise)["drift"] == pytest.approx(0.01, rel=1e-3)
    said = r"light by 0\.02 sigma .* sample 0 \(of 4 summed\), band 0 of the steepest lines"
    with pytest.raises(BoundError, match=said):
        verify(decided(shared), render, {"steepest": coarse}, noise)


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


RIG = Rig(camera=LineCamera(samples=64, exposure_ms=10_000.0))
SWEEP = Sweep("s", "coarse", "x", 0.0, -24.0, 12, 4, 4)
EXACT: dict[Any, str] = {
    ROTATION: "rays",
    SLIT: "9x3",
    SMEAR: "positions",
    DIFFRACTION: "airy",
    ABERRATION: "gaussian",
    KEYSTONE: "linear",
}


def test_contrast_is_that_of_the_scene_about_a_sample() -> None:
    """A bright pixel between two lines of a chip counts 8 px around it, and no farther; even light counts nothing."""
    values = np.zeros((48, 64, 1))
    values[23, 40] = 1.0
    scene = image_scene(values, RIG.camera, [550.0])
    block = sweep_block(scene, RIG, SWEEP, range(6, 8))  # looks at rows 24 to 31

    def render(block: SweepBlock, chosen: Any) -> Radiance:
        return expected_light(scene, block, chosen)

    contrast = contrast_about(block, render)[0, :, 0]
    full = float(scene.electrons.max()) * 100
    assert contrast[33:48].min() > 0.5 * full
    assert contrast[:30].max() == contrast[52:].max() == 0
    assert contrast_about(replace(block, lines=range(9, 11)), render).max() == 0


def test_kernels_that_differ_misplace_more() -> None:
    """Another blur, or held positions folded; not the parts of a slit nor an effect without a kernel."""
    block = sweep_block(image_scene(np.ones((48, 64, 1)), RIG.camera, [550.0]), RIG, SWEEP, range(2))
    same = misplaced_fraction(block, EXACT, {**EXACT, SLIT: "3x1"})
    assert same == misplaced_fraction(block, EXACT, EXACT) < NEGLIGIBLE
    without = {effect: way for effect, way in EXACT.items() if effect is not KEYSTONE}
    boxless = {effect: way for effect, way in EXACT.items() if effect is not SLIT}
    for other in (without, boxless, {**EXACT, SMEAR: "folded"}):
        assert misplaced_fraction(block, EXACT, other) == pytest.approx(same + NEGLIGIBLE)
    apart = sweep_block(image_scene(np.ones((48, 64, 2)), RIG.camera, [300.0, 2500.0]), RIG, SWEEP, range(2))
    assert misplaced_fraction(apart, EXACT, without) > same + 2 * NEGLIGIBLE  # few kernels stand for both, and say so


@pytest.mark.parametrize("nm", [(450.0, 640.0, 980.0), (300.0, 1200.0, 2500.0)], ids=["near", "far apart"])
@pytest.mark.parametrize("pattern", ["rows", "columns"])
def test_two_ways_to_fold_the_same_light_differ_by_no_more(pattern: str, nm: tuple[float, ...]) -> None:
    """Light of 60 full wells that no keystone can change, along rows, or that no held position can, along columns."""
    y, x = np.mgrid[:48, :64]
    plane = (y if pattern == "rows" else x) // 2 % 2
    values = plane[..., None] * np.array([1.0, 0.7, 0.9])
    scene = image_scene(values, RIG.camera, np.array(nm))
    block = sweep_block(scene, RIG, SWEEP, range(12))
    unshifted = {effect: way for effect, way in EXACT.items() if effect is not KEYSTONE}
    other = unshifted if pattern == "rows" else {**EXACT, SMEAR: "folded"}
    light, full = (expected_light(scene, block, one) for one in (other, EXACT))
    contrast = contrast_about(block, lambda block, chosen: expected_light(scene, block, chosen))
    bound = misplaced_electrons(full, contrast, misplaced_fraction(block, EXACT, other))
    assert (np.abs(light.astype(np.float64) - full) <= bound).all()


@pytest.mark.parametrize("nm", [303.0, 550.0, 1000.0])
def test_tails_of_folded_positions_differ_by_no_more(nm: float) -> None:
    """Of a pixel of 60 full wells nothing lies within 8 px of a line, yet folding changes its tails there."""
    values = np.zeros((48, 64, 1))
    values[23, 30] = 1.0
    scene = image_scene(values, RIG.camera, [nm])
    block = sweep_block(scene, RIG, SWEEP, range(2))  # looks at rows 0 to 7
    folded = {**EXACT, SMEAR: "folded"}

    def render(block: SweepBlock, chosen: Any) -> Radiance:
        return expected_light(scene, block, chosen)

    full = render(block, EXACT)
    change = np.abs(render(block, folded).astype(np.float64) - full)
    assert contrast_about(block, render).max() == 0
    near = misplaced_electrons(full, np.zeros(change.shape), misplaced_fraction(block, EXACT, folded))
    assert (change > near).any()
    assert (change <= near + misplaced_in_tails(block, EXACT, folded, render)).all()


def test_tails_are_alike_where_held_positions_are() -> None:
    """What a blur changes far off is its own doing, not arithmetic's; of visible bands folding changes 1e-3 at most."""
    block = sweep_block(image_scene(np.ones((48, 64, 1)), RIG.camera, [550.0]), RIG, SWEEP, range(2))
    without = {effect: way for effect, way in EXACT.items() if effect is not DIFFRACTION}
    assert misplaced_in_tails(block, EXACT, without, render).max() == 0
    folded = {**EXACT, SMEAR: "folded"}
    fractions = [tails_apart(block, EXACT, folded, reach_px) for reach_px in (8, 32, 128)]
    assert np.all(np.diff(np.concatenate(fractions)) < 0)
    assert 1e-5 < fractions[0][0] < 1e-3
    assert tails_apart(block, without, {**without, SMEAR: "folded"}, 8).max() < 1e-6


def test_even_light_differs_by_float32_alone() -> None:
    """Without contrast nothing can be misplaced."""
    light = np.full((3, 10, 2), 1e4, np.float32)
    assert misplaced_electrons(light, np.zeros((1, 10, 2)), 1.0).max() == pytest.approx(1e4 * ROUNDING)

"""What was left out, measured on chips: right bounds pass, wrong ones are named, chips are the worst places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import BoundError
from pipeline.simulator.effects.effect import Effect, Light, SweepBlock
from pipeline.simulator.selection.choice import TOTAL, Decision, decide
from pipeline.simulator.selection.verification import Floats, verify
from tests.pipeline.simulator.made_up_effects import RIG, SWEEP, Brightening, MadeUp, even_probe

BLOCK = SweepBlock(RIG, SWEEP, range(20, 28), np.array([500.0, 600.0]), (200, 700))
CHIPS = {"steepest": BLOCK, "brightest": replace(BLOCK, lines=range(40, 44))}


def render(block: SweepBlock, chosen: Mapping[Effect, str]) -> Light:
    """Light of 100 e-, brighter from line 40 on, times all gains."""
    light = np.full((len(block.lines), len(block.columns), 2), 100.0, np.float32)
    light[block.numbers >= 40] += 20
    for effect, variant in chosen.items():
        if hasattr(effect, "gain"):
            light = light * effect.gain(block, variant)
    return light


def units(light: Light, binning: int) -> Floats:
    """100 e- are one unit."""
    return np.full(light.shape, 100.0)


def decided(*effects: MadeUp, tolerance: float = 1.0) -> Decision:
    """Off where the tolerance lets it be."""
    return decide(even_probe(level=np.full(1, 1.2)), RIG, effects, tolerance)


def test_measured_changes_are_those_of_each_effect_and_of_all():
    """Gains of 1 % and 2 % on light of 1.2 units; what is on or of the readout is not measured."""
    effects = Brightening("drift", 0.01, share=0.01), Brightening("cloud", 0.02, share=0.02)
    on, read = Brightening("vignetting", 3.0, share=0.5), MadeUp("read", 0.1)
    measured = verify(decided(*effects, on, read), render, CHIPS, units)
    assert measured == pytest.approx(
        {"drift": 1.2 * 1.02 * 1.5 * 0.01, "cloud": 1.2 * 1.01 * 1.5 * 0.02, TOTAL: 1.2 * 1.5 * (1.01 * 1.02 - 1)},
        rel=1e-4,
    )


def test_nothing_left_out_measures_nothing():
    """Exact on, all together changes by 0."""
    assert verify(decided(Brightening("drift", 0.1, share=0.1), tolerance=0.0), render, CHIPS, units) == {TOTAL: 0.0}


def test_broken_bound_is_named_with_its_place():
    """Effect, change, bound, place and what to do."""
    decision = decided(Brightening("drift", 0.01, share=0.1))
    said = (
        r"drift: .* changes light by 0\.12 sigma of the noise at sweep fine-0, line 40, sample 0, band 0 of the "
        r"brightest lines, above its bound of 0\.0145.*--tol 0 or"
    )
    with pytest.raises(BoundError, match=said):
        verify(decision, render, CHIPS, units)


def test_light_that_is_no_number_breaks_every_bound():
    """NaN is not less than a bound."""

    def broken(block: SweepBlock, chosen: Mapping[Effect, str]) -> Light:
        return (
            render(block, chosen) if chosen else np.full((len(block.lines), len(block.columns), 2), np.nan, np.float32)
        )

    with pytest.raises(BoundError, match="changes light by nan"):
        verify(decided(Brightening("drift", 0.01, share=0.01)), broken, CHIPS, units)


def test_rounding_alone_breaks_no_bound():
    """Sums of float32 in another order differ by some millionths."""
    decision = decided(Brightening("drift", 1e-9, share=2e-6))
    assert verify(decision, render, CHIPS, units)["drift"] == pytest.approx(2.4e-6, rel=0.1)


def test_sums_are_held_against_the_bound_as_they_are_stored():
    """An error that 4 samples share is twice as many sigmas of their sum: one that a sample alone would hide."""
    coarse = replace(BLOCK, sweep=replace(SWEEP, binning=4))
    shared = Brightening("drift", 0.01, share=0.01)

    def noise(light: Light, binning: int) -> Floats:
        return np.full(light.shape, 100.0 / np.sqrt(binning))

    assert verify(decided(shared), render, {"steepest": BLOCK}, noise)["drift"] == pytest.approx(0.01, rel=1e-3)
    said = r"light by 0\.02 sigma .* sample 0 \(of 4 summed\), band 0 of the steepest lines"
    with pytest.raises(BoundError, match=said):
        verify(decided(shared), render, {"steepest": coarse}, noise)

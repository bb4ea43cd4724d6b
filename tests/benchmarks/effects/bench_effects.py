"""Effects: bounds against measured changes over random scenes and rigs, and savings by the choice of effects."""

from __future__ import annotations

import math
import statistics
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from measure import Row, Timing, ratio, time_in_turn

from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import Effect, Radiance, SweepBlock
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.readout import read_out
from pipeline.simulator.render import EFFECTS, expected_light
from pipeline.simulator.rig_model import Air, Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from pipeline.simulator.selection.choice import decide
from pipeline.simulator.selection.survey_probe import probe_scene
from tests.benchmarks.effects.bench_simulator import cheap_effects
from tests.pipeline.simulator.bound_trials import DRAWN, Trial, trials
from tests.pipeline.simulator.pupil_reference import distances, random_tile
from tests.pipeline.simulator.random_cases import Case, random_case
from tests.pipeline.simulator.sparse_cases import sparse_case

CASES = range(1000, 1200)  # none of them was used while the bounds were developed
SPARSE_CASES = range(1000, 1070)
TILES = 100
MOST_LOOSE = 6.0  # median of bound over measured change
MOST_BINNING = 8  # every case is stored as samples, and in sums of 2 up to this number
TOLERANCE = 0.1
LEAST_SAVED = 3.0
LINES = range(504, 520)  # timed lines of the farm's sweeps
RIGS = {"rig at rest": Rig(), "rig 30 m away": Rig(air=Air(distance_m=30.0))}


def rows() -> list[Row]:
    """Return the bounds by effect and variant, then tolerance and processor time on the farm."""
    sparse = _bounds({number: sparse_case(number) for number in SPARSE_CASES}, "scenes of which looks see little")
    return [
        *_bounds({number: random_case(number) for number in CASES}, "random scenes and rigs"),
        *sparse,
        *_pupil(),
        *(row for name, rig in RIGS.items() for row in _of_rig(farm_scene(1, (1024, 1280)), name, rig)),
    ]


def _pupil() -> list[Row]:
    """Return the distances between all effects enabled and the pupil integral."""
    found = []
    for what, focus_m in (("sharp", None), ("40 m away, focused at infinity", math.inf)):
        far = np.sort(np.concatenate([distances(random_tile(number, focus_m)) for number in range(TILES)]))
        median, worst = float(np.median(far)), float(far[-1])
        said = f"median {median:.2g}, 9 of 10 within {far[int(0.9 * len(far))]:.2g}, worst {worst:.2g} sigma"
        found.append(Row(f"everything on beside the pupil's integral, {TILES} random tiles, {what}", said))
    return found


def _bounds(cases: Mapping[int, Case], what: str) -> list[Row]:
    found: dict[tuple[str, str], list[tuple[int, Trial]]] = defaultdict(list)
    began = time.process_time()
    for number, case in cases.items():
        for trial in trials(case, (1, 2 + number % (MOST_BINNING - 1))):
            found[trial.effect, trial.variant].append((number, trial))
    spent = time.process_time() - began
    broken = sum(trial.is_broken for tried in found.values() for _, trial in tried)
    return [
        *(_of_effect(*key, tried, what) for key, tried in found.items()),
        Row(
            f"bounds over {len(cases)} {what}, each as samples and in sums of 2 to {MOST_BINNING}",
            f"{broken} of {sum(map(len, found.values()))} broken",
            "0",
            broken == 0,
            f"{spent:.0f} s of processor time",
        ),
    ]


def _of_effect(name: str, variant: str, cases: list[tuple[int, Trial]], what: str) -> Row:
    loose = {(number, trial.binning): trial.looseness for number, trial in cases if np.isfinite(trial.looseness)}
    broken = [(number, trial.binning) for number, trial in cases if trial.is_broken]
    said = "nothing seen"
    if loose:
        worst = max(loose, key=loose.__getitem__)
        said = f"median {statistics.median(loose.values()):.2g}, {min(loose.values()):.2g} to {loose[worst]:.3g}"
        said += f" (case {worst[0]}, sums of {worst[1]})"
    chance = "; 1 survey of 1000 may" if name in DRAWN else ""
    return Row(
        f"bound / measured, {what}: {name}, {variant}",
        f"{len(broken)} of {len(cases)} broken; {said}",
        f"0 broken{chance}; median <= {MOST_LOOSE:g}",
        not broken and (not loose or statistics.median(loose.values()) <= MOST_LOOSE),
        f"seen in {len(loose)}" + (f"; broken in {broken[:5]}" if broken else ""),
    )


def _of_rig(scene: RasterScene, name: str, rig: Rig) -> list[Row]:
    sweeps = tuple(Sweep(f"strip {swath:g}", "fine", "x", swath, -512.0, 1024) for swath in (-320.0, 320.0))
    clock = time.process_time()
    probe = probe_scene(scene, rig, sweeps)
    probed = time.process_time() - clock
    decision = decide(probe, rig, EFFECTS, TOLERANCE)
    decided = time.process_time() - clock - probed
    white = scene.white_reference_electrons.astype(np.float64) * (rig.camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    told = {"fwhm_nm": scene.fwhm_nm, "white_e": white}
    blocks = [SweepBlock(rig, sweep, LINES, scene.wavelength_nm, scene.shape, **told) for sweep in sweeps]
    ways = {"auto": decision.chosen, "exact": decision.exact, "cheap": cheap_effects(decision)}
    light = {way: [expected_light(scene, block, chosen) for block in blocks] for way, chosen in ways.items()}
    apart = {way: _apart(light[way], light["exact"], rig) for way in ("auto", "cheap")}

    def image(chosen: Mapping[Effect, str]) -> None:
        read_out(expected_light(scene, blocks[0], chosen), blocks[0], chosen)

    clocks = time_in_turn({way: partial(image, chosen) for way, chosen in ways.items()}, rounds=3)
    return [
        Row(
            f"farm 1024 x 1280 x 270, {name}, auto at {TOLERANCE} sigma: greatest change of light",
            f"{apart['auto']:.3g} sigma, bound {decision.error:.3g}",
            f"<= {TOLERANCE} sigma",
            apart["auto"] <= decision.error <= TOLERANCE,
            f"everything on, cheap: {apart['cheap']:.2g} sigma",
        ),
        _cpu_row(name, "cheap", clocks),
        _cpu_row(name, "exact", clocks),
        Row(f"farm, {name}: probe and choice of effects, processor time", f"{probed:.1f} s and {decided:.2f} s"),
        Row(f"farm, {name}: on", ", ".join(f"{one.name}" for one in decision.taken if one.is_on)),
    ]


def _apart(light: Sequence[Radiance], exact: Sequence[Radiance], rig: Rig) -> float:
    pairs = zip(light, exact, strict=True)
    return max(float((np.abs(one - other) / noise_electrons(other, rig)).max()) for one, other in pairs)


def _cpu_row(name: str, against: str, clocks: Mapping[str, Timing]) -> Row:
    numbers = len(LINES) * 640 * 270
    ns = {way: 1e9 * clock.cpu_min_s / numbers for way, clock in clocks.items()}
    goal = against == "cheap" and RIGS[name] == Rig()
    what = "each as cheap as a tenth of the tolerance lets it be" if against == "cheap" else "exact"
    return Row(
        f"farm, {name}, auto: processor time against everything on, {what}",
        f"1/{ratio(clocks, against, 'auto'):.2f}",
        f">= {LEAST_SAVED:g} times less" if goal else "",
        ratio(clocks, against, "auto") >= LEAST_SAVED if goal else None,
        f"auto {ns['auto']:.1f}, everything {ns[against]:.1f} ns/px*band, readout included",
    )

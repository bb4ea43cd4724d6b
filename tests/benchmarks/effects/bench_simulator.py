"""Simulator: a sweep of a large farm, with effects chosen at a tenth of the noise, against all effects."""

from __future__ import annotations

import resource
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from measure import Row, ns_of, ratio, time_in_turn

from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.blurs import ABERRATION, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.effect import Effect, SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.readout import read_out
from pipeline.simulator.render import EFFECTS, expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from pipeline.simulator.selection.choice import Decision, decide
from pipeline.simulator.selection.survey_probe import probe_scene

SIZE = 2560  # px of the scene
LINES = 256
AT_ONCE = 16
TOLERANCE = 0.1  # sigma
RATE = 60e6
SAVED = 3.0
MEMORY_GIB = 2.0
RENDER_NS = 7.0
SWATHS = (-960.0, -320.0, 320.0, 960.0)
BLURS: dict[Effect, str] = {DIFFRACTION: "airy", ABERRATION: "gaussian", KEYSTONE: "linear"}


@dataclass(frozen=True)
class Survey:
    """The scene, its sweeps, and the chosen effects."""

    scene: RasterScene
    rig: Rig
    sweeps: tuple[Sweep, ...]
    decision: Decision

    def blocks(self) -> list[SweepBlock]:
        """Return blocks of lines in the middle of one half of an outer sweep."""
        scene = self.scene
        exposures = self.rig.camera.exposure_ms / DEFAULT_EXPOSURE_MS
        white = scene.white_reference_electrons.astype(np.float64) * exposures
        first = SIZE // 4 - LINES // 2
        whole = SweepBlock(self.rig, self.sweeps[0], range(SIZE), scene.wavelength_nm, scene.shape, white_e=white)
        return [replace(whole, lines=range(at, at + AT_ONCE)) for at in range(first, first + LINES, AT_ONCE)]

    @property
    def values(self) -> int:
        """Return the number of pixels times bands of all blocks."""
        return LINES * self.rig.camera.samples * len(self.scene.wavelength_nm)


def rows() -> list[Row]:
    """Return rate, ratio to a copy, savings and memory, then cost and error of the footprint's variants."""
    scene = farm_scene(0, (SIZE, SIZE))
    rig = Rig()
    sweeps = tuple(Sweep(f"swath{n}", "fine", "x", at, -(SIZE - 1) / 2, SIZE) for n, at in enumerate(SWATHS))
    decision = decide(probe_scene(scene, rig, sweeps), rig, EFFECTS, TOLERANCE)
    survey = Survey(scene, rig, sweeps, decision)
    blocks = survey.blocks()
    calls: dict[str, Callable[[], object]] = {
        "auto": partial(_simulated, survey, decision.chosen, blocks),
        "cheap": partial(_simulated, survey, cheap_effects(decision), blocks[:4]),
        "exact": partial(_simulated, survey, decision.exact, blocks[:1]),
        "take": _take(survey),
    }
    clocks = time_in_turn(calls, 3)
    fractions = {"auto": 1.0, "cheap": 4 * AT_ONCE / LINES, "exact": AT_ONCE / LINES, "take": 1.0}
    ns = {name: ns_of(clocks[name], survey.values * fraction) for name, fraction in fractions.items()}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    rate = 1e9 / ns["auto"]
    on = ", ".join(f"{effect.name} {variant}" for effect, variant in decision.chosen.items())
    return [
        Row(
            f"{LINES} lines of a {SIZE} x {SIZE} x 270 sweep, auto at {TOLERANCE} sigma: px*bands per CPU second",
            f"{rate / 1e6:.1f} million ({ns['auto']:.1f} ns)",
            f">= {RATE / 1e6:.0f} million",
            rate >= RATE,
            on,
        ),
        Row(
            "the same over np.take of as many bytes",
            f"{ratio(clocks, 'auto', 'take'):.1f} x",
            peers=f"np.take {ns['take']:.2f} ns/px*band",
        ),
        Row(
            "everything on, each as cheap as a tenth of the tolerance allows, over auto",
            f"{ns['cheap'] / ns['auto']:.2f} x",
            f">= {SAVED:g} x",
            ns["cheap"] >= SAVED * ns["auto"],
            f"{ns['cheap']:.1f} ns",
        ),
        Row("everything on and exact, over auto", f"{ns['exact'] / ns['auto']:.2f} x", peers=f"{ns['exact']:.1f} ns"),
        Row(
            "most memory of the process, scene included",
            f"{peak:.2f} GiB",
            f"<= {MEMORY_GIB:g} GiB",
            peak <= MEMORY_GIB,
        ),
        *_footprints(survey),
    ]


def _simulated(survey: Survey, chosen: dict[Effect, str], blocks: list[SweepBlock]) -> None:
    for block in blocks:
        read_out(expected_light(survey.scene, block, chosen), block, chosen)


def cheap_effects(decision: Decision) -> dict[Effect, str]:
    """Return all effects of the rig, each in its cheapest variant with an error of at most a tenth of the tolerance."""
    found: dict[Effect, str] = {}
    for menu in (one.menu for one in decision.taken if one.menu.present):
        within = [option for option in menu.variants if option.error <= 0.1 * decision.tolerance]
        least = min(within, key=lambda option: (option.cost_ns, option.error, option.variant), default=menu.exact)
        found[menu.effect] = least.variant
    return found


def _take(survey: Survey) -> Callable[[], None]:
    """Return a call that copies as many rows of bands as there are samples, from a table larger than the cache."""
    bands, samples = len(survey.scene.wavelength_nm), survey.rig.camera.samples
    table = np.random.default_rng(0).random((60_000, bands), np.float32)
    index = np.random.default_rng(1).integers(0, len(table) - samples, LINES)[:, None] + np.arange(samples)
    out = np.empty((samples, bands), np.float32)

    def call() -> None:
        for line in index:
            np.take(table, line, axis=0, out=out, mode="clip")

    return call


def _footprints(survey: Survey) -> list[Row]:
    """Return cost and error of each variant of the slit, without and with the rig's blurs, at the survey's corner."""
    middle = survey.blocks()[0]
    corner = replace(middle, lines=range(AT_ONCE))
    found = []
    for name, blurs in (("no blur", {}), ("all blurs of the rig", BLURS)):
        choices: dict[str, dict[Any, str]] = {
            variant: {ROTATION: "rays", SLIT: variant, **blurs} for variant in SLIT.variants
        }
        calls = {variant: partial(expected_light, survey.scene, middle, chosen) for variant, chosen in choices.items()}
        clocks = time_in_turn(calls, 3)
        ns = {variant: ns_of(clock, survey.values * AT_ONCE / LINES) for variant, clock in clocks.items()}
        exact, *others = (expected_light(survey.scene, corner, chosen) for chosen in choices.values())
        noise = noise_electrons(exact, survey.rig)
        errors = [float((np.abs(other - exact) / noise).max()) for other in others]
        found.append(
            Row(
                f"footprint, {name}: ns/px*band with {', '.join(SLIT.variants)} boxes",
                ", ".join(f"{one:.1f}" for one in ns.values()),
                f"3x1 <= {RENDER_NS:g} ns" if blurs else "",
                ns["3x1"] <= RENDER_NS if blurs else None,
                "at the survey's corner against 9x3: " + ", ".join(f"{one:.3f}" for one in errors) + " sigma",
            )
        )
    return found

"""What a choice of effects could save at most if it knew the answer: by place, tile by tile, and by product.

An oracle leaves an effect out of a tile, or takes its cheapest variant, where that alone changes no number of the tile
by more than the whole tolerance; nobody can choose better, for effects share the tolerance and an oracle pays nothing.
It saves that effect's stated cost, on that share of the tiles, of what the renderer needs with the effects of `auto`.

By product: how much of the class map of a survey changes, with the same draws, where costly effects are left out.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from bench_agreement import NOISE_ALONE, SEEDS, SIZE, mapped
from bench_calls import BANDS, bare_field, night
from measure import Row
from numpy.typing import NDArray

from models.network.machine import use_one_thread
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import OFF, Effect, SweepBlock
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.effects.registry import EFFECTS
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene, raster_from_values
from pipeline.simulator.selection.choice import Decision, Treatment, decide
from pipeline.simulator.selection.options import acts_on_light
from pipeline.simulator.selection.survey_probe import probe_scene
from pipeline.simulator.simulated import sweep_block

TOLERANCE = 0.1  # sigma
TILES = (16, 64)  # px a side
LOOKED = 3  # strips of 64 lines, evenly over the scan
FLOOR_NS = 3.0  # of what is in every rendering, with no effect on: rays, components to bands, rounding

MAP_SHARE = 0.002  # of a class map that a choice by product might change
LEFT_OUT = (("diffraction",), ("keystone",), ("diffraction", "keystone"), ("stray-light", "smile"))

Light = NDArray[np.float32]


def rows() -> list[Row]:
    """The farm, a bare field and a night scene, each in tiles of two sizes."""
    nm = np.linspace(400, 1000, BANDS)
    made = {"bare field": bare_field(), "night": night()}
    scenes = {"farm 640 x 512": farm_scene(0, (512, 640))} | {
        what: raster_from_values(values, Rig().camera, name=what, wavelength_nm=nm) for what, values in made.items()
    }
    by_place = [row for what, scene in scenes.items() for row in _of_scene(what, scene)]
    return [*by_place, *_by_product()]


def _by_product() -> list[Row]:
    """Share of the pixels of a farm's map that change, the noise drawn alike, and what of the rendering is saved."""
    names, found = [effect.name for effect in EFFECTS], []
    use_one_thread()
    maps = {seed: mapped(seed, effects=",".join(names), tol=NOISE_ALONE)[0] for seed in SEEDS}
    scene, rig = farm_scene(0, (512, 640)), Rig()
    sweep = Sweep("whole", "fine", "x", 0.0, -255.5, 512)
    decision = decide(probe_scene(scene, rig, (sweep,)), rig, EFFECTS, TOLERANCE)
    for out in LEFT_OUT:
        on = ",".join(name for name in names if name not in out)
        changed = [float((mapped(seed, effects=on, tol=NOISE_ALONE)[0] != maps[seed]).mean()) for seed in SEEDS]
        saved = sum(decision.cost_of(one) for one in decision.taken if one.name in out)
        found.append(
            Row(
                f"farm {SIZE}, class map without {' and '.join(out)}: px that change, by seed",
                ", ".join(f"{share:.2%}" for share in changed),
                f"<= {MAP_SHARE:.1%}",
                max(changed) <= MAP_SHARE,
                f"saves {saved:.1f} of {decision.cost_ns + FLOOR_NS:.1f} ns of rendering",
            )
        )
    return found


def _of_scene(what: str, scene: RasterScene) -> list[Row]:
    rig, lines = Rig(), scene.shape[0]
    sweep = Sweep("whole", "fine", "x", 0.0, -(lines - 1) / 2, lines)
    decision = decide(probe_scene(scene, rig, (sweep,)), rig, EFFECTS, TOLERANCE)
    firsts = np.linspace(0, lines - max(TILES), LOOKED).round().astype(int).tolist()
    blocks = [sweep_block(scene, rig, sweep, range(first, first + max(TILES))) for first in firsts]
    changes = {one.name: list(_changes(scene, blocks, decision, one)) for one in decision.taken if _may_go(one)}
    return [_of_tiles(what, decision, changes, tile) for tile in TILES]


def _may_go(one: Treatment) -> bool:
    return one.is_on and acts_on_light(one.menu.effect) and one.option.cost_ns > 0


def _changes(
    scene: RasterScene, blocks: list[SweepBlock], decision: Decision, one: Treatment
) -> Iterator[tuple[float, list[Light]]]:
    """Cost of each way to compute one effect, and what it changes beside all others exact, by block [sigma]."""
    for option in (*one.menu.variants[1:], one.menu.off):
        ways: dict[Effect, str] = {**decision.exact, one.menu.effect: option.variant}
        chosen = {effect: way for effect, way in ways.items() if way != OFF}
        found = []
        for block in blocks:
            exact = expected_light(scene, block, decision.exact)
            change = np.abs(expected_light(scene, block, chosen) - exact) / noise_electrons(exact, block.rig)
            found.append(change.max(axis=2))
        yield option.cost_ns, found


def _of_tiles(what: str, decision: Decision, changes: dict[str, list[tuple[float, list[Light]]]], tile: int) -> Row:
    saved, shares = 0.0, {}
    for one in decision.taken:
        if one.name not in changes:
            continue
        own_ns = decision.cost_of(one)  # beside what it shares
        costs = np.full(_tiles(changes[one.name][0][1], tile).shape, own_ns)
        for cost_ns, found in changes[one.name]:
            within = _tiles(found, tile) <= TOLERANCE
            costs = np.where(within, np.minimum(costs, cost_ns), costs)
        saved += own_ns - float(costs.mean())
        shares[one.name] = float((costs < own_ns).mean())
    cost = decision.cost_ns + FLOOR_NS
    often = ", ".join(f"{name} {share:.0%}" for name, share in shares.items() if share > 0)
    return Row(
        f"{what}, tiles of {tile} px: an oracle by place, rendering of auto over its own",
        f"{cost / (cost - saved):.2f} x at most",
        peers=f"auto {cost:.1f} ns, {saved:.1f} saved; cheaper or off in {often or 'no tile'} of the tiles",
    )


def _tiles(found: list[Light], tile: int) -> NDArray[np.float32]:
    """Greatest change of each tile, (tile,); what is left at the ends of lines is dropped."""
    parts = []
    for change in found:
        rows, columns = (size // tile for size in change.shape)
        parts.append(
            change[: rows * tile, : columns * tile].reshape(rows, tile, columns, tile).max(axis=(1, 3)).ravel()
        )
    return np.concatenate(parts)

"""What the other orientation of the line would have shown, worked out after the map: nobody waits for it at the rig."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from flows.survey.run import SurveyRun
from flows.survey.stage import Product, Wanted, stage
from flows.survey.stages.attention import load_plan
from pipeline.planning.orientation import compare_orientations, find_rows
from storage.archive.keys import StageRef
from storage.archive.manifests import read_table, write_table
from storage.arrays.mosaics import load_attention, mosaic_brightness

TURNED = Product("turned", version=1)
FILE = "orientation.json"


@stage(
    "compare_turned",
    "the plan with lines along the other axis",
    TURNED,
    of=("rectify", "attend"),
    after=("draw_map",),
    unit="pixels",
)
def compare_turned(run: SurveyRun, mosaic: StageRef, attention: StageRef) -> Wanted:
    """Plan the scores with lines along the other axis, and find which way crop rows run."""
    settings = run.settings

    def build(path: Path) -> None:
        scores = load_attention(attention.path / "attention.zarr").score.ravel()
        rows = find_rows(mosaic_brightness(mosaic.path / "mosaic.zarr"))
        turned = compare_orientations(
            run.grid,
            run.camera,
            settings.cost,
            run.plan.along,
            scores,
            budget_s=run.plan.fine_s,
            plan=load_plan(attention),
            rows=rows,
            overlap_px=run.plan.overlap_px,
            margin_px=run.plan.margin_px,
            threshold=settings.threshold,
        )
        write_table(path / FILE, asdict(turned) | {"sentence": turned.sentence})

    return Wanted(build, {}, [mosaic, attention])  # all it depends on are parameters of attention


def load_orientation(turned: StageRef) -> dict[str, Any]:
    """Read what the other orientation of the line would have shown, and which way crop rows run."""
    return read_table(turned.path / FILE)

"""What the other orientation of the line would have shown, worked out after the map: nobody waits for it at the rig."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from flows.survey.run import SurveyRun
from flows.survey.stages import Produce, load_plan, write_json
from pipeline.planning.crop_rows import find_rows
from pipeline.planning.orientation import compare_orientations
from storage.archive.archive import StageRef
from storage.archive.stored_tables import read_table
from storage.arrays.attention import load_attention
from storage.arrays.mosaic_strips import mosaic_brightness

FILE = "orientation.json"


def compare_turned(run: SurveyRun, produce: Produce, mosaic: StageRef, attention: StageRef) -> StageRef:
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
        write_json(path / FILE, asdict(turned) | {"sentence": turned.sentence})

    return produce("turned", build, {}, [mosaic, attention])  # all it depends on are parameters of attention


def load_orientation(turned: StageRef) -> dict[str, Any]:
    """Read what the other orientation of the line would have shown, and which way crop rows run."""
    return read_table(turned.path / FILE)

"""What an evaluation leaves in its folder: figures, plots, and pictures of the worst and the best frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from flows.evaluate.jobs import Show, scene_of
from flows.evaluate.kept_results import writing
from flows.evaluate.rows import Trial
from flows.evaluate.work import Record, Work
from models.evaluation.metrics import mean_iou
from storage.archive.whole_files import to_json

SHOWN_SHARE = 0.10  # of the seats, or the nearest one tried: what the pictures show


def publish_evaluation(work: Work, content: dict[str, Any], runs: list[list[Record]], show: Show) -> list[str]:
    """Write figures, plots and pictures into the folder, where there is one; names of the files."""
    out = work.request.out
    if out is None:
        return []
    from flows.evaluate.pictures import draw_frame
    from flows.evaluate.plot import draw_evaluation
    from flows.evaluate.rig_plot import draw_rig

    shown = shown_row(work.trial)
    files = [out / "evaluation.json", out / "evaluation.png"]
    with writing(out):
        draw_evaluation(files[1], content)
        if content["rig"]["rows"]:
            files.append(out / "rig.png")
            draw_rig(files[-1], content)
        for title, name, index in ends(runs, *shown):
            show("drawing", len(files) / 6, title)
            path, scene = out / f"{title}.png", scene_of(work.data, name)
            draw_frame(path, f"{title} frame", work.look(scene, name, index), work.loaded(index), *shown)
            files.append(path)
        content["files"] = [str(path) for path in files]
        temporary = files[0].with_name("evaluation.json.part")
        temporary.write_text(to_json(content), encoding="utf-8")
        temporary.replace(files[0])
    show("drawing", 1.0, "")
    return [str(path) for path in files]


def shown_row(trial: Trial) -> tuple[str, float]:
    """Policy and share of the pictures: the first policy, and the share nearest 10 %."""
    policy = trial.policies[0] if trial.policies and trial.shares else "none"
    share = min(trial.shares, key=lambda share: abs(share - SHOWN_SHARE), default=0.0) if policy != "none" else 0.0
    return policy, share


def ends(runs: list[list[Record]], policy: str, share: float) -> list[tuple[str, str, int]]:
    """Title, frame and weights of the lowest and the highest mIoU of a frame's own; one frame alone is the worst."""
    judged: dict[str, tuple[float, int]] = {}
    for number, records in enumerate(runs):
        for record in records:
            row = next(row for row in record["rows"] if (row["policy"], row["share"]) == (policy, share))
            own = mean_iou(np.array(row["counts"]))
            if not np.isnan(own):
                judged.setdefault(record["frame"], (own, number))
    if not judged:
        return []
    worst, best = (choose(judged, key=lambda name: judged[name][0]) for choose in (min, max))
    named = [("worst", worst)] if worst == best else [("worst", worst), ("best", best)]
    return [(title, name, judged[name][1]) for title, name in named]

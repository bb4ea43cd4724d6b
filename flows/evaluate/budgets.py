"""Figures over budgets of seconds: our plans beside lines spent without a model, and rows of equal time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from flows.evaluate.equal_time import plan_name
from flows.evaluate.rig_plans import BUDGETS, PLANNED, RANDOM, UNIFORM
from flows.evaluate.series import Record, Row, Runs, by_seed, collect_row, difference, frame_names, mean_of
from models.evaluation.metrics import mean_iou, miou_of_shown_classes, overall_accuracy

PLANS = (*PLANNED, UNIFORM, RANDOM)


def summarise_rig(runs: Runs, trial: Record) -> dict[str, Any]:
    """Give mIoU, seconds and lines of every plan at every budget, and our plans against the two without a model.

    A budget at which a frame has no plan is judged on the other frames, in every row alike; their number is said.
    """
    names, seeds = frame_names(runs), by_seed(runs)
    rows = {
        (plan, budget): row
        for plan in PLANS
        for budget in BUDGETS
        if (row := collect_row(seeds, plan, budget, names)) is not None
    }
    table = []
    for (plan, budget), row in rows.items():
        figures = _figures(row, "budget")
        for other, name in ((UNIFORM, "against_uniform"), (RANDOM, "against_random")):
            figures[name] = difference(row, rows[other, budget], trial) if plan in PLANNED else None
        table.append(figures)
    left_out = {  # a matter of the frame and the rig: of several weights the same
        (record["frame"], one["budget"]): {"frame": record["frame"], **one}
        for records in runs
        for record in records
        for one in record["left_out"]
    }
    return {"rows": table, "left_out": list(left_out.values())}


def summarise_equal_time(runs: Runs, judged: Runs, rig: Runs, trial: Record) -> list[dict[str, Any]]:
    """Give the rows with the exposure of equal time, against `all` and against the same row at equal exposure.

    ``rig`` holds the plans of lines at equal exposure; without them their differences are None. Of random placements
    the first draw stands for all in ``runs``, and is what it is compared with.
    """
    names = frame_names(judged)
    seeds, usual, plans = by_seed(runs), [_first_draws(records) for records in by_seed(judged)], by_seed(rig)
    whole = collect_row(usual, "all", 1.0, names)
    wanted = [(policy, share, policy, usual) for policy in trial["policies"] for share in trial["shares"]]
    wanted += [(plan_name(policy), budget, policy, plans) for policy in PLANNED for budget in BUDGETS]
    found = []
    for name, share, policy, beside in wanted:
        row, same = collect_row(seeds, name, share, names), collect_row(beside, policy, share, names)
        if row is None or whole is None:
            continue
        figures = _figures(row, "share") | {"exposure": mean_of([part["exposure"] for part in row.parts])}
        figures["against_all"] = difference(row, whole, trial)
        figures["against_equal_exposure"] = None if same is None else difference(row, same, trial)
        figures["equal_exposure_miou"] = None if same is None else mean_of(same.over_runs(mean_iou))
        found.append(figures)
    return found


def _first_draws(records: Sequence[Record]) -> list[Record]:
    """Records without further draws of random placements."""
    return [{**record, "rows": [row for row in record["rows"] if row["draw"] == 0]} for record in records]


def _figures(row: Row, name: str) -> dict[str, Any]:
    return {
        "policy": row.policy,
        name: row.share,
        "miou": mean_of(row.over_runs(mean_iou)),
        "miou_of_shown_classes": mean_of(row.over_runs(miou_of_shown_classes)),
        "pixel_accuracy": mean_of(row.over_runs(overall_accuracy)),
        "frames": int(row.judged.sum()),
        **{part: _mean_part(row.parts, part) for part in ("seconds", "full_s", "lines", "full_lines", "seats")},
    }


def _mean_part(parts: Sequence[Record], name: str) -> float | None:
    values = [part[name] for part in parts if name in part]
    return mean_of(values) if values else None

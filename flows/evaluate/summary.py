"""From counts of frames to the figures of an evaluation: means over seeds, intervals over frames and seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flows.evaluate.costs import Prices, row_cost
from flows.evaluate.rig_plans import BUDGETS, PLANNED, RANDOM, UNIFORM, plan_name
from flows.evaluate.rows import DENSE, ENDS, ORACLE, POOLED_MARK, is_pooled, own_policy, pooled_policies
from flows.evaluate.series import (
    Record,
    Row,
    Runs,
    by_seed,
    collect_row,
    difference,
    frame_names,
    mean_of,
    mean_or_none,
    summarise_curves,
)
from models.evaluation.metrics import (
    average_accuracy,
    boundary_iou,
    false_pixels,
    frequency_weighted_iou,
    gap_closed,
    iou_per_class,
    kappa,
    labelled_classes,
    mean_boundary_iou,
    mean_iou,
    miou_of_shown_classes,
    miou_over_frame_classes,
    miou_over_frames,
    overall_accuracy,
)
from models.evaluation.placement import captured_gain

Key = tuple[str, float]


def summarise(
    runs: Runs,
    class_names: Sequence[str],
    trial: Record,
    prices: Prices,
    controls: Runs = (),
    designs: Sequence[str] = (),
) -> Record:
    """Give the figures of every row, against the baseline: the better of `all` and the dense control.

    ``runs`` are of each weights the records of `judge_frame`, ``controls`` those of `judge_control` with the design of
    each; ``trial`` has ``shares``, ``policies``, ``seed`` and ``draws`` (of the bootstrap).
    """
    rows = _rows(runs, trial, controls, designs)
    whole, none = rows["all", 1.0], rows["none", 0.0]
    known = (mean_of(none.over_runs(mean_iou)), mean_of(whole.over_runs(mean_iou)))
    base, why = choose_baseline(rows, trial)
    support = whole.counts.sum(axis=3).max(axis=0).sum(axis=0)  # labelled pixels of each class, each frame once
    table = []
    for (policy, share), row in rows.items():
        control = policy in designs
        figures: Record = {"policy": policy, "share": share, "uses_labels": policy == ORACLE, "control": control}
        figures |= {"frames": int(row.judged.sum()), **_accuracy(row, class_names)}
        figures["gap_closed"] = gap_closed(figures["miou"], *known)
        figures["against_all"] = None if policy == "all" else difference(row, whole, trial)
        figures["against_baseline"] = None if row is base else difference(row, base, trial)
        rival = rows.get(("random", share)) if policy != "random" else None
        figures["against_random"] = None if rival is None else difference(row, rival, trial)
        figures |= _pooled(row, rows, trial)
        figures |= _placement(row, runs, judged=not (control or policy in ENDS or is_pooled(policy)))
        figures["cost"] = row_cost(row, base, prices)
        table.append(figures)
    return {
        "rows": table,
        "support": dict(zip(class_names, support.tolist(), strict=True)),
        "baseline": {"policy": base.policy, "share": base.share, "why": why},
        "curves": summarise_curves(table),
    }


def _rows(runs: Runs, trial: Record, controls: Runs, designs: Sequence[str]) -> dict[Key, Row]:
    names, seeds = frame_names(runs), by_seed(runs)
    pooled = (policy + POOLED_MARK for policy in pooled_policies(trial["policies"]))
    every = [(policy, share) for policy in (*trial["policies"], *pooled, ORACLE) for share in trial["shares"]]
    found = {key: collect_row(seeds, *key, names) for key in [("none", 0.0), *every]}
    for design in dict.fromkeys(designs):
        own = by_seed([records for records, name in zip(controls, designs, strict=True) if name == design])
        shares = sorted({row["share"] for records in own for record in records for row in record["rows"]})
        found |= {(design, share): collect_row(own, design, share, names) for share in shares}
    found["all", 1.0] = collect_row(seeds, "all", 1.0, names)
    return {key: row for key, row in found.items() if row is not None}


def choose_baseline(rows: dict[Key, Row], trial: Record) -> tuple[Row, str]:
    """Give the better of `all` and the dense control, and why; a control that lacks frames cannot be it."""
    whole, dense = rows["all", 1.0], rows.get((DENSE, 1.0))
    if dense is None:
        return whole, "no dense control was given"
    missing = int((whole.judged & ~dense.judged).sum())
    if missing:
        return whole, f"the dense control was trained on {missing} of the frames"
    ahead = difference(dense, whole, trial)["difference"]
    better = ahead is not None and ahead > 0
    words = f"the dense control is {abs(100 * (ahead or 0)):.1f} points {'above' if better else 'below'} all"
    return (dense if better else whole), words


def _accuracy(row: Row, class_names: Sequence[str]) -> dict[str, Any]:
    each = row.over_runs(mean_iou)
    draws = [each[row.of_seed == number] for number in np.unique(row.of_seed)]
    seeds = np.array([mean_of(some) for some in draws])
    classes = row.over_runs(iou_per_class)
    false = row.over_runs(false_pixels).mean(axis=0).tolist()  # of a run
    near = list(zip(row.boundary.sum(axis=1), row.over_runs(labelled_classes).astype(bool), strict=True))
    judged = [run[run.any(axis=(1, 2))] for run in row.counts]
    outside = [mean_iou((whole - part).sum(axis=0)) for whole, part in zip(row.counts, row.inside, strict=True)]
    return {
        "miou": mean_of(each),
        "miou_of_shown_classes": mean_of(row.over_runs(miou_of_shown_classes)),
        "spread": float(seeds.std(ddof=1)) if len(seeds) > 1 else None,
        "draws_spread": mean_of([some.std(ddof=1) for some in draws]) if len(draws[0]) > 1 else None,
        "by_seed": seeds.tolist(),
        "classes_averaged": int((~np.isnan(classes)).any(axis=0).sum()),
        "miou_i": mean_of([miou_over_frames(run) for run in judged]),
        "miou_c": mean_of([miou_over_frame_classes(run) for run in judged]),
        "frequency_weighted": mean_of(row.over_runs(frequency_weighted_iou)),
        "pixel_accuracy": mean_of(row.over_runs(overall_accuracy)),
        "average_accuracy": mean_of(row.over_runs(average_accuracy)),
        "kappa": mean_of(row.over_runs(kappa)),
        "per_class_iou": dict(zip(class_names, [mean_of(column) for column in classes.T], strict=True)),
        "false_classes": {name: pixels for name, pixels in zip(class_names, false, strict=True) if pixels},
        "boundary_iou": mean_of([mean_boundary_iou(*run) for run in near]),
        "per_class_boundary_iou": dict(
            zip(class_names, [mean_of(c) for c in np.array([boundary_iou(*run) for run in near]).T], strict=True)
        ),
        "inside_miou": mean_of(row.over_runs(mean_iou, "inside")),
        "outside_miou": mean_of(outside),
    }


def _pooled(row: Row, rows: dict[Key, Row], trial: Record) -> Record:
    """Seats that frames bought and, where one threshold bought them, that of each seed and what it is worth."""
    seats = [part["seats"] for part in row.parts]
    figures: Record = {"seats_per_frame": {"least": min(seats), "mean": float(np.mean(seats)), "most": max(seats)}}
    if not is_pooled(row.policy):
        return figures | {"thresholds": None, "against_share_per_frame": None}
    thresholds = list(dict.fromkeys(part["threshold"] for part in row.parts))
    same = difference(row, rows[own_policy(row.policy), row.share], trial)
    return figures | {"thresholds": thresholds, "against_share_per_frame": same}


def _placement(row: Row, runs: Runs, *, judged: bool) -> Record:
    if not judged:
        return {"captured_gain": None, "ap_gain": None, "ap_top": None, "spearman": None, "undefined_scenes": None}
    ranks = [one for records in runs for record in records for one in record["ranking"] if one["policy"] == row.policy]
    return {
        "captured_gain": captured_gain(sum(p["gain"] for p in row.parts), sum(p["best_gain"] for p in row.parts)),
        "ap_gain": mean_or_none([one["ap_gain"] for one in ranks]),
        "ap_top": mean_or_none([part["ap_top"] for part in row.parts]),
        "spearman": mean_or_none([one["spearman"] for one in ranks]),
        "undefined_scenes": sum(one["ap_gain"] is None for one in ranks),
    }


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
    names, seeds, plans = frame_names(judged), by_seed(runs), by_seed(rig)
    usual = [
        [{**record, "rows": [row for row in record["rows"] if row["draw"] == 0]} for record in records]
        for records in by_seed(judged)
    ]
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


def _figures(row: Row, name: str) -> dict[str, Any]:
    return {
        "policy": row.policy,
        name: row.share,
        "miou": mean_of(row.over_runs(mean_iou)),
        "miou_of_shown_classes": mean_of(row.over_runs(miou_of_shown_classes)),
        "pixel_accuracy": mean_of(row.over_runs(overall_accuracy)),
        "frames": int(row.judged.sum()),
        **{
            part: mean_or_none([one[part] for one in row.parts if part in one])
            for part in ("seconds", "full_s", "lines", "full_lines", "seats")
        },
    }

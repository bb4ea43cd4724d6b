"""`spectralzoom evaluate`: weights judged on frames that they were not trained on, with intervals and costs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from flows.evaluate.costs import Prices
from flows.evaluate.frames import (
    COST,
    Candidate,
    EvaluateRequest,
    Jobs,
    Show,
    checked_request,
    open_candidates,
    open_frames,
    scene_of,
    sort_frames,
)
from flows.evaluate.rows import design_of, known_or_none, open_controls
from flows.evaluate.series import REFERENCE, Record, seeds_of
from flows.evaluate.summary import summarise, summarise_equal_time, summarise_rig
from flows.evaluate.table import SHOWN_SHARE, print_evaluation
from flows.evaluate.work import Made, Work
from flows.terminal.processes import writing
from flows.terminal.progress import StageProgress, on_stdout
from flows.training.data import alike_notes
from models.evaluation.metrics import LEVEL, agreement, false_pixels, iou_per_class, mean_iou
from models.network.machine import keep_freed_memory
from pipeline.lazy import deferred
from storage.archive.whole_files import to_json

if TYPE_CHECKING:
    import flows.evaluate.plots as plots
    import flows.publish.panels as panels
else:
    plots = deferred("flows.evaluate.plots")
    panels = deferred("flows.publish.panels")


def run_evaluate(request: EvaluateRequest, console: Console, *, as_json: bool = False) -> dict[str, Any]:
    """Judge with progress on ``console``; figures as a table or JSON on stdout, and all of them into the folder."""
    with StageProgress(console) as progress:
        content = evaluate_weights(request, lambda what, done, words: progress.show(what, done, words))
    if as_json:
        sys.stdout.write(to_json(content))
    else:
        print_evaluation(content, on_stdout())
    for note in content["data_notes"]:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    for path in content["files"]:
        console.print(path, soft_wrap=True)
    return content


def evaluate_weights(request: EvaluateRequest, show: Show = lambda what, done, words: None) -> dict[str, Any]:
    """Judge weights on every frame of a data set that they were not trained on.

    Raises SettingsError: shares, policies, weights or controls that cannot be; SceneError: no frame is left, one that
    was asked for by name has no weights left, or one has no labels.
    """
    request = checked_request(request)
    keep_freed_memory()
    candidates = open_candidates(request.weights)
    controls = open_controls(request.controls, candidates)
    data = open_frames(request.dataset, request.frames, request.scenes, candidates[0].camera, request.choices)
    if request.out is not None:
        with writing(request.out):
            request.out.mkdir(parents=True, exist_ok=True)  # before minutes are spent on what cannot be kept
    jobs = sort_frames(request, data, candidates, controls, show)
    work = Work(request, data, candidates, controls)
    made = work.judge(jobs, show)
    content = {"dataset": data.law, **_files(candidates, controls, jobs), **_figures(request, work, made)}
    content["data_notes"] = [*data.notes, *alike_notes(jobs.alike)]
    content["files"] = publish_evaluation(work, content, made["frame"], show)
    return content


def _files(candidates: Sequence[Candidate], controls: Sequence[Candidate], jobs: Jobs) -> dict[str, Any]:
    names = [job.name for job in jobs.frames] + jobs.left_out

    def told(one: Candidate, number: int, *, control: bool) -> Record:
        covers = jobs.covered(number, control=control)
        gone = sorted(set(names) - set(covers))
        return {"file": one.path.name, "key": one.key, "frames": len(covers), "covers": covers, "left_out": gone}

    return {
        "weights": [told(one, number, control=False) for number, one in enumerate(candidates)],
        "controls": [
            {"design": design_of(one), **told(one, number, control=True)} for number, one in enumerate(controls)
        ],
        "frames": [job.name for job in jobs.frames],
        "left_out": jobs.left_out,
    }


def _figures(request: EvaluateRequest, work: Work, made: Made) -> dict[str, Any]:
    trial = {"shares": request.shares, "policies": request.policies, "seed": request.seed, "draws": request.draws}
    camera, names = asdict(work.camera), work.candidates[0].described.class_names
    designs = [design_of(one) for one in work.controls]
    runs, rig, prices = made["frame"], made["rig"], Prices(made["time"][0], made["capture"][0])
    return {
        "settings": {**trial, "level": LEVEL, "mode": "frame", "camera": camera, "cost_model": asdict(COST)},
        "seeds": [[work.candidates[number].path.name for number in one] for one in seeds_of(runs)],
        **summarise(runs, names, trial, prices, made["control"], designs),
        "rig": summarise_rig(rig, trial) if request.rig else {"rows": [], "left_out": []},
        "equal_time": summarise_equal_time(made["equal"], runs, rig, trial) if request.equal_time else [],
        "timed": prices.timed,
        "captured": prices.captured,
        "per_frame": [
            {
                "frame": record["frame"],
                "weights": number,
                "seats": record["seats"],
                "positive_seats": record["positive_seats"],
                "rows": [_of_frame(row) for row in record["rows"]],
            }
            for number, records in enumerate(runs)
            for record in records
        ],
        "notes": NOTES,
        "files": [],
    }


NOTES = {
    "bytes": "estimated: samples x bands x 2 bytes, before compression",
    "samples": "coarse pixels and the pixels of the seats, seats free of each other (frame mode)",
    "multiply_adds": "closed form; glance, scores and map; none and all are the map alone",
    "cpu_s": "one thread, from spectral columns to the map: glance, scores and map; none, all and a dense control are "
    "the map alone, their fastest path; median of the rounds, all rows in turn",
    "capture_s": "by the cost model, coarse pass included; frame: as if each seat took its share of the full scan; "
    "rig: the same seats by runs of lines, or the full scan where cheaper; all is the full scan alone",
    "pooled": "one threshold for the scores of all frames of a seed: the best seats of all of them together, as many as"
    " the share of them; intervals over frames hold the threshold. CPU and frame seconds are those of the share on "
    "every frame, on which a frame has as many seats in the mean",
    "intervals": "paired bootstrap over frames, and over seeds of the training where there are several",
    "baseline": "the better of all and the dense control",
    "curves": f"over multiply-adds; reference of the hypervolume: {REFERENCE}",
    "equal_time": "exposure changed until the plan takes what the full scan takes; both clip at the same full well; "
    "seats by runs of lines as above, lines: plans of the rig, by budget instead of K",
    "rig": "lines: every plan pays coarse pass, set-ups and reloads; uniform lines and random lines are blocks of as "
    "many rows of seats as show most seats for the seconds",
    "oracle": "uses labels",
}


def _of_frame(row: Record) -> Record:
    counts = np.array(row["counts"])
    return {
        **{name: row[name] for name in ("policy", "draw", "share", "seats")},
        **{name: known_or_none(figure) for name, figure in agreement(counts).items()},
        "per_class_iou": [known_or_none(iou) for iou in iou_per_class(counts)],
        "false_pixels": false_pixels(counts).tolist(),
    }


def publish_evaluation(work: Work, content: dict[str, Any], runs: list[list[Record]], show: Show) -> list[str]:
    """Write figures, plots and pictures into the folder, where there is one; names of the files."""
    out = work.request.out
    if out is None:
        return []
    policies, shares = work.trial.policies, work.trial.shares
    shown = ("none", 0.0)
    if policies and shares:
        shown = policies[0], min(shares, key=lambda share: abs(share - SHOWN_SHARE))
    files = [out / "evaluation.json", out / "evaluation.png"]
    with writing(out):
        panels.save_png(plots.evaluation_figure(content), files[1])
        if content["rig"]["rows"]:
            files.append(out / "rig.png")
            panels.save_png(plots.rig_figure(content), files[-1])
        for title, name, index in ends(runs, *shown):
            show("drawing", len(files) / 6, title)
            path, scene = out / f"{title}.png", scene_of(work.data, name)
            look = work.look(scene, name, index)
            panels.save_png(plots.frame_figure(f"{title} frame", look, work.loaded(index), *shown), path)
            files.append(path)
        content["files"] = [str(path) for path in files]
        temporary = files[0].with_name("evaluation.json.part")
        temporary.write_text(to_json(content), encoding="utf-8")
        temporary.replace(files[0])
    show("drawing", 1.0, "")
    return [str(path) for path in files]


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

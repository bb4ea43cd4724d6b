"""`spectralzoom evaluate`: weights judged on frames that they were not trained on, with intervals and costs."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import Any

from rich.console import Console

from flows.archive_commands import PIPED_WIDTH
from flows.benchmark_frames import Candidate, check_frame, open_candidates, open_frames
from flows.benchmark_store import writing
from flows.benchmark_summary import summarise
from flows.benchmark_work import COST, JUDGED, EvaluateRequest, Job, Show, Work, scene_of
from flows.evaluation_table import print_evaluation
from flows.progress import StageProgress
from flows.receipt import to_json
from flows.training_data import TrainingData
from models.bootstrap import LEVEL
from pipeline.camera import LineCamera
from pipeline.errors import SceneError, SettingsError


def run_evaluate(request: EvaluateRequest, console: Console, *, as_json: bool = False) -> dict[str, Any]:
    """Judge with progress on ``console``; figures as a table or JSON on stdout, and all of them into the folder."""
    with StageProgress(console) as progress:
        content = evaluate_weights(request, lambda what, done, words: progress.show(what, done, words))
    if as_json:
        sys.stdout.write(to_json(content))
    else:
        print_evaluation(content, Console(file=sys.stdout, width=None if sys.stdout.isatty() else PIPED_WIDTH))
    for path in content["files"]:
        console.print(path, highlight=False, soft_wrap=True)
    return content


def evaluate_weights(request: EvaluateRequest, show: Show = lambda what, done, words: None) -> dict[str, Any]:
    """Judge weights on every frame of a data set that they were not trained on.

    Raises
    ------
    SettingsError : shares, policies or weights that cannot be.
    SceneError : no frame is left for some of the weights, or one has no labels.
    """
    request = _checked(request)
    candidates = open_candidates(request.weights)
    camera = _common_camera(candidates)
    data = open_frames(request.dataset, request.frames, request.scenes, camera, request.choices)
    if request.out is not None:
        with writing(request.out):
            request.out.mkdir(parents=True, exist_ok=True)  # before minutes are spent on what cannot be kept
    jobs, left_out = _sorted_frames(request, data, candidates, show)
    work = Work(request, data, candidates, camera)
    runs, timed, captured = work.judge(jobs, show)
    trial = {"shares": request.shares, "policies": request.policies, "seed": request.seed, "draws": request.draws}
    names = candidates[0].described.class_names
    content: dict[str, Any] = {
        "dataset": data.law,
        "weights": [
            {"file": one.path.name, "key": one.key, "frames": len(records), "left_out": list(gone)}
            for one, records, gone in zip(candidates, runs, left_out, strict=True)
        ],
        "frames": [job.name for job in jobs],
        "settings": {**trial, "level": LEVEL, "mode": "frame", "camera": asdict(camera), "cost_model": asdict(COST)},
        **summarise(runs, names, trial, timed, captured),
        "timed": timed,
        "captured": captured,
        "per_frame": _per_frame(runs),
        "notes": NOTES,
        "files": [],
    }
    content["files"] = work.publish(content, jobs, runs, show)
    return content


NOTES = {
    "bytes": "estimated: samples x bands x 2 bytes, before compression",
    "samples": "coarse pixels and the pixels of the seats, seats free of each other (frame mode)",
    "multiply_adds": "closed form; glance, scores and map; none and all are the map alone",
    "cpu_s": "one thread, from spectral columns to the map: glance, scores and map; none and all are the map alone",
    "capture_s": "by the cost model for the same seats by runs of lines (or the full scan where cheaper), coarse pass "
    "included; all is the full scan alone",
    "intervals": "paired bootstrap over frames; difference of mIoU, mean over seeds",
    "oracle": "uses labels",
}


def _checked(request: EvaluateRequest) -> EvaluateRequest:
    for share in request.shares:
        if not 0 <= share <= 1:
            raise SettingsError(f"--shares are shares of the seats from 0 to 1 (0.1 is 10 %), got {share:g}")
    for policy in request.policies:
        if policy not in JUDGED and policy != "oracle":
            raise SettingsError(
                f"--policies: {policy!r} is none that can be judged on a data set; choose of {', '.join(JUDGED)}"
            )
    for flag, value, least in (
        ("--seed", request.seed, 0), ("--draws", request.draws, 1), ("--timed-frames", request.timed_frames, 0),
    ):  # fmt: skip
        if value < least:
            raise SettingsError(f"{flag} must be at least {least}, got {value}")
    shares = tuple(sorted({share for share in request.shares if 0 < share < 1}))
    policies = tuple(dict.fromkeys(name for name in request.policies if name != "oracle"))
    return EvaluateRequest(**{**vars(request), "shares": shares, "policies": policies})


def _common_camera(candidates: list[Candidate]) -> LineCamera:
    camera = candidates[0].camera
    for other in candidates[1:]:
        if other.camera != camera:
            raise SettingsError(
                f"{other.path} was trained through another camera than {candidates[0].path}; evaluate them one by one"
            )
    return camera


def _sorted_frames(
    request: EvaluateRequest, data: TrainingData, candidates: list[Candidate], show: Show
) -> tuple[list[Job], list[list[str]]]:
    """Frames to judge on, and of each weights those that it was trained on."""
    jobs, left_out = [], [list[str]() for _ in candidates]
    for number, name in enumerate(data.train):
        show("looking for frames", number / len(data.train), name)
        scene = scene_of(data, name)
        for one in candidates:
            check_frame(scene, one.described)
        fit = tuple(index for index, one in enumerate(candidates) if not one.trained_on(scene))
        for index in set(range(len(candidates))) - set(fit):
            left_out[index].append(name)
        if fit:
            jobs.append(Job(name, fit))
    show("looking for frames", 1.0, f"{len(jobs)} of {len(data.train)}")
    for one, gone in zip(candidates, left_out, strict=True):
        if len(gone) == len(data.train):
            raise SceneError(
                f"{one.path} was trained on all {len(gone)} frames of {request.dataset}, and frames trained on are "
                "refused: judge by others, or train with some held out: spectralzoom train ... --hold-out NAMES"
            )
    return jobs, left_out


def _per_frame(runs: list[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    kept = ("policy", "draw", "share", "seats", "miou", "per_class_iou")
    return [
        {
            "frame": record["frame"],
            "weights": number,
            "seats": record["seats"],
            "positive_seats": record["positive_seats"],
            "rows": [{name: row[name] for name in kept} for row in record["rows"]],
        }
        for number, records in enumerate(runs)
        for record in records
    ]

"""Run `spectralzoom evaluate`: judge weights on frames that they were not trained on, with intervals and costs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rich.console import Console

from flows.evaluate.frames import (
    Candidate,
    EvaluateRequest,
    Show,
    checked_request,
    observe_frame,
    open_candidates,
    open_frames,
    sort_frames,
)
from flows.evaluate.judge import Record, judge_frame, seeds_of, summarise
from flows.terminal.processes import writing
from flows.terminal.progress import StageProgress, on_stdout
from flows.training.data import TrainingData
from models.evaluation.metrics import LEVEL
from models.network.machine import choose_device, keep_freed_memory
from models.weights.files import Weights, load_weights
from pipeline.lazy import deferred
from storage.archive.whole_files import to_json, write_whole

if TYPE_CHECKING:
    import flows.evaluate.table as table
    import flows.publish.panels as panels
else:
    table = deferred("flows.evaluate.table")  # matplotlib
    panels = deferred("flows.publish.panels")


def run_evaluate(request: EvaluateRequest, console: Console, *, as_json: bool = False) -> dict[str, Any]:
    """Judge with progress on ``console``; print the figures as a table or JSON, and write them to the folder."""
    with StageProgress(console) as progress:
        content = evaluate_weights(request, progress.show)
    if as_json:
        sys.stdout.write(to_json(content))
    else:
        table.print_evaluation(content, on_stdout())
    for note in content["data_notes"]:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    for path in content["files"]:
        console.print(path, soft_wrap=True)
    return content


def evaluate_weights(request: EvaluateRequest, show: Show = lambda what, done, words: None) -> dict[str, Any]:
    """Judge weights on every frame of a data set that they were not trained on.

    Raises SettingsError: invalid fractions, policies or weights; SceneError: no frame is left, a named frame has no
    weights left, or a frame has no labels.
    """
    request = checked_request(request)
    keep_freed_memory()
    candidates = open_candidates(request.weights)
    data = open_frames(request.dataset, request.frames, request.scenes, candidates[0].camera, request.choices)
    if request.out is not None:
        with writing(request.out):
            request.out.mkdir(parents=True, exist_ok=True)  # fails before minutes are spent
    jobs = sort_frames(request, data, candidates, show)
    runs = _judge_frames(request, data, candidates, jobs.frames, show)
    names = [*jobs.frames, *jobs.left_out]
    asked = {name: getattr(request, name) for name in ("fractions", "policies", "seed", "draws")}
    content = {
        "dataset": data.law,
        "weights": [
            {
                "file": one.path.name,
                "key": one.key,
                "frames": len(covers := jobs.covered(number)),
                "covers": covers,
                "left_out": sorted(set(names) - set(covers)),
            }
            for number, one in enumerate(candidates)
        ],
        "frames": list(jobs.frames),
        "left_out": jobs.left_out,
        "settings": {**asked, "level": LEVEL, "camera": asdict(candidates[0].camera)},
        "seeds": [[candidates[number].path.name for number in one] for one in seeds_of(runs)],
        **summarise(runs, candidates[0].described.class_names, request),
        "data_notes": [*data.notes, *jobs.notes],
        "files": [],
    }
    if request.out is not None:
        content["files"] = [str(request.out / name) for name in ("evaluation.json", "evaluation.png")]
        with writing(request.out):
            panels.save_png(table.evaluation_figure(content), request.out / "evaluation.png")
        write_whole(request.out / "evaluation.json", to_json(content))
    return content


def _judge_frames(
    request: EvaluateRequest,
    data: TrainingData,
    candidates: Sequence[Candidate],
    frames: dict[str, tuple[int, ...]],
    show: Show,
) -> list[list[Record]]:
    """Judge every frame by its weights; return the records of each of the weights."""
    device, loaded = choose_device(request.device), dict[int, Weights]()
    runs: list[list[Record]] = [[] for _ in candidates]
    for number, (name, judges) in enumerate(frames.items()):
        scene = data.scene(name)
        for at, index in enumerate(judges):
            one = candidates[index]
            show("judging frames", (number + at / len(judges)) / len(frames), f"{name}, {one.path.name}")
            if index not in loaded:
                loaded[index] = load_weights(one.path).on(device)
            observed = observe_frame(scene, name, loaded[index], one.camera, request.seed)
            runs[index].append(judge_frame(request, observed, loaded[index]))
    show("judging frames", 1.0, f"{len(frames)} frames")
    return runs

"""`spectralzoom evaluate`: weights judged on frames that they were not trained on, with intervals and costs."""

from __future__ import annotations

import hashlib
import json
import sys
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from flows.evaluate.frames import (
    Candidate,
    EvaluateRequest,
    Show,
    checked_request,
    open_candidates,
    open_frames,
    see_frame,
    sort_frames,
)
from flows.evaluate.judge import Record, Trial, judge_frame, seeds_of, summarise
from flows.terminal.processes import writing
from flows.terminal.progress import StageProgress, on_stdout
from flows.training.data import TrainingData, alike_notes, scene_notes
from models.evaluation.metrics import LEVEL
from models.network.machine import PROCESSOR, choose_device, keep_freed_memory
from models.weights.files import Weights, load_weights
from pipeline.lazy import deferred
from pipeline.simulator.scenes.scene import RasterScene
from storage.archive.whole_files import to_json, write_whole

if TYPE_CHECKING:
    import flows.evaluate.table as table
    import flows.publish.panels as panels
else:
    table = deferred("flows.evaluate.table")  # matplotlib
    panels = deferred("flows.publish.panels")

KEPT_VERSION = 5  # of what a kept result says


def run_evaluate(request: EvaluateRequest, console: Console, *, as_json: bool = False) -> dict[str, Any]:
    """Judge with progress on ``console``; figures as a table or JSON on stdout, and all of them into the folder."""
    with StageProgress(console) as progress:
        content = evaluate_weights(request, lambda what, done, words: progress.show(what, done, words))
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

    Raises SettingsError: shares, policies or weights that cannot be; SceneError: no frame is left, one that was asked
    for by name has no weights left, or one has no labels.
    """
    request = checked_request(request)
    keep_freed_memory()
    candidates = open_candidates(request.weights)
    data = open_frames(request.dataset, request.frames, request.scenes, candidates[0].camera, request.choices)
    if request.out is not None:
        with writing(request.out):
            request.out.mkdir(parents=True, exist_ok=True)  # before minutes are spent on what cannot be kept
    jobs = sort_frames(request, data, candidates, show)
    trial = Trial(request.fractions, request.policies, request.seed)
    runs = _judged(request, data, candidates, jobs.frames, trial, show)
    names = [*jobs.frames, *jobs.left_out]
    asked = {**asdict(trial), "draws": request.draws, "level": LEVEL}
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
        "settings": {**asked, "camera": asdict(candidates[0].camera)},
        "seeds": [[candidates[number].path.name for number in one] for one in seeds_of(runs)],
        **summarise(runs, candidates[0].described.class_names, trial, request.draws),
        "data_notes": [*data.notes, *alike_notes(jobs.alike), *scene_notes(jobs.empty, jobs.regridded)],
        "files": [],
    }
    if request.out is not None:
        content["files"] = [str(request.out / name) for name in ("evaluation.json", "evaluation.png")]
        with writing(request.out):
            panels.save_png(table.evaluation_figure(content), request.out / "evaluation.png")
        write_whole(request.out / "evaluation.json", to_json(content))
    return content


def _judged(
    request: EvaluateRequest,
    data: TrainingData,
    candidates: Sequence[Candidate],
    frames: dict[str, tuple[int, ...]],
    trial: Trial,
    show: Show,
) -> list[list[Record]]:
    """Judge every frame by its weights, of each weights the records; what was kept is not made again."""
    device, loaded = choose_device(request.device), dict[int, Weights]()
    kept = KeptResults(None if request.out is None else request.out / "frames")
    runs: list[list[Record]] = [[] for _ in candidates]
    for number, (name, fit) in enumerate(frames.items()):
        scene = data.scene(name)
        for at, index in enumerate(fit):
            one = candidates[index]
            show("judging frames", (number + at / len(fit)) / len(frames), f"{name}, {one.path.name}")

            def judged(
                scene: RasterScene = scene, index: int = index, one: Candidate = one, name: str = name
            ) -> Record:
                if index not in loaded:
                    loaded[index] = load_weights(one.path).on(device)
                seen = see_frame(scene, name, loaded[index], one.camera, request.seed)
                return judge_frame(trial, seen, loaded[index])

            # the farm's labels follow from its key and are not drawn for this
            labels = None if data.files is None or scene.labels is None else zlib.crc32(scene.labels.tobytes())
            follows_from = {
                **{"weights": one.key, "frame": name, "scene": scene.key, "labels": labels, **asdict(trial)},
                "camera": asdict(one.camera),
                **({} if device == PROCESSOR else {"device": device}),
            }
            runs[index].append(kept.made(follows_from, judged))
    show("judging frames", 1.0, f"{len(frames)} frames")
    return runs


@dataclass(frozen=True)
class KeptResults:
    """A folder of results by their inputs: a run that was killed continues. Without a folder nothing is kept."""

    folder: Path | None

    def made(self, follows_from: Record, make: Callable[[], Record]) -> Record:
        """Give the result that was kept, or make it and keep it: whole or not at all. A damaged one is made again."""
        if self.folder is None:
            return make()
        text = json.dumps([KEPT_VERSION, follows_from], sort_keys=True)
        path = self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:20]}.json"
        try:
            known: Record = json.loads(path.read_text(encoding="utf-8"))["result"]
            return known
        except (OSError, ValueError, LookupError, TypeError):
            result = make()
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps({"follows_from": follows_from, "result": result}))
        return result

"""The frames of an evaluation one after the other: looked at, judged, timed, priced, and kept."""

from __future__ import annotations

import hashlib
import json
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flows.evaluate.costs import capture_seconds, time_frame
from flows.evaluate.frames import COST, Candidate, EvaluateRequest, Jobs, Look, Show, Sight, look_at, scene_of, sight_of
from flows.evaluate.rig_plans import BUDGETS, judge_equal_time, judge_rig
from flows.evaluate.rows import (
    Bought,
    Trial,
    buy_by_seed,
    design_of,
    joined_rows,
    judge_control,
    judge_frame,
    judge_pooled,
    pooled_policies,
    score_frame,
)
from flows.evaluate.series import Record
from flows.terminal.figures import format_seconds
from flows.terminal.processes import writing
from flows.training.data import TrainingData
from models.network.machine import PROCESSOR, choose_device
from models.weights.files import AnyWeights, Weights, load_any_weights
from pipeline.geometry.camera import LineCamera
from pipeline.planning.line_blocks import WIDTHS
from pipeline.simulator.scenes.scene import RasterScene

KEPT_VERSION = 2  # of what a kept result says
UNITS = {  # kinds of results, with rough shares of time
    "frame": 1.0,
    "time": 3.0,
    "capture": 0.5,
    "control": 0.7,
    "rig": 1.5,
    "equal": 1.5,
    "scores": 0.05,
    "pooled": 0.4,
}
Made = dict[str, list[list[Record]]]  # kind -> of each file its records; those of "time" and "capture" in one list


@dataclass(frozen=True)
class KeptResults:
    """A folder of results by what they follow from: a run that was killed goes on. Without a folder nothing is kept."""

    folder: Path | None

    def made(self, what: str, follows_from: Record, make: Callable[[], Record | None]) -> Any:
        """Give the result that was kept, or make it and keep it: whole or not at all. A damaged one is made again."""
        if self.folder is None:
            return make()
        text = json.dumps([KEPT_VERSION, what, follows_from], sort_keys=True)
        path = self.folder / f"{what}-{hashlib.sha256(text.encode()).hexdigest()[:20]}.json"
        try:
            return json.loads(path.read_text(encoding="utf-8"))["result"]
        except (OSError, ValueError, LookupError, TypeError):
            result = make()
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(path.name + ".part")
            temporary.write_text(json.dumps({"follows_from": follows_from, "result": result}), encoding="utf-8")
            temporary.replace(path)
        return result


@dataclass(frozen=True)
class Task:
    """One result to make of a frame: of which kind, and by which of the weights or controls."""

    kind: str
    name: str
    index: int
    beside: tuple[int, ...] = ()  # controls to time


class Work:
    """The frames one after the other: what was kept is not made again."""

    def __init__(
        self,
        request: EvaluateRequest,
        data: TrainingData,
        candidates: Sequence[Candidate],
        controls: Sequence[Candidate] = (),
    ) -> None:
        self.request, self.data, self.candidates, self.controls = request, data, candidates, controls
        self.camera: LineCamera = candidates[0].camera
        self.device = choose_device(request.device)
        self.trial = Trial(request.shares, request.policies, request.seed)
        self.kept = KeptResults(None if request.out is None else request.out / "frames")
        self._weights: dict[str, AnyWeights] = {}
        self._last: tuple[str, str, Look] | None = None
        self._scene: tuple[str, RasterScene] | None = None
        self._bought: Bought = {}
        self._total, self._done = 0.0, 0.0  # units
        self._spent, self._made = 0.0, 0.0  # seconds, and units made in them

    def judge(self, jobs: Jobs, show: Show) -> Made:
        """Make every record; one threshold for all frames takes a second pass, once all are scored."""
        made: Made = {kind: [[] for _ in self._files(kind)] for kind in UNITS}
        first, second = self._tasks(jobs), self._pooled_tasks(jobs)
        self._total, self._done = sum(UNITS[task.kind] for task in (*first, *second)), 0.0
        self._make(first, made, show)
        self._bought = buy_by_seed(made["scores"], self.request.shares)
        self._make(second, made, show)
        made["frame"] = joined_rows(made["frame"], made["pooled"])
        show("judging frames", 1.0, f"{len(jobs.frames)} frames")
        return made

    def _files(self, kind: str) -> Sequence[Candidate]:
        return self.controls if kind == "control" else self.candidates

    def _tasks(self, jobs: Jobs) -> list[Task]:
        """Everything to make of single frames; a frame's results of one weights follow each other."""
        asked = {"scores": bool(self._pooled_tasks(jobs)), "rig": self.request.rig, "equal": self.request.equal_time}
        found = []
        for number, job in enumerate(jobs.frames):
            for index in job.weights:
                kinds = ("frame", *(kind for kind, wanted in asked.items() if wanted))
                found += [Task(kind, job.name, index) for kind in kinds]
                if number < self.request.timed_frames and index == job.weights[0]:
                    first = {design_of(self.controls[one]): one for one in reversed(job.controls)}  # of each design
                    found.append(Task("time", job.name, index, tuple(sorted(first.values()))))
                    found.append(Task("capture", job.name, index))
            found += [Task("control", job.name, index) for index in job.controls]
        return found

    def _pooled_tasks(self, jobs: Jobs) -> list[Task]:
        """What is made of frames once all are scored; of one frame alone nothing."""
        pooled = self.request.pooled and self.request.shares and pooled_policies(self.request.policies)
        if not pooled or len(jobs.frames) < 2:
            return []
        return [Task("pooled", job.name, index) for job in jobs.frames for index in job.weights]

    def _make(self, tasks: Sequence[Task], made: Made, show: Show) -> None:
        for task in tasks:

            def report(part: float, task: Task = task) -> None:
                reached = self._done + 0.95 * part * UNITS[task.kind]
                show("judging frames", reached / self._total, self._words(task, self._total - reached))

            report(0.0)
            record = self._kept_or_made(task, report)
            if record is not None:
                made[task.kind][0 if task.kind in ("time", "capture") else task.index].append(record)
            self._done += UNITS[task.kind]

    def _words(self, task: Task, left: float) -> str:
        files = self._files(task.kind)
        named = task.name if len(files) == 1 else f"{task.name}, {files[task.index].path.name}"
        what = {"frame": "", "control": "control, "}.get(task.kind, f"{task.kind}, ")
        rest = f", about {format_seconds(left * self._spent / self._made)} left" if self._made else ""
        return f"{what}{named}{rest}"

    def _kept_or_made(self, task: Task, report: Callable[[float], None]) -> Record | None:
        if self._scene is None or self._scene[0] != task.name:
            self._scene = task.name, scene_of(self.data, task.name)
        scene = self._scene[1]

        def make() -> Record | None:
            start = time.monotonic()
            made = self._record(scene, task, report)
            self._spent, self._made = self._spent + time.monotonic() - start, self._made + UNITS[task.kind]
            return made

        record: Record | None = self.kept.made(task.kind, self._follows_from(scene, task), make)
        return record

    def _follows_from(self, scene: RasterScene, task: Task) -> Record:
        """All that a result depends on; the farm's labels follow from its key and are not drawn for this."""
        labels = None if self.data.files is None or scene.labels is None else zlib.crc32(scene.labels.tobytes())
        own: Record = {
            "weights": self._files(task.kind)[task.index].key,
            "frame": task.name,
            "scene": scene.key,
            "labels": labels,
            "camera": asdict(self.camera),
            **asdict(self.trial),
            **({} if self.device == PROCESSOR else {"device": self.device}),
        }
        if task.kind in ("capture", "rig", "equal"):
            own["cost"] = asdict(COST)
        if task.kind in ("rig", "equal"):
            own["budgets"] = BUDGETS
        if task.kind == "rig":
            own["widths"] = WIDTHS
        if task.kind == "pooled":
            own["bought"] = self._bought[task.index, task.name]
        if task.kind == "time":
            own |= {"runs": self.request.timed_runs, "controls": [self.controls[index].key for index in task.beside]}
        return own

    def _record(self, scene: RasterScene, task: Task, report: Callable[[float], None]) -> Record | None:
        trial, camera = self.trial, self.camera
        if task.kind == "control":
            return judge_control(trial, *self._control_sight(scene, task.name, task.index), report)
        beside = [self._control_sight(scene, task.name, index) for index in task.beside]
        look, weights = self.look(scene, task.name, task.index), self.loaded(task.index)
        match task.kind:
            case "scores":
                return score_frame(trial.policies, look)
            case "pooled":
                return judge_pooled(self._bought[task.index, task.name], look, weights, report)
            case "rig":
                return judge_rig(look, weights, camera, COST, self.request.seed, report)
            case "equal":
                return judge_equal_time(trial, scene, look, weights, camera, COST, report)
            case "time":
                return time_frame(trial, look, weights, self.request.timed_runs, beside)
            case "capture":
                return capture_seconds(trial, look, weights, camera, COST)
        return judge_frame(trial, look, weights, report)

    def _control_sight(self, scene: RasterScene, name: str, index: int) -> tuple[Sight, AnyWeights]:
        weights = self._load(self.controls[index])
        return sight_of(scene, name, weights, self.camera, self.request.seed), weights

    def look(self, scene: RasterScene, name: str, index: int) -> Look:
        """Look at a frame with some of the weights; the last look is kept."""
        key = self.candidates[index].key
        if self._last is None or self._last[:2] != (name, key):
            self._last = None  # two looks at once are not needed
            self._last = (name, key, look_at(scene, name, self.loaded(index), self.camera, self.request.seed))
        return self._last[2]

    def loaded(self, index: int) -> Weights:
        weights = self._load(self.candidates[index])
        assert isinstance(weights, Weights)  # open_candidates
        return weights

    def _load(self, one: Candidate) -> AnyWeights:
        if one.key not in self._weights:
            found = load_any_weights(one.path)
            self._weights[one.key] = found.on(self.device) if isinstance(found, Weights) else found
        return self._weights[one.key]

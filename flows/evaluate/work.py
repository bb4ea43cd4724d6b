"""The frames of an evaluation one after the other: looked at, judged, timed, priced, and kept."""

from __future__ import annotations

import hashlib
import json
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from flows.evaluate.costs import Rounds, capture_seconds, time_frame
from flows.evaluate.frames import Candidate, Job, Jobs, Look, Show, Sight, look_at, scene_of, sight_of
from flows.evaluate.request import COST, EvaluateRequest
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
from flows.terminal.figures import format_seconds
from flows.training.data import TrainingData
from models.weights.files import AnyWeights, Weights
from pipeline.errors import ArchiveError
from pipeline.geometry.camera import LineCamera
from pipeline.planning.line_blocks import WIDTHS
from pipeline.simulator.scenes.scene import RasterScene

VERSION = 2  # of what a kept result says


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn a folder that cannot be written to into an error that says so."""
    try:
        yield
    except OSError as error:
        raise ArchiveError(f"cannot write to {folder}: {error.strerror}; choose another --out") from error


@dataclass(frozen=True)
class KeptResults:
    """A folder of results by what they follow from; without a folder nothing is kept."""

    folder: Path | None

    def made(self, what: str, follows_from: dict[str, Any], make: Callable[[], dict[str, Any] | None]) -> Any:
        """Give the result that was kept, or make it and keep it: whole or not at all. A damaged one is made again."""
        if self.folder is None:
            return make()
        text = json.dumps([VERSION, what, follows_from], sort_keys=True)
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


Record = dict[str, Any]
Report = Callable[[float], None]
UNITS = {  # rough shares of time
    "frame": 1.0,
    "time": 3.0,
    "capture": 0.5,
    "control": 0.7,
    "rig": 1.5,
    "equal": 1.5,
    "scores": 0.05,
    "pooled": 0.4,
}


@dataclass
class Judged:
    """Records of every kind; those of weights and controls apart, in the order of the files."""

    runs: list[list[Record]]
    controls: list[list[Record]]
    rig: list[list[Record]]
    equal: list[list[Record]]
    scores: list[list[Record]]
    pooled: list[list[Record]]
    timed: list[Record] = field(default_factory=list)
    captured: list[Record] = field(default_factory=list)


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
        self.trial = Trial(request.shares, request.policies, request.seed)
        self.kept = KeptResults(None if request.out is None else request.out / "frames")
        self._weights: dict[str, AnyWeights] = {}
        self._last: tuple[str, str, Look] | None = None
        self._scene: RasterScene | None = None
        self._last_name = ""
        self._bought: Bought = {}
        self._total, self._done = 0.0, 0.0  # units
        self._spent, self._made = 0.0, 0.0  # seconds, and units made in them

    def tasks(self, jobs: Jobs) -> list[Task]:
        """Everything to make of single frames; a frame's results of one weights follow each other."""
        found, pooled = [], bool(self.pooled_tasks(jobs))
        for number, job in enumerate(jobs.frames):
            for index in job.weights:
                found.append(Task("frame", job.name, index))
                found += [Task("scores", job.name, index)] if pooled else []
                found += [Task("rig", job.name, index)] if self.request.rig else []
                found += [Task("equal", job.name, index)] if self.request.equal_time else []
                if number < self.request.timed_frames and index == job.weights[0]:
                    found += [Task("time", job.name, index, self._first_of_each(job)), Task("capture", job.name, index)]
            found += [Task("control", job.name, index) for index in job.controls]
        return found

    def pooled_tasks(self, jobs: Jobs) -> list[Task]:
        """What is made of frames once all are scored; of one frame alone nothing."""
        pooled = self.request.pooled and self.request.shares and pooled_policies(self.request.policies)
        if not pooled or len(jobs.frames) < 2:
            return []
        return [Task("pooled", job.name, index) for job in jobs.frames for index in job.weights]

    def _first_of_each(self, job: Job) -> tuple[int, ...]:
        """A control of each design."""
        first: dict[str, int] = {}
        for index in job.controls:
            first.setdefault(design_of(self.controls[index]), index)
        return tuple(first.values())

    def judge(self, jobs: Jobs, show: Show) -> Judged:
        """Make every record."""
        own = self.candidates
        runs, rig, equal, scores, pooled = (_empty(own) for _ in range(5))
        judged = Judged(runs, _empty(self.controls), rig, equal, scores, pooled)
        first, second = self.tasks(jobs), self.pooled_tasks(jobs)
        self._total, self._done = sum(UNITS[task.kind] for task in (*first, *second)), 0.0
        self._make(first, judged, show)
        self._bought = buy_by_seed(scores, self.request.shares)
        self._make(second, judged, show)
        judged.runs = joined_rows(runs, pooled)
        show("judging frames", 1.0, f"{len(jobs.frames)} frames")
        return judged

    def _make(self, tasks: Sequence[Task], judged: Judged, show: Show) -> None:
        places = {
            "frame": judged.runs,
            "control": judged.controls,
            "rig": judged.rig,
            "equal": judged.equal,
            "scores": judged.scores,
            "pooled": judged.pooled,
        }
        for task in tasks:

            def report(part: float, task: Task = task) -> None:
                reached = self._done + 0.95 * part * UNITS[task.kind]
                show("judging frames", reached / self._total, self._words(task, self._total - reached))

            report(0.0)
            record = self._record(task, report)
            if record is not None:
                kind = {"time": judged.timed, "capture": judged.captured}
                (kind[task.kind] if task.kind in kind else places[task.kind][task.index]).append(record)
            self._done += UNITS[task.kind]

    def _words(self, task: Task, left: float) -> str:
        """Frame, file where there are several, and about how long the rest will take."""
        files = self.controls if task.kind == "control" else self.candidates
        named = task.name if len(files) == 1 else f"{task.name}, {files[task.index].path.name}"
        what = {"frame": "", "control": "control, "}.get(task.kind, f"{task.kind}, ")
        rest = f", about {format_seconds(left * self._spent / self._made)} left" if self._made else ""
        return f"{what}{named}{rest}"

    def _record(self, task: Task, report: Report) -> Record | None:
        if self._scene is None or self._last_name != task.name:
            self._scene, self._last_name = scene_of(self.data, task.name), task.name
        scene, makers = (
            self._scene,
            {
                "frame": self._frame,
                "time": self._time,
                "capture": self._capture,
                "control": self._control,
                "rig": self._rig,
                "equal": self._equal,
                "scores": self._scores,
                "pooled": self._pooled,
            },
        )

        def make() -> Record | None:
            start = time.monotonic()
            made = makers[task.kind](scene, task, report)
            self._spent, self._made = self._spent + time.monotonic() - start, self._made + UNITS[task.kind]
            return made

        record: Record | None = self.kept.made(task.kind, self._follows_from(scene, task), make)
        return record

    def _follows_from(self, scene: RasterScene, task: Task) -> Record:
        """All that a result depends on; the farm's labels follow from its key and are not drawn for this."""
        labels = None if self.data.files is None or scene.labels is None else zlib.crc32(scene.labels.tobytes())
        one = (self.controls if task.kind == "control" else self.candidates)[task.index]
        own: Record = {
            "weights": one.key,
            "frame": task.name,
            "scene": scene.key,
            "labels": labels,
            "camera": asdict(self.camera),
            **asdict(self.trial),
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

    def _frame(self, scene: RasterScene, task: Task, report: Report) -> Record:
        return judge_frame(self.trial, self.look(scene, task.name, task.index), self.loaded(task.index), report)

    def _scores(self, scene: RasterScene, task: Task, report: Report) -> Record:
        return score_frame(self.trial.policies, self.look(scene, task.name, task.index))

    def _pooled(self, scene: RasterScene, task: Task, report: Report) -> Record:
        bought = self._bought[task.index, task.name]
        return judge_pooled(bought, self.look(scene, task.name, task.index), self.loaded(task.index), report)

    def _rig(self, scene: RasterScene, task: Task, report: Report) -> Record:
        look = self.look(scene, task.name, task.index)
        return judge_rig(look, self.loaded(task.index), self.camera, COST, self.request.seed, report)

    def _equal(self, scene: RasterScene, task: Task, report: Report) -> Record | None:
        look = self.look(scene, task.name, task.index)
        return judge_equal_time(self.trial, scene, look, self.loaded(task.index), self.camera, COST, report)

    def _time(self, scene: RasterScene, task: Task, report: Report) -> Record:
        beside = [self._control_sight(scene, task.name, index) for index in task.beside]
        look, rounds = self.look(scene, task.name, task.index), Rounds(self.request.timed_runs)
        return time_frame(self.trial, look, self.loaded(task.index), rounds, beside)

    def _capture(self, scene: RasterScene, task: Task, report: Report) -> Record | None:
        look = self.look(scene, task.name, task.index)
        return capture_seconds(self.trial, look, self.loaded(task.index), self.camera, COST)

    def _control(self, scene: RasterScene, task: Task, report: Report) -> Record:
        return judge_control(self.trial, *self._control_sight(scene, task.name, task.index), report)

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
        """Weights of a candidate, read once."""
        weights = self._load(self.candidates[index])
        assert isinstance(weights, Weights)  # open_candidates
        return weights

    def _load(self, one: Candidate) -> AnyWeights:
        if one.key not in self._weights:
            self._weights[one.key] = one.load()
        return self._weights[one.key]


def _empty(files: Sequence[Candidate]) -> list[list[Record]]:
    return [[] for _ in files]

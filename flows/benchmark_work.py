"""The frames of an evaluation one after the other: looked at, judged, timed, priced, and kept."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from flows.benchmark_frames import Candidate, Look, look_at
from flows.benchmark_rows import Trial, capture_seconds, judge_frame
from flows.benchmark_store import KeptResults, writing
from flows.benchmark_timing import time_frame
from flows.receipt import to_json
from flows.training_data import TrainingData
from models.bootstrap import DRAWS
from models.policies import POLICIES
from models.weights import Weights
from pipeline.camera import LineCamera
from pipeline.scan import CostModel
from pipeline.simulator.scene import RasterScene

SHARES = (0.05, 0.10, 0.15, 0.20, 0.35)
JUDGED = tuple(name for name in POLICIES if name not in ("mask", "vgg-static"))  # these need a file of one's own
USUAL = ("entropy", "sobel", "random")
SHOWN_SHARE = 0.10  # of the seats, or the nearest one tried: what the pictures show
COST = CostModel()
Show = Callable[[str, float, str], None]


@dataclass(frozen=True)
class EvaluateRequest:
    """What to judge and how."""

    dataset: str
    weights: tuple[Path, ...]
    out: Path | None = None
    shares: tuple[float, ...] = SHARES
    policies: tuple[str, ...] = USUAL
    frames: tuple[str, ...] = ()  # all, without one
    scenes: int | None = None  # of the built-in farm
    seed: int = 0
    draws: int = DRAWS
    timed_frames: int = 2
    timed_runs: int = 5
    choices: dict[str, Any] = field(default_factory=dict)  # of load_data_set: labels, bands, wavelengths


@dataclass(frozen=True)
class Job:
    """A frame and the weights that it says something of."""

    name: str
    weights: tuple[int, ...]


def scene_of(data: TrainingData, name: str) -> RasterScene:
    """Make one scene of the data."""
    return next(data.scenes((name,)))


class Work:
    """The frames one after the other: what was kept is not made again."""

    def __init__(
        self, request: EvaluateRequest, data: TrainingData, candidates: list[Candidate], camera: LineCamera
    ) -> None:
        self.request, self.data, self.candidates, self.camera = request, data, candidates, camera
        self.trial = Trial(request.shares, request.policies, request.seed)
        self.kept = KeptResults(None if request.out is None else request.out / "frames")
        self._weights: dict[int, Weights] = {}
        self._last: tuple[str, int, Look] | None = None

    def judge(
        self, jobs: list[Job], show: Show
    ) -> tuple[list[list[dict[str, Any]]], list[list[dict[str, Any]]], list[dict[str, Any]]]:
        """Records of each weights, times of each weights, and seconds of capture."""
        runs = [list[dict[str, Any]]() for _ in self.candidates]
        timed = [list[dict[str, Any]]() for _ in self.candidates]
        captured: list[dict[str, Any]] = []
        total, done = sum(len(job.weights) for job in jobs), 0
        for job in jobs:
            scene = scene_of(self.data, job.name)
            for index in job.weights:
                words = job.name if len(self.candidates) == 1 else f"{job.name}, {self.candidates[index].path.name}"

                def report(part: float, words: str = words, done: int = done) -> None:
                    show("judging frames", (done + 0.9 * part) / total, words)

                runs[index].append(self._judged(scene, job.name, index, report))
                if len(timed[index]) < self.request.timed_frames:
                    timed[index].append(self._timed(scene, job.name, index))
                if not index and len(captured) < self.request.timed_frames:
                    captured += [record for record in [self._captured(scene, job.name)] if record is not None]
                done += 1
        show("judging frames", 1.0, f"{len(jobs)} frames")
        return runs, timed, captured

    def _judged(self, scene: RasterScene, name: str, index: int, report: Callable[[float], None]) -> dict[str, Any]:
        def make() -> dict[str, Any]:
            return judge_frame(self.trial, self.look(scene, name, index), self._loaded(index), report)

        record: dict[str, Any] = self.kept.made("frame", self._follows_from(scene, name, index), make)
        return record

    def _timed(self, scene: RasterScene, name: str, index: int) -> dict[str, Any]:
        def make() -> dict[str, Any]:
            return time_frame(self.trial, self.look(scene, name, index), self._loaded(index), self.request.timed_runs)

        what = {**self._follows_from(scene, name, index), "runs": self.request.timed_runs}
        record: dict[str, Any] = self.kept.made("time", what, make)
        return record

    def _captured(self, scene: RasterScene, name: str) -> dict[str, Any] | None:
        def make() -> dict[str, Any] | None:
            return capture_seconds(self.trial, self.look(scene, name, 0), self._loaded(0), self.camera, COST)

        what = {**self._follows_from(scene, name, 0), "cost": asdict(COST)}
        record: dict[str, Any] | None = self.kept.made("capture", what, make)
        return record

    def _follows_from(self, scene: RasterScene, name: str, index: int) -> dict[str, Any]:
        """All that a result depends on; the farm's labels follow from its key and are not drawn for this."""
        labels = None if self.data.files is None or scene.labels is None else zlib.crc32(scene.labels.tobytes())
        return {
            "weights": self.candidates[index].key, "frame": name, "scene": scene.key, "labels": labels,
            "camera": asdict(self.camera), **asdict(self.trial),
        }  # fmt: skip

    def look(self, scene: RasterScene, name: str, index: int) -> Look:
        """Look at a frame with some of the weights; the last look is kept."""
        if self._last is None or self._last[:2] != (name, index):
            self._last = None  # two looks at once are not needed
            self._last = (name, index, look_at(scene, name, self._loaded(index), self.camera, self.request.seed))
        return self._last[2]

    def _loaded(self, index: int) -> Weights:
        if index not in self._weights:
            self._weights[index] = self.candidates[index].load()
        return self._weights[index]

    def publish(
        self, content: dict[str, Any], jobs: list[Job], runs: list[list[dict[str, Any]]], show: Show
    ) -> list[str]:
        """Write figures, plot and pictures into the folder; names of the files."""
        out = self.request.out
        if out is None:
            return []
        from flows.evaluation_pictures import draw_frame
        from flows.evaluation_plot import draw_evaluation

        shown = _shown(self.trial)
        files = [out / "evaluation.json", out / "evaluation.png"]
        with writing(out):
            draw_evaluation(files[1], content)
            for title, name in _ends(runs[0], *shown):
                show("drawing", len(files) / 5, title)
                path = out / f"{title}.png"
                draw_frame(
                    path, f"{title} frame", self.look(scene_of(self.data, name), name, 0), self._loaded(0), *shown
                )
                files.append(path)
            content["files"] = [str(path) for path in files]
            temporary = files[0].with_name("evaluation.json.part")
            temporary.write_text(to_json(content), encoding="utf-8")
            temporary.replace(files[0])
        show("drawing", 1.0, "")
        return [str(path) for path in files]


def _shown(trial: Trial) -> tuple[str, float]:
    """Policy and share of the pictures: the first policy, and the share nearest 10 %."""
    policy = trial.policies[0] if trial.policies and trial.shares else "none"
    share = min(trial.shares, key=lambda share: abs(share - SHOWN_SHARE), default=0.0) if policy != "none" else 0.0
    return policy, share


def _ends(records: list[dict[str, Any]], policy: str, share: float) -> list[tuple[str, str]]:
    """The frames with the lowest and the highest mIoU of their own; one alone is the worst."""
    judged = {}
    for record in records:
        row = next(row for row in record["rows"] if (row["policy"], row["share"]) == (policy, share))
        if row["miou"] is not None:
            judged[record["frame"]] = row["miou"]
    if not judged:
        return []
    worst, best = min(judged, key=lambda name: judged[name]), max(judged, key=lambda name: judged[name])
    return [("worst", worst)] if worst == best else [("worst", worst), ("best", best)]

"""Which frames are judged by which weights and controls: each frame by those that never saw its labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flows.benchmark_frames import Candidate, check_frame
from flows.benchmark_request import EvaluateRequest
from flows.training_data import TrainingData
from pipeline.errors import SceneError
from pipeline.simulator.scene import RasterScene

Show = Callable[[str, float, str], None]


@dataclass(frozen=True)
class Job:
    """A frame, and the numbers of the weights and of the controls that it says something of."""

    name: str
    weights: tuple[int, ...]
    controls: tuple[int, ...] = ()


@dataclass(frozen=True)
class Jobs:
    """Frames to judge, and those that all of the weights were trained on."""

    frames: list[Job]
    left_out: list[str]

    def covered(self, number: int, *, control: bool = False) -> list[str]:
        """Frames that one of the weights, or one of the controls, is judged on."""
        return [job.name for job in self.frames if number in (job.controls if control else job.weights)]


def scene_of(data: TrainingData, name: str) -> RasterScene:
    """Make one scene of the data."""
    return next(data.scenes((name,)))


def sort_frames(
    request: EvaluateRequest, data: TrainingData, weights: Sequence[Candidate], controls: Sequence[Candidate],
    show: Show,
) -> Jobs:  # fmt: skip
    """Look at every frame for who was trained on it.

    Raises
    ------
    SceneError : no frame is left, a frame that was asked for by name has no weights left, a control has no frame left,
        or a frame that cannot be judged.
    """
    frames, left_out = [], []
    for number, name in enumerate(data.train):
        show("looking for frames", number / len(data.train), name)
        scene = scene_of(data, name)
        for one in weights:
            check_frame(scene, one.described)
        fit, beside = (
            tuple(index for index, one in enumerate(some) if not one.trained_on(scene)) for some in (weights, controls)
        )
        if fit:
            frames.append(Job(name, fit, beside))
        else:
            left_out.append(name)
    show("looking for frames", 1.0, f"{len(frames)} of {len(data.train)}")
    jobs = Jobs(frames, left_out)
    _check_left(request, jobs, weights, controls)
    return jobs


def _check_left(
    request: EvaluateRequest, jobs: Jobs, weights: Sequence[Candidate], controls: Sequence[Candidate]
) -> None:
    files = ", ".join(str(one.path) for one in weights)
    told = "frames trained on are refused: judge by others, or train with some held out: spectralzoom train ... "
    if not jobs.frames:
        raise SceneError(
            f"{files} was trained on all {len(jobs.left_out)} frames of {request.dataset}, and {told}--hold-out NAMES"
        )
    if request.frames and jobs.left_out:
        raise SceneError(
            f"no weights are left for {', '.join(jobs.left_out)} of --frames: {files} was trained on "
            f"{'it' if len(jobs.left_out) == 1 else 'them'}, and {told}--hold-out NAMES"
        )
    for number, one in enumerate(controls):
        if not jobs.covered(number, control=True):
            raise SceneError(f"the control {one.path} was trained on all {len(jobs.frames)} frames judged, and {told}")

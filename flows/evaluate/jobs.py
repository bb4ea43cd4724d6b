"""Which frames are judged by which weights and controls: each frame by those that never saw its labels.

Of frames left out in turn each file is judged on its own: what it kept for validation is held out by another of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flows.evaluate.frames import Candidate, check_frame
from flows.evaluate.request import EvaluateRequest
from flows.survey.scene import judged_labels
from flows.training.data import TrainingData
from pipeline.errors import SceneError, SettingsError
from pipeline.geometry.grid import UNLABELLED
from pipeline.simulator.scenes.scene import RasterScene

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
    request: EvaluateRequest,
    data: TrainingData,
    weights: Sequence[Candidate],
    controls: Sequence[Candidate],
    show: Show,
) -> Jobs:
    """Look at every frame for who was trained on it.

    Raises
    ------
    SceneError : no frame or no labelled pixel is left, a frame that was asked for by name has no weights left, a
        control has no frame left, or a frame that cannot be judged.
    SettingsError : files that were trained on different pixels of one frame.
    """
    jobs, labelled = Jobs([], []), False
    chosen = any(request.choices.get(what) is not None for what in ("bands", "wavelengths"))
    for number, name in enumerate(data.train):
        show("looking for frames", number / len(data.train), name)
        scene = scene_of(data, name)
        for one in weights:
            check_frame(scene, one.described)
        job = Job(name, *(_fit(some, scene, name, data.law, chosen) for some in (weights, controls)))
        _check_pixels(scene, [*(weights[at] for at in job.weights), *(controls[at] for at in job.controls)])
        if job.weights:
            jobs.frames.append(job)
            labelled = labelled or _has_labels(scene, weights[job.weights[0]])
        else:
            jobs.left_out.append(name)
    show("looking for frames", 1.0, f"{len(jobs.frames)} of {len(data.train)}")
    _check_left(request, jobs, weights, controls)
    if not labelled:
        raise SceneError(f"no labelled pixel is left on the {len(jobs.frames)} frames of {request.dataset} to judge by")
    return jobs


def _fit(some: Sequence[Candidate], scene: RasterScene, name: str, law: str, chosen: bool) -> tuple[int, ...]:
    """Numbers of those that may be judged on a frame."""
    in_turn = len({one.held_out for one in some}) > 1
    return tuple(
        number
        for number, one in enumerate(some)
        if not one.trained_on(scene, name, law, bands_chosen=chosen) and not (in_turn and one.validated_on(name, law))
    )


def _has_labels(scene: RasterScene, one: Candidate) -> bool:
    """Whether a frame has labelled pixels that did not teach these weights."""
    labels = judged_labels(scene, one.described)
    return labels is not None and bool((labels != UNLABELLED).any())


def _check_pixels(scene: RasterScene, fit: Sequence[Candidate]) -> None:
    for one in fit[1:]:
        if one.pixels_of(scene) != fit[0].pixels_of(scene):
            raise SettingsError(
                f"{one.path} and {fit[0].path} were trained on different pixels of {scene.name}, so that others are "
                "left to judge each of them on; evaluate them one by one"
            )


def _check_left(
    request: EvaluateRequest, jobs: Jobs, weights: Sequence[Candidate], controls: Sequence[Candidate]
) -> None:
    files = ", ".join(str(one.path) for one in weights)
    told = (
        "frames trained on are refused: judge by others, or train with some held out: spectralzoom train ... --hold-out"
        " NAMES"
    )
    if not jobs.frames:
        raise SceneError(f"{files} was trained on all {len(jobs.left_out)} frames of {request.dataset}, and {told}")
    if request.frames and jobs.left_out:
        raise SceneError(
            f"no weights are left for {', '.join(jobs.left_out)} of --frames: {files} was trained on "
            f"{'it' if len(jobs.left_out) == 1 else 'them'}, and {told}"
        )
    for number, one in enumerate(controls):
        if not jobs.covered(number, control=True):
            raise SceneError(f"the control {one.path} was trained on all {len(jobs.frames)} frames judged, and {told}")

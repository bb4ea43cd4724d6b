"""Choose the frames on which weights are judged: those whose labels they were not trained on."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.training.data import (
    Report,
    SceneNotes,
    TrainingData,
    farm_test_data,
    open_training_data,
    untaught_note,
    zero_cure,
)
from spectralzoom.models.evaluation.taught_labels import check_labels, judged_labels, seen_in_training
from spectralzoom.models.reading.inference import CoarsePrediction, coarse_prediction_of_columns
from spectralzoom.models.training.examples import normalised, observe_scene
from spectralzoom.models.weights.checksummed_files import refusing
from spectralzoom.models.weights.files import CAPTURED, Description, Weights, describe_weights
from spectralzoom.pipeline.errors import SceneError, SettingsError, list_some
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid
from spectralzoom.pipeline.simulator.scenes.laws import built_in_laws
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene

FARM_TEST_SCENES = 4
HELD_OUT, OTHER_PIXELS, VALIDATION = "held out", "untrained pixels of training frames", "validation"
ROLES = (HELD_OUT, OTHER_PIXELS, VALIDATION)  # of judged frames; one of the first two is the headline
VALIDATED = (
    "the training chose reading, calibration and thresholds by {names}: scores of these validation frames may be too"
    " good, and stand apart"
)
TAUGHT = (
    "trained pixels are left out of {names}: the other labelled ones are judged, which are no forecast for other scenes"
)


@dataclass(frozen=True)
class Candidate:
    """Weights to judge: their file and its description."""

    path: Path
    described: Description

    @property
    def camera(self) -> LineCamera:
        """Return the camera model of the training. Raises WeightsError: its record is damaged."""
        with refusing(self.path):
            return LineCamera(**self.described.record.get("camera", {}))

    @property
    def split(self) -> dict[str, Any]:
        """Return the training, validation and held-out scenes of the record."""
        return cast(dict[str, Any], self.described.record.get("split", {}))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return the warning about classes that the weights never draw, if any."""
        names = self.described.untaught
        return (f"{self.path.name}: {untaught_note(names)}",) if names else ()

    def validated_on(self, scene: RasterScene) -> bool:
        """Return whether the scene was one for validation, in any bands."""
        known = self.split.get("validation", {}).values()
        return scene.clear_key in known or any(one in self.split.get("validated", ()) for one in scene.content)

    def role_of(self, scene: RasterScene) -> str | None:
        """Return the part of a scene in the training, one of `ROLES`; None where all of it was taught."""
        seen = seen_in_training(scene, self.described)
        if seen == "all":
            return None
        return VALIDATION if self.validated_on(scene) else HELD_OUT if seen is None else OTHER_PIXELS


def open_candidates(paths: tuple[Path, ...]) -> list[Candidate]:
    """Read the descriptions of the weights.

    Raises SettingsError: no weights, or weights of different cameras, patches or classes; WeightsError: a file cannot
    be read.
    """
    if not paths:
        raise SettingsError("give --weights FILE, the weights to judge; spectralzoom train DATASET -o FILE makes them")
    found = [Candidate(path, describe_weights(path)) for path in paths]
    first = found[0]
    for one in found[1:]:
        alike = [(of.camera, of.described.config.patch, of.described.class_names) for of in (one, first)]
        if alike[0] != alike[1]:
            raise SettingsError(
                f"{one.path} differs from {first.path} in camera, patch or classes; several --weights are seeds or"
                " folds of one training: evaluate different ones separately"
            )
    if len({one.described.key for one in found}) < len(found):
        raise SettingsError("the same weights are given twice in --weights; give each file once")
    return found


def open_frames(
    dataset: str, frames: tuple[str, ...], scenes: int | None, camera: LineCamera, choices: dict[str, Any]
) -> TrainingData:
    """Return the data with the frames to judge in ``train``. Raises SettingsError: no such frame, too."""
    if built_in_laws(dataset):
        count = FARM_TEST_SCENES if scenes is None else scenes
        if count < 1:
            raise SettingsError(f"--scenes must be at least 1, got {count}")
        data = farm_test_data(count, camera, dataset, **choices)
    else:
        data = open_training_data(dataset, 0, scenes, camera, **choices)
    if unknown := [name for name in frames if name not in data.train]:
        raise SettingsError(f"{dataset} has no frame {', '.join(unknown)}; it has {', '.join(data.train)}")
    names = tuple(name for name in data.train if not frames or name in frames)
    return replace(data, train=names, validation=(), held_out=())


def observe_frame(
    scene: RasterScene, name: str, weights: Weights, camera: LineCamera, seed: int
) -> tuple[CoarsePrediction, NDArray[np.uint8]]:
    """Image a frame as those of the training; return its coarse prediction and labels in the weights' classes.

    The noise depends on the seed and the frame's name.
    """
    config = weights.config
    grid = SceneGrid(*scene.shape, config.patch)
    rng = np.random.default_rng([seed, 0xE7A1, zlib.crc32(name.encode())])
    _, reached = weights.basis.matrix(scene.wavelength_nm)
    captured = bool(weights.record.get(CAPTURED, True))
    seen = observe_scene(scene, camera, grid, weights.basis, rng, captured=captured)
    example = normalised(seen, weights.normalisation, reached)
    labels = judged_labels(scene, weights)
    assert labels is not None  # sort_frames
    return coarse_prediction_of_columns(weights, example.columns, grid), labels


@dataclass(frozen=True)
class Jobs:
    """Frames with the indices of their weights and the role by each, and frames that all weights were trained on."""

    frames: dict[str, dict[int, str]] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    notes: tuple[str, ...] = ()  # on frames with a single class, without any value, or with labels of another grid


def sort_frames(data: TrainingData, weights: Sequence[Candidate], show: Report, *, named: bool = False) -> Jobs:
    """Assign to each frame the weights that were not trained on it; every ``named`` one needs some.

    Raises SceneError: no frame or labelled pixel is left, a named frame has no weights left, or a frame has no labels.
    """
    jobs = Jobs()
    notes = SceneNotes()
    labelled = False
    for _, name, scene in notes.scenes(data, data.train, "looking for frames", show):
        if scene.labels is None:
            raise SceneError(
                f"frame {scene.name} has no labels, which a map is judged by; give --labels or a scene.toml"
            )
        for one in weights:
            check_labels(scene, one.described)
        roles = {at: role for at, one in enumerate(weights) if (role := one.role_of(scene))}
        if not roles:
            jobs.left_out.append(name)
            continue
        jobs.frames[name] = roles
        for note, role in ((VALIDATED, VALIDATION), (TAUGHT, OTHER_PIXELS)):
            if role in roles.values():
                notes[note].append(name)
        notes.add(name, scene)
        labelled = labelled or bool(np.any(judged_labels(scene, weights[min(roles)].described) != UNLABELLED))
    show("looking for frames", 1.0, f"{len(jobs.frames)} of {len(data.train)}")
    if jobs.left_out and (named or not jobs.frames):
        raise SceneError(
            f"no weights are left for {list_some(jobs.left_out)}: {', '.join(str(one.path) for one in weights)} was "
            f"trained on these labels, and frames trained on are refused. {_cure(data, weights)}"
        )
    if not labelled:
        raise SceneError(f"no labelled pixel is left on the {len(jobs.frames)} frames of {data.law} to judge by")
    return replace(jobs, notes=tuple(notes.texts))


def _cure(data: TrainingData, weights: Sequence[Candidate]) -> str:
    """Return what to judge weights by that were trained on the frames."""
    names = [*data.files.files] if data.files else []
    held = [name for name in names if any(name in one.split.get("held_out", ()) for one in weights)]
    zero = [cure for name in weights[0].described.class_names if (cure := zero_cure(name))]
    way = "Judge by another scene, or by other labelled pixels of it: --labels FILE"
    if held:
        way = f"Judge by frames that were held out: --frames {','.join(held)}"
    elif len(names) > 1 and data.files:
        path = data.files.path
        way = f"Hold some out of a training: spectralzoom train {path} --hold-out {names[-1]} -o FILE.safetensors"
    return "; ".join([way, *(f"label 0 was a class of the training: {one}, and train again" for one in zero)])

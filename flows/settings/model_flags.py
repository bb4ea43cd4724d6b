"""Define the flags of the verbs on weights: train and evaluate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from spectralzoom.flows.settings.flags import Names, OutFolder, parse_numbers, parse_wholes
from spectralzoom.models.network.machine import PROCESSOR, Device
from spectralzoom.models.training.train import TrainingSettings
from spectralzoom.pipeline.errors import SettingsError


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SceneFlags:
    """Flags of a labelled scene.

    Parameters
    ----------
    seed
        Random seed of initial weights, crops, noise and random policy.
    scenes
        Number of built-in scenes. Default: 4 to evaluate; 48 to train, on days from April to October (`scouting`: May
        to July).
    device
        Device of the network: `cpu`, `cuda`, `mps`, or `auto` (cuda or mps if available, else cpu).
    labels
        For one scene: label file.
    bands
        For one scene: band numbers to use, counted from 0, with commas.
    wavelengths
        For one scene: centre wavelengths of its bands [nm], with commas.
    """

    seed: int = 0
    scenes: int | None = None
    device: Device = PROCESSOR
    labels: str | None = None
    bands: str | None = None
    wavelengths: str | None = None

    def choices(self) -> dict[str, Any]:
        """Return the choices of files and bands of one scene. Raises SettingsError: numbers are invalid."""
        return {
            "labels": self.labels,
            "bands": parse_wholes(self.bands, "--bands"),
            "wavelengths": parse_numbers(self.wavelengths, "--wavelengths"),
        }


@dataclass(frozen=True, kw_only=True)
class TrainFlags(SceneFlags):
    """Flags of a training.

    Parameters
    ----------
    hold_out
        Names of scenes to exclude from training, with commas (059,060) or one a flag. The weights record the split.
    validation
        Number of scenes that judge a network. Default: 3 built-in scenes, or a quarter of a folder of 8 or more, at
        most 4. The classifiers of pixels learn from scenes of a folder for validation, too, in the end.
    steps
        Maximum number of steps; training stops at --steps or --minutes, whichever comes first.
    minutes
        Time limit of the training [min]: of the processor, or on an accelerator that of the clock. Reading scenes and
        the last validation are not included. The classifiers of files need their time in any case; a network, and
        classifiers that learn from validation scenes too, follow if the time suffices.
    start
        For built-in scenes: weights from which the training starts. Bands, classes and sizes must be theirs, and
        DATASET must contain the scenes that they know. The result is the mean of both networks, or the trained one
        where it reads the validation scenes better.
    learning_rate
        Highest learning rate. Default: 0.0015, or a third of it with --start.
    train_temporal
        Weights to which only a temporal reader is added, for surveys with --prior. The training starts from the
        reader that they have. It takes --scenes, --steps, --minutes and --seed; it does not resume. It
        needs 4 GB of memory, and half an hour for reading the scenes besides --minutes.
    min_exposure_ms
        Shortest exposure [ms]: augments training with simulated noise of exposures up to 100 ms and line spacings of
        1 to 8 px. With validation scenes, the weights record the scan performance, which `survey --seconds` needs.
    """

    hold_out: Names = ()
    validation: int | None = None
    steps: int = TrainingSettings.steps
    minutes: float = TrainingSettings.minutes
    start: Path | None = None
    learning_rate: float | None = None
    train_temporal: Path | None = None
    min_exposure_ms: float = TrainingSettings.darkest_ms

    def choices(self) -> dict[str, Any]:
        """Return the choices of files and bands, and the held-out scenes. Raises SettingsError: invalid numbers."""
        return super().choices() | {"hold_out": self.hold_out}

    @property
    def settings(self) -> TrainingSettings:
        """Return the settings of the network's training."""
        return TrainingSettings(
            steps=self.steps,
            minutes=self.minutes,
            seed=self.seed,
            darkest_ms=self.min_exposure_ms,
            learning_rate=self.learning_rate or TrainingSettings.learning_rate / (3 if self.start else 1),
        )


@dataclass(frozen=True, kw_only=True)
class EvaluateFlags(SceneFlags):
    """Flags of an evaluation.

    Parameters
    ----------
    weights
        Weights; repeat the flag for several seeds or folds, whose scores are averaged. Each is judged on the frames
        that it was not trained on.
    out
        Folder of evaluation.json.
    fractions
        Fractions of the patches to read at full resolution, with commas; none and all are always included.
    frames
        Names of the frames, with commas or one a flag. Default: all.
    """

    weights: Annotated[tuple[Path, ...], Parameter(negative="")] = ()
    out: OutFolder = None
    fractions: str = "0.05,0.1,0.15,0.2,0.35"
    frames: Names = ()

    @property
    def parts(self) -> tuple[float, ...]:
        """Return the fractions, ascending, without those that are always judged.

        Raises SettingsError: one is no number, or none from 0 to 1.
        """
        fractions = parse_numbers(self.fractions, "--fractions") or ()
        for fraction in fractions:
            if not 0 <= fraction <= 1:
                raise SettingsError(
                    f"--fractions are fractions of the patches from 0 to 1 (0.1 is 10 %), got {fraction:g}"
                )
        return tuple(sorted({fraction for fraction in fractions if 0 < fraction < 1}))


NO_TRAIN_FLAGS, NO_EVALUATE_FLAGS = TrainFlags(), EvaluateFlags()

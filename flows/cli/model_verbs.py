"""Define the verbs on weights: train and evaluate."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from spectralzoom.flows.evaluate.command import run_evaluate
from spectralzoom.flows.settings.flags import AsJson, OutFile
from spectralzoom.flows.settings.model_flags import NO_EVALUATE_FLAGS, NO_TRAIN_FLAGS, EvaluateFlags, TrainFlags
from spectralzoom.flows.terminal.progress import print_json, stderr
from spectralzoom.flows.training.train import run_train
from spectralzoom.flows.training.train_scenes import TrainRequest
from spectralzoom.flows.training.train_temporal import run_remember


def train(dataset: str, *, out: OutFile, flags: TrainFlags = NO_TRAIN_FLAGS, as_json: AsJson = False) -> int:
    """Train weights on DATASET: `farm`, `scouting`, a folder of labelled scenes, or one scene file.

    The training saves its state in OUT.checkpoint; the same command resumes it.
    `spectralzoom evaluate` measures the accuracy on scenes that were not used for training.

    Parameters
    ----------
    dataset
        `farm` or `scouting` (`farm@2` names the version of its law), both with a comma, a folder of images with labels
        (`init` writes a scene.toml for it), or a file.
    out
        Weights to write (.safetensors).
    """
    record = run_training(dataset, out, flags, _command(), stderr)
    if as_json:
        print_json(record)
    return 0


def _command() -> str:
    """Return the command without folders, for the record."""
    return shlex.join(["spectralzoom", *[Path(word).name if "/" in word else word for word in sys.argv[1:]]])


def run_training(dataset: str, out: Path, flags: TrainFlags, command: str, console: Console) -> dict[str, Any]:
    """Train weights, or only the temporal reader of given ones; return the record."""
    run = run_train if flags.train_temporal is None else run_remember
    return run(TrainRequest(dataset, out, flags, command), console)


def evaluate(dataset: str, *, flags: EvaluateFlags = NO_EVALUATE_FLAGS, as_json: AsJson = False) -> int:
    """Evaluate WEIGHTS on the frames of DATASET that they were not trained on: accuracy and costs.

    Parameters
    ----------
    dataset
        `farm`, `scouting`, a folder of labelled scenes, or one scene file.
    """
    run_evaluate(dataset, flags, stderr, as_json=as_json)
    return 0

"""Scan performance table of the shipped weights by law of built-in scenes, measured again on its validation scenes.

`python tests/benchmarks/bench_scans.py LAW ...` measures tables, and writes them into the shipped weights.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from measure import ROOT, Row

from spectralzoom.flows.training.data import open_training_data
from spectralzoom.flows.training.figures import judge_scans
from spectralzoom.flows.training.train_scenes import CAMERA
from spectralzoom.models.training.capture_augmentation import CaptureAugmentation
from spectralzoom.models.training.examples import normalised, observe_scene
from spectralzoom.models.weights.checksummed_files import read_tensors, write_checksummed
from spectralzoom.models.weights.files import BY_LAW, SCANS, describe_weights, load_weights
from spectralzoom.pipeline.geometry.grid import SceneGrid

SHIPPED = ROOT / "models" / "shipped" / "farm.safetensors"
SCENES = 6
SEED = 4  # of the training
SHORTEST_MS = 3.0
LAWS = ("farm@2", "scouting@1", "trial@1")
WITHIN = 0.5  # points


def measured(law: str) -> dict[str, Any]:
    """Return the table of a law."""
    weights = load_weights(SHIPPED)
    data = open_training_data(law, SCENES, 0, CAMERA)
    reached = np.ones(len(weights.normalisation.centre), np.bool_)
    examples = []
    for number, name in enumerate(data.validation):
        scene, rng = data.scene(name), np.random.default_rng([SEED, 0x0B6, number])
        grid = SceneGrid(*scene.shape, weights.config.patch)
        example = observe_scene(scene, CAMERA, grid, weights.basis, rng, captured=True)
        examples.append(normalised(example, weights.normalisation, reached))
    augmentation = CaptureAugmentation(weights.normalisation, min_exposure_ms=SHORTEST_MS)

    def report(what: str, done: float, figure: str) -> None:
        print(law, f"{done:.0%}", figure, file=sys.stderr, flush=True)

    judged = judge_scans(weights, examples, [law] * len(examples), augmentation, SEED, report)
    assert judged is not None
    return judged[0]


def write(tables: dict[str, dict[str, Any]], path: Path = SHIPPED) -> None:
    """Write tables into the record of weights."""
    about = dict(describe_weights(path).about)
    scans = about["record"][SCANS]
    about["record"] = {**about["record"], SCANS: {**scans, BY_LAW: {**scans.get(BY_LAW, {}), **tables}}}
    write_checksummed(path, about, read_tensors(path, about, lambda name: True))


def rows() -> list[Row]:
    """Return the score of each step at 12 ms, and the greatest difference from the record."""
    known = describe_weights(SHIPPED).record[SCANS][BY_LAW]
    found = []
    for law in LAWS:
        table = measured(law)
        miou, recorded = (100 * np.array(one["miou"]) for one in (table, known[law]))
        at = table["exposures_ms"].index(12.0)
        scores = ", ".join(f"{one:.1f}" for one in miou[:, at])
        off = float(np.abs(miou - recorded).max())
        found.append(Row(f"{law}: steps {table['steps']}, 12 ms", scores))
        found.append(Row(f"{law}: difference from the record", f"{off:.2f}", f"{WITHIN} points", off <= WITHIN))
    return found


if __name__ == "__main__":
    write({law: measured(law) for law in sys.argv[1:]})
